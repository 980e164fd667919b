"""Flying for the record: first the motion, then the frames, into a folder of EuRoC's layout."""

import json
from pathlib import Path

from dronevio.models.errors import ConfigError
from dronevio.models.progress import Progress, silent
from dronevio.models.recordings.euroc import write_euroc
from dronevio.models.rig import Rig
from dronevio.models.rig_presets import RIGS, rig_named
from dronevio.models.serialization import to_jsonable
from dronevio.sim.cameras.imaging import Imaging
from dronevio.sim.flight import Flight, fly
from dronevio.sim.refly import FlownPath
from dronevio.sim.rendering.render import render
from dronevio.sim.rendering.render_job import RenderJob
from dronevio.sim.rendering.truth_images import TruthImage
from dronevio.sim.scenario import Scenario

SCENARIO_FILE = "scenario.json"
"""Beside ``mav0``: all settings of the flight."""


def record_flight(
    scenario: Scenario,
    folder: Path,
    simulating: Progress = silent,
    rendering: Progress = silent,
    workers: int | None = None,
    truth_images: tuple[TruthImage, ...] = (),
) -> Flight:
    """Fly a scenario and write what was sensed, the truth and the settings into a folder.

    Args:
        scenario: What to fly; the same scenario gives the same bytes.
        folder: Where to; it is made where it is missing.
        simulating: Hears of the physics.
        rendering: Hears of the frames.
        workers: Processes that draw; as many as there are cores by default.
        truth_images: What is written beside the main camera's frames.

    Raises:
        ConfigError: The scenario does not fit together.
        GraphicsError: No off-screen OpenGL. `dronevio.sim.cameras.gl.require_gl` tells before anything is simulated.
        IncompleteError: The system refused something while frames were written; what is done stays.
    """
    flight = fly(scenario, simulating)
    job = RenderJob(
        scenario.world,
        scenario.seed,
        flight.true_rig,
        flight.truth,
        flight.schedule,
        scenario.imaging,
        truth_images,
    )
    _write_settings(folder, {"scenario": to_jsonable(scenario), "imu_constants": to_jsonable(flight.imu_constants)})
    write_euroc(folder, scenario.rig, flight.imu, flight.truth, flight.schedule.stamps_ns)
    render(job, folder / "mav0", rendering, workers)
    return flight


def record_refly(
    flown: FlownPath,
    seed: int,
    folder: Path,
    rendering: Progress = silent,
    workers: int | None = None,
    imaging: Imaging | None = None,
    truth_images: tuple[TruthImage, ...] = (),
) -> None:
    """Render along a path that was flown before, and write it into a folder like a flight.

    Args:
        flown: The path, its IMU, its sensors and its world.
        seed: Draws the world's looks and the images' noise.
        folder: Where to; it is made where it is missing.
        rendering: Hears of the frames.
        workers: Processes that draw; as many as there are cores by default.
        imaging: What the sensors make of light; those of a typical one by default.
        truth_images: What is written beside the main camera's frames.

    Raises:
        GraphicsError: No off-screen OpenGL.
        IncompleteError: The system refused something while frames were written; what is done stays.
    """
    job = RenderJob(
        flown.world,
        seed,
        flown.rig,
        flown.truth,
        flown.schedule,
        imaging or Imaging(),
        truth_images,
        flown.T_simworld_world,
    )
    settings = {"world": flown.world, "seed": seed, "rig": flown.rig, "T_simworld_world": flown.T_simworld_world}
    _write_settings(folder, {"refly": {**settings, "real_imu": flown.real_imu}})
    write_euroc(folder, flown.rig, flown.imu, flown.truth, flown.schedule.stamps_ns)
    render(job, folder / "mav0", rendering, workers)


def rig_of(name_or_file: str) -> Rig:
    """Return a rig by its name, or from the calibration that a file or folder holds.

    Args:
        name_or_file: One of `RIGS`, a Kalibr ``camchain.yaml``, or a recording with its calibration.

    Raises:
        ConfigError: It is neither a name nor a file.
        InputError: The file is damaged, or not supported.
    """
    path = Path(name_or_file)
    if name_or_file in RIGS or not path.exists():
        if not path.exists() and (path.suffix or len(path.parts) > 1):
            raise ConfigError(f"no rig {name_or_file!r}; expected a file or folder that is there, or {', '.join(RIGS)}")
        return rig_named(name_or_file)
    from dronevio.models.recordings.open import rig_of_file

    return rig_of_file(path)


def _write_settings(folder: Path, settings: dict[str, object]) -> None:
    """Write what was flown, for people and for programs."""
    folder.mkdir(parents=True, exist_ok=True)
    document = {name: to_jsonable(value) for name, value in settings.items()}
    (folder / SCENARIO_FILE).write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
