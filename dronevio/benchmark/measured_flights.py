"""Flights of EuRoC's measured paths and IMU samples, with rendered images, where a folder has their data.

The simulated IMU has the noise that its model states. A real one has not, so that estimators are measured on both. The
project carries no measured data: the variable `DATA_VARIABLE` of the environment names a folder with
``euroc/MH_04/groundtruth.csv`` and ``euroc/MH_04/imu0.csv``, and the same of the other flights.
"""

import os
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dronevio.models.errors import ConfigError
from dronevio.models.rig import Rig, euroc_rig

if TYPE_CHECKING:
    from dronevio.sim.cameras.imaging import Imaging

DATA_VARIABLE = "DRONEVIO_DATA"
"""Variable of the environment that names the folder of measured data."""
SUITE = "loops"
"""Suite to which these flights belong, since their paths come back."""


@dataclass(frozen=True)
class MeasuredFlight:
    """A measured path in a simulated world: the same flight gives the same bytes."""

    name: str
    """Name with a version, as that of a scenario."""
    flight: str
    """Name of the folder with the measured data."""
    world: str
    """Name of the world, which is placed around the path."""
    start_s: float
    """Time after the first true pose at which the recording begins [s]."""
    duration_s: float
    """Duration of the recording [s]."""
    seed: int = 0
    """Seed of the world and of the image noise."""
    rig: Rig = field(default_factory=euroc_rig)
    """The sensors; its IMU is the model of the measured one."""
    imaging: "Imaging | None" = None
    """Exposure and noise of the cameras; those of a typical sensor by default."""
    folder: Path = Path()
    """Folder with the true path and the IMU samples."""

    @property
    def files(self) -> tuple[Path, Path]:
        """Files of the true path and of the IMU samples."""
        return self.folder / "groundtruth.csv", self.folder / "imu0.csv"

    def record(self, folder: Path) -> None:
        """Render the images and write the recording into a folder.

        Raises:
            ConfigError: The path does not fit into the world.
            InputError: The data cannot be read.
            GraphicsError: There is no off-screen OpenGL.
            IncompleteError: An image cannot be written.
        """
        from dronevio.models.recordings.euroc import read_imu
        from dronevio.models.recordings.trajectory_file import read_trajectory_file
        from dronevio.recording.recorder import record_refly
        from dronevio.sim.refly import cut, refly

        path, imu = self.files
        section = cut(read_trajectory_file(path), self.start_s, self.duration_s)
        flown = refly(section, read_imu(imu), self.rig, self.world, self.seed)
        record_refly(flown, self.seed, folder, workers=1, imaging=self.imaging)


MEASURED: dict[str, MeasuredFlight] = {
    flight.name: flight
    for flight in (
        MeasuredFlight("measured-MH_04-v0", "MH_04", "hall", 15.0, 80.0),
        MeasuredFlight("measured-V1_02-v0", "V1_02", "room", 0.0, 80.0),
        MeasuredFlight("measured-V2_01-v0", "V2_01", "room", 0.0, 100.0),
    )
}
"""All measured flights by name and version, each with seed 0."""


def measured_name(name: str) -> str | None:
    """Return the name with its version of a measured flight that is given with or without it; None for another name."""
    return next((known for known in MEASURED if name in (known, known.rpartition("-v")[0])), None)


def measured_flights(names: Iterable[str], rig: Rig | None = None) -> tuple[tuple[MeasuredFlight, ...], str]:
    """Return the measured flights among scenarios and suites, and why those of a suite are left out, empty if not.

    Args:
        names: Names of scenarios and suites; all others are ignored.
        rig: Sensors that replace EuRoC's.

    Raises:
        ConfigError: A flight that is named itself has no data, or the rig is mounted otherwise than EuRoC's.
    """
    names = tuple(names)
    chosen = dict.fromkeys(known for name in names if (known := measured_name(name)))
    flights = dict.fromkeys((*chosen, *(MEASURED if SUITE in names else ())))
    data, available, missing = os.environ.get(DATA_VARIABLE), [], {}
    for flight in (MEASURED[name] for name in flights):
        located = replace(flight, folder=Path(data or "").absolute() / "euroc" / flight.flight, rig=rig or flight.rig)
        if not data:
            missing[flight.name] = f"expected {DATA_VARIABLE} to name a folder of measured data"
        elif absent := [file for file in located.files if not file.is_file()]:
            missing[flight.name] = f"{absent[0]}: no such file"
        elif not np.array_equal(located.rig.T_vehicle_imu[:3, :3], flight.rig.T_vehicle_imu[:3, :3]):
            missing[flight.name] = "a rig whose IMU is not mounted as EuRoC's; expected one such as euroc-stereo"
        else:
            available.append(located)
    for name in chosen:
        if name in missing:
            raise ConfigError(f"{name} cannot be flown: {missing[name]}")
    left_out = f"suite {SUITE} without {', '.join(missing)}: {next(iter(missing.values()))}" if missing else ""
    return tuple(available), left_out
