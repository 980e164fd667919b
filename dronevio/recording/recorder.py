"""The recorder: it simulates a flight, then renders its images, into a folder in the EuRoC layout."""

import json
from contextlib import closing
from pathlib import Path

from dronevio.models.errors import ConfigError, IncompleteError
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.progress import Progress, silent
from dronevio.models.protocols import Estimator
from dronevio.models.python_names import PREFIX
from dronevio.models.recordings.euroc import write_euroc
from dronevio.models.recordings.files import write_text
from dronevio.models.recordings.frame_truth import FRAME_TRUTH_FILE, frame_truth_text
from dronevio.models.recordings.scenario_file import SCENARIO_FILE
from dronevio.models.recordings.scenery_file import SCENERY_FILE, write_scenery
from dronevio.models.rig import Rig
from dronevio.models.rig_presets import RIGS, rig_named
from dronevio.models.serialization import to_jsonable
from dronevio.models.state import CameraFrame
from dronevio.sim.cameras.imaging import Imaging
from dronevio.sim.closed_loop.flight import Pilot, fly_closed_loop
from dronevio.sim.closed_loop.settings import LoopSettings
from dronevio.sim.flight import Flight, fly
from dronevio.sim.refly import FlownPath
from dronevio.sim.rendering.frame_files import write_frame
from dronevio.sim.rendering.live_cameras import LiveCameras
from dronevio.sim.rendering.render import link_frames, render_frames, unfinished
from dronevio.sim.rendering.render_job import RenderJob
from dronevio.sim.rendering.truth_images import TruthImage
from dronevio.sim.scenario import Scenario
from dronevio.sim.world import scenery_of
from dronevio.sim.worlds.own.names import recorded_world


def record_flight(
    scenario: Scenario,
    folder: Path,
    simulating: Progress = silent,
    rendering: Progress = silent,
    workers: int | None = None,
    truth_images: tuple[TruthImage, ...] = (),
    images_of: Path | None = None,
) -> Flight:
    """Simulate a scenario and write its sensor data, ground truth and settings into a folder.

    Args:
        scenario: The scenario with its seed, which determines all bytes of the recording.
        folder: Folder to write to; it is made if it does not exist.
        simulating: Called with the progress of the physics.
        rendering: Called with the number of rendered frames.
        workers: Number of rendering processes; the number of cores by default.
        truth_images: Ground-truth images to write beside those of the first camera.
        images_of: Recording in the same file system of a scenario that differs in the IMU only; its images are used, as
            hard links, instead of rendered ones.

    Returns:
        The flight without its images.

    Raises:
        ConfigError: The settings of the scenario contradict each other, or ``images_of`` has other frames.
        GraphicsError: There is no off-screen OpenGL. `dronevio.sim.cameras.gl.require_gl` checks this beforehand.
        IncompleteError: An image cannot be written. The finished frames are kept.
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
        world_seed=scenario.world_seed,
        light_seed=scenario.light_seed,
    )
    _write_settings(folder, _settings(scenario, flight))
    write_euroc(folder, scenario.rig, flight.imu, flight.truth, flight.schedule.stamps_ns)
    if images_of is None:
        render_frames(job, folder / "mav0", rendering, workers)
    else:
        link_frames(job, images_of / "mav0", folder / "mav0")
    write_scenery(folder / SCENERY_FILE, scenery_of(scenario.world, scenario.seed_of_world, scenario.light_seed))
    return flight


def record_closed_loop(
    scenario: Scenario,
    folder: Path,
    estimator: Estimator,
    settings: LoopSettings | None = None,
    progress: Progress = silent,
    pilot: Pilot | None = None,
    true_state: bool = False,
) -> Flight:
    """Simulate a scenario with an estimator, whose state the pilot receives, and write its recording into a folder.

    The recording is that of `record_flight`, along the path that the pilot flies. Frames are rendered and written as
    they are exposed.

    Args:
        scenario: The scenario with its seed, which together with the estimator determines all bytes of the recording.
        folder: Folder to write to; it is made if it does not exist.
        estimator: Estimator before its first measurement.
        settings: Latencies of the images and of the commands.
        progress: Called with the progress of the flight.
        pilot: Pilot of the vehicle; by default the controller of the scenarios.
        true_state: Whether the pilot receives the true state, while the estimator runs without influence.

    Returns:
        The flight without its images.

    Raises:
        ConfigError: The settings of the scenario contradict each other.
        GraphicsError: There is no off-screen OpenGL.
        IncompleteError: An image cannot be written. The finished frames are kept.
    """
    mav0, written = folder / "mav0", 0

    def write(frame: CameraFrame) -> None:
        nonlocal written
        write_frame(mav0, frame)
        written += 1

    with (
        closing(cameras_of(scenario)) as cameras,
        unfinished(mav0, [f"cam{number}" for number in range(len(scenario.rig.cameras))]),
    ):
        try:
            flight = fly_closed_loop(scenario, estimator, cameras, settings, progress, write, pilot, true_state)
            _write_settings(folder, _settings(scenario, flight))
            write_euroc(folder, scenario.rig, flight.imu, flight.truth, flight.schedule.stamps_ns)
            write_text(mav0 / FRAME_TRUTH_FILE, frame_truth_text(cameras.frames))
            write_scenery(
                folder / SCENERY_FILE, scenery_of(scenario.world, scenario.seed_of_world, scenario.light_seed)
            )
        except OSError as error:
            where = f"{error.filename}: " if error.filename else ""
            raise IncompleteError(f"stopped after {written} frames: {where}{error.strerror}") from error
    return flight


def cameras_of(scenario: Scenario) -> LiveCameras:
    """Return the cameras of a scenario, which render its images during the flight. Close them after use."""
    return LiveCameras(
        scenario.true_rig,
        scenario.world,
        scenario.seed_of_world,
        scenario.imaging,
        noise_seed=scenario.seed,
        light_seed=scenario.light_seed,
    )


def record_refly(
    flown: FlownPath,
    seed: int,
    folder: Path,
    rendering: Progress = silent,
    workers: int | None = None,
    imaging: Imaging | None = None,
    truth_images: tuple[TruthImage, ...] = (),
) -> None:
    """Render images along a recorded trajectory and write the recording into a folder.

    Args:
        flown: The trajectory with its IMU samples, its sensors and its world.
        seed: Seed of the appearance of the world and of the image noise.
        folder: Folder to write to; it is made if it does not exist.
        rendering: Called with the number of rendered frames.
        workers: Number of rendering processes; the number of cores by default.
        imaging: Exposure and noise of the cameras; those of a typical sensor by default.
        truth_images: Ground-truth images to write beside those of the first camera.

    Raises:
        GraphicsError: There is no off-screen OpenGL.
        IncompleteError: An image cannot be written. The finished frames are kept.
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
    settings = {
        "world": recorded_world(flown.world),
        "seed": seed,
        "rig": flown.rig,
        "T_simworld_world": flown.T_simworld_world,
    }
    settings["imaging"] = job.imaging
    _write_settings(folder, {"refly": {**settings, "real_imu": flown.real_imu}})
    write_euroc(folder, flown.rig, flown.imu, flown.truth, flown.schedule.stamps_ns)
    render_frames(job, folder / "mav0", rendering, workers)


def rig_of(name_or_file: str) -> Rig:
    """Return a rig by its name, or from the calibration in a file or folder.

    Args:
        name_or_file: One of `RIGS`, ``python:package.module:NAME``, a Kalibr ``camchain.yaml``, or a recording with its
            calibration.

    Raises:
        ConfigError: There is neither a rig nor a file of this name.
        InputError: The file is damaged or not supported.
    """
    path = Path(name_or_file)
    if name_or_file in RIGS or name_or_file.startswith(PREFIX):
        return rig_named(name_or_file)
    if path.exists():
        from dronevio.models.recordings.open import read_rig

        return read_rig(path)
    if path.suffix or len(path.parts) > 1:
        raise ConfigError(f"no rig {name_or_file!r}; expected an existing file or folder, or {', '.join(RIGS)}")
    return rig_named(name_or_file)  # which names similar ones


def _settings(scenario: Scenario, flight: Flight) -> dict[str, object]:
    """Return the settings of a simulated flight, with what the simulator has drawn or taken as constant."""
    return {"scenario": scenario.recorded, "imu_constants": flight.imu_constants, "gravity_m_s2": GRAVITY_M_S2}


def _write_settings(folder: Path, settings: dict[str, object]) -> None:
    """Write the settings of a recording as JSON."""
    folder.mkdir(parents=True, exist_ok=True)
    document = {name: to_jsonable(value) for name, value in settings.items()}
    (folder / SCENARIO_FILE).write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
