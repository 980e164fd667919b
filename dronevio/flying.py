"""Flying for the record: physics first, then the frames, into a folder of EuRoC's layout."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from dronevio.models.progress import Progress, silent
from dronevio.models.recordings.euroc import write_euroc
from dronevio.sim.flight import Flight, fly
from dronevio.sim.imaging import Imaging
from dronevio.sim.render import render
from dronevio.sim.render_job import RenderJob
from dronevio.sim.scenario import Scenario
from dronevio.sim.schedule import beat, schedule_frames
from dronevio.sim.truth_images import TruthImage

_SCHEDULE_STREAM = 21  # beside those of `dronevio.sim.scenario`, `dronevio.sim.world` and the images


def record_flight(
    scenario: Scenario,
    folder: Path,
    simulating: Progress = silent,
    rendering: Progress = silent,
    workers: int | None = None,
    imaging: Imaging | None = None,
    truth_images: tuple[TruthImage, ...] = (),
    hidden_time_offset_s: float = 0.0,
    stamp_jitter_s: float = 0.0,
    dropped_frames: float = 0.0,
    dark_from_s: float = 0.0,
    dark_for_s: float = 0.0,
) -> Flight:
    """Fly a scenario and write what was sensed, and the truth, as ``folder/mav0``.

    Args:
        scenario: What to fly; the same scenario gives the same bytes.
        folder: An existing folder.
        simulating: Hears of the physics.
        rendering: Hears of the frames.
        workers: Processes that draw; as many as there are cores by default.
        imaging: What the sensors make of light; those of a typical one by default.
        truth_images: What is written beside the main camera's frames.
        hidden_time_offset_s: How much later than the calibration says the frames are taken [s].
        stamp_jitter_s: Standard deviation of the error of the frames' time stamps [s].
        dropped_frames: Share of the frames that are lost.
        dark_from_s: When the cameras go dark, from the flight's start [s].
        dark_for_s: For how long [s].

    Raises:
        GraphicsError: No off-screen OpenGL. `dronevio.sim.gl.require_gl` tells before anything is simulated.
        IncompleteError: The system refused something while frames were written; what is done stays.
    """
    flight = fly(scenario, simulating)
    schedule = schedule_frames(
        beat(0, int(flight.truth.t_ns[-1]), scenario.rig.cameras[0].rate_hz),
        np.random.default_rng(np.random.SeedSequence(scenario.seed, spawn_key=(_SCHEDULE_STREAM,))),
        scenario.rig.time_offset_s + hidden_time_offset_s,
        stamp_jitter_s,
        dropped_frames,
        dark_from_s,
        dark_for_s,
    ).within(int(flight.truth.t_ns[0]), int(flight.truth.t_ns[-1]))
    job = RenderJob(
        scenario.world, scenario.seed, scenario.rig, flight.truth, schedule, imaging or Imaging(), truth_images
    )
    write_euroc(folder, scenario.rig, flight.imu, flight.truth, schedule.stamps_ns)
    render(job, folder / "mav0", rendering, workers)
    Ts_world_cam = job.poses(0)(schedule.exposed_ns)
    return replace(flight, frame_times_ns=schedule.stamps_ns, Ts_world_cam=Ts_world_cam)
