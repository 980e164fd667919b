"""Frames of a flight, drawn in parallel processes once the physics are done.

Drawing is the whole cost of a simulated flight, and every frame is independent of the others. So a few processes share
them, each with its own OpenGL; what a frame shows depends on the job and the frame's place in it alone, never on who
drew it. Only auto-exposure looks back: for it the frames are first metered, by a glance of a hundredth of their pixels.
"""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import mujoco
import numpy as np
import numpy.typing as npt

from dronevio.models.errors import IncompleteError
from dronevio.models.progress import Progress, silent
from dronevio.models.recordings.files import write_text
from dronevio.sim.crew import default_workers, run_crew
from dronevio.sim.imaging import Exposures
from dronevio.sim.painter import PARTIAL, DrawTask, MeterTask, Stage
from dronevio.sim.render_job import RenderJob
from dronevio.sim.world import build_world

Array = npt.NDArray[np.float64]

INCOMPLETE = "INCOMPLETE"
"""Name of a file that is in ``mav0`` until all its frames are."""
_FRAME_HEADER = "#timestamp [ns], true middle of the exposure [ns], exposure time [s], gain, lit\n"
_FRAMES_WORTH_A_WORKER = 15  # it takes a second to start


def render(job: RenderJob, mav0: Path, progress: Progress = silent, workers: int | None = None) -> Exposures:
    """Write what a rig's cameras see: a grey ``cam{i}/data/<stamp>.png`` for each camera and frame.

    ``frame_groundtruth0/data.csv`` says when each frame was really taken, on the IMU's clock, and how it was exposed.
    While frames are missing, a file ``INCOMPLETE`` lies beside them.

    Args:
        job: What to render.
        mav0: Where to write; it is made where it is missing.
        progress: Told how many frames are done.
        workers: Processes; as many as there are cores by default. The images do not depend on it.

    Returns:
        How each frame was exposed.

    Raises:
        ConfigError: No world has the job's name.
        IncompleteError: The system refused something on the way, such as more room on the disk; what is done stays.
        GraphicsError: No off-screen OpenGL, or a worker failed.
    """
    count = len(job.schedule)
    crew = workers or default_workers(count, _FRAMES_WORTH_A_WORKER)
    shares = [np.arange(number, count, crew) for number in range(min(crew, count))]
    finished = 0

    def heard(done: int, total: int) -> None:
        nonlocal finished
        finished = done
        progress(done, total)

    try:
        with _staged(job) as stage, _unfinished(job, mav0):
            exposures = _exposures(job, stage, shares)
            write_text(mav0 / "frame_groundtruth0" / "data.csv", _frame_table(job, exposures))
            tasks = [DrawTask(job, stage, share, exposures, mav0) for share in shares]
            run_crew(tasks, count, heard)
    except OSError as error:
        where = error.filename or mav0
        raise IncompleteError(f"{where}: {error.strerror} after {finished} of {count} frames") from error
    return exposures


@contextmanager
def _unfinished(job: RenderJob, mav0: Path) -> Iterator[None]:
    """Make the folders, and mark them as long as the work in them is not done."""
    folders = [mav0 / f"cam{number}" / "data" for number in range(len(job.rig.cameras))]
    for folder in folders:
        folder.mkdir(parents=True, exist_ok=True)
    mark = mav0 / INCOMPLETE
    mark.write_text("Frames are missing here: the recording is under way, or was cut off.\n", encoding="utf-8")
    try:
        yield
    except BaseException:
        for folder in folders:
            for half_written in folder.glob(f"*{PARTIAL}"):
                half_written.unlink()
        raise
    mark.unlink()


@contextmanager
def _staged(job: RenderJob) -> Iterator[Stage]:
    """Compile the job's world into a file for the workers."""
    with tempfile.TemporaryDirectory(prefix="dronevio-") as scratch:
        world = build_world(job.world, job.seed)
        path = Path(scratch) / "world.mjb"
        mujoco.mj_saveModel(world.spec.compile(), str(path), None)
        yield Stage(path, world.illumination)


def _exposures(job: RenderJob, stage: Stage, shares: list[npt.NDArray[np.int64]]) -> Exposures:
    """Return how the frames are exposed, having metered them where the control asks for it."""
    histograms = np.zeros((len(job.schedule), 256))
    if job.imaging.control.meters:
        results = [stage.model_path.with_name(f"histograms-{number}.npy") for number in range(len(shares))]
        tasks = [MeterTask(job, stage, share, result) for share, result in zip(shares, results, strict=True)]
        run_crew(tasks, len(job.schedule))
        for share, result in zip(shares, results, strict=True):
            histograms[share] = np.load(result)
    return job.imaging.exposures(histograms, stage.illumination * job.schedule.lit.astype(np.float64))


def _frame_table(job: RenderJob, exposures: Exposures) -> str:
    """Return the truth about the frames, as the text of a table."""
    schedule = job.schedule
    columns = (schedule.stamps_ns, schedule.exposed_ns, exposures.time_s, exposures.gain, schedule.lit.astype(int))
    rows = zip(*(column.tolist() for column in columns), strict=True)
    return _FRAME_HEADER + "".join(f"{','.join(map(repr, row))}\n" for row in rows)
