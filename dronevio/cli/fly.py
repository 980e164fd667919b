"""``dronevio fly``: from a scenario to a recording."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from dronevio.cli.flight_options import FlightOptions, Flown, parse_flight
from dronevio.cli.terminal import print_json, print_table, progress_bars

if TYPE_CHECKING:
    from dronevio.sim.flight import Flight


@dataclass(frozen=True)
class FlyCommand:
    """Fly a scenario in simulation and record what its cameras and IMU sensed, and the truth.

    The recording is a folder of EuRoC's (ASL) layout: mav0/cam0, cam1 ... with the frames, mav0/imu0, the calibration,
    the true motion in mav0/state_groundtruth_estimate0, and all settings in scenario.json. Every part of a scenario can
    be changed. The same scenario and seed give the same bytes.

    Examples:
      dronevio fly
      dronevio fly --scenario forest-medium --seed 3 --rig euroc-stereo
      dronevio fly --scenario hall-race --rig fisheye-stereo --imu BMI088 --wind.mean-m-s 4 0 0 --wind.gusts 1
      dronevio fly --plan.shape figure-8 --plan.limits.speed-m-s 3 --imaging.exposure-s 0.008 --truth-images depth flow
      dronevio fly --faults.dark-from-s 10 --faults.dark-for-s 2 --out recordings/dark
    """

    flight: Flown = field(default_factory=FlightOptions)
    """What to fly."""
    truth_images: tuple[Literal["depth", "segmentation", "flow"], ...] = ()
    """What of the truth to write beside the main camera's frames: depth, segmentation, flow."""
    out: Path | None = None
    """Folder to make; recordings/SCENARIO-SEED by default."""
    overwrite: bool = False
    """Replace an earlier recording, once the new one is complete."""
    json: bool = False
    """Print one JSON document instead of a table."""


def main(arguments: Sequence[str]) -> int:
    """Run the command."""
    command = parse_flight(FlyCommand, arguments, "fly")

    from dronevio.cli.folders import atomic_folder, size_mb
    from dronevio.recorder import record_flight
    from dronevio.sim.cameras.gl import require_gl

    chosen = command.flight.chosen()
    target = command.out or Path("recordings") / f"{chosen.name}-{chosen.seed}"
    require_gl()
    with atomic_folder(target, command.overwrite) as folder, progress_bars(quiet=command.json) as bars:
        flight = record_flight(
            chosen, folder, bars.bar("simulating"), bars.bar("rendering"), truth_images=command.truth_images
        )
    figures = flight_figures(flight)
    if command.json:
        crash = None if flight.collision is None else str(flight.collision)
        print_json(
            {"recording": str(target), "scenario": chosen.name, "seed": chosen.seed, **figures, "collision": crash}
        )
        return 0
    print_table(
        f"Flight {chosen.name}, seed {chosen.seed}: {chosen.description}",
        ("", "value", "unit"),
        (
            ("duration", f"{figures['duration_s']:.1f}", "s"),
            ("path", f"{figures['path_m']:.1f}", "m"),
            ("peak speed", f"{figures['peak_speed_m_s']:.2f}", "m/s"),
            ("peak turn rate", f"{figures['peak_rate_deg_s']:.0f}", "°/s"),
            ("frames", f"{figures['frames']:.0f}", ""),
            ("IMU samples", f"{figures['imu_samples']:.0f}", ""),
            ("size", f"{size_mb(target):.0f}", "MB"),
        ),
    )
    if flight.collision is not None:
        print(f"the flight ended early: the drone {flight.collision}")
    print(f"wrote {target}")
    print(f"estimate it:  dronevio estimate {target}")
    return 0


def flight_figures(flight: "Flight") -> dict[str, float]:
    """Return a flight's length, speed and rates, by name and unit."""
    import numpy as np

    truth = flight.truth
    assert truth.velocity_m_s is not None
    return {
        "duration_s": float(truth.t_s[-1]),
        "path_m": truth.length_m,
        "peak_speed_m_s": float(np.linalg.norm(truth.velocity_m_s, axis=1).max()),
        "peak_rate_deg_s": float(np.rad2deg(np.linalg.norm(flight.perfect_imu.gyro_rad_s, axis=1).max())),
        "frames": len(flight.frame_times_ns),
        "imu_samples": len(flight.imu),
    }
