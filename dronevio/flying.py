"""Flying for the record: physics first, then the frames, into a folder of EuRoC's layout."""

from pathlib import Path

from dronevio.models.progress import Progress, silent
from dronevio.models.recordings.euroc import write_euroc
from dronevio.sim.flight import Flight, fly
from dronevio.sim.render import render_frames
from dronevio.sim.scenario import Scenario


def record_flight(
    scenario: Scenario,
    folder: Path,
    simulating: Progress = silent,
    rendering: Progress = silent,
    workers: int | None = None,
) -> Flight:
    """Fly a scenario and write what was sensed, and the truth, as ``folder/mav0``.

    Args:
        scenario: What to fly; the same scenario gives the same bytes.
        folder: An existing folder.
        simulating: Hears of the physics.
        rendering: Hears of the frames.
        workers: Processes that draw; as many as there are cores by default.

    Raises:
        GraphicsError: No off-screen OpenGL. `dronevio.sim.gl.require_gl` tells before anything is simulated.
    """
    flight = fly(scenario, simulating)
    write_euroc(folder, scenario.rig, flight.imu, flight.truth, flight.frame_times_ns)
    images = folder / "mav0" / "cam0" / "data"
    render_frames(scenario, flight.Ts_world_cam, flight.frame_times_ns, images, rendering, workers)
    return flight
