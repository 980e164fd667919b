"""Frames of a flight, drawn in parallel processes once the physics are done.

Rendering dominates the cost of a simulated flight, and every frame is independent of the others. A few processes
therefore share the frames, each with its own OpenGL context. The pixels of a frame depend on the job and on its index
only, not on the process that renders it. Automatic exposure depends on earlier frames; for it, all frames are first
metered with images of 1/64 of the pixels.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dronevio.models.errors import GraphicsError, IncompleteError
from dronevio.models.progress import Progress, silent
from dronevio.models.recordings.euroc import INCOMPLETE
from dronevio.models.recordings.files import write_text
from dronevio.models.recordings.frame_truth import FRAME_TRUTH_FILE, FrameTruth, frame_truth_text
from dronevio.sim.rendering.compiled_world import CompiledWorld, compiled_world
from dronevio.sim.rendering.frame_tasks import PARTIAL_SUFFIX, MeterTask, RenderTask
from dronevio.sim.rendering.render_job import RenderJob
from dronevio.sim.rendering.truth_images import FOLDERS, names_table
from dronevio.sim.rendering.worker_pool import default_workers, run_tasks

_FRAMES_WORTH_A_WORKER = 15  # it takes a second to start


def render_frames(job: RenderJob, mav0: Path, progress: Progress = silent, workers: int | None = None) -> FrameTruth:
    """Write what a rig's cameras see: a grey ``cam{i}/data/<stamp>.png`` for each camera and frame.

    ``frame_groundtruth0/data.csv`` says when each frame was really taken, on the IMU's clock, and how it was exposed;
    what else the job asks for lies beside the frames (`dronevio.sim.rendering.truth_images`). While frames are
    missing, a file ``INCOMPLETE`` lies there too.

    Args:
        job: What to render.
        mav0: Where to write; it is made where it is missing.
        progress: Told how many frames are done.
        workers: Processes; as many as there are cores by default. The images do not depend on it.

    Returns:
        When and how each frame was really exposed.

    Raises:
        ConfigError: No world has the job's name.
        IncompleteError: The system refused something on the way, such as more room on the disk, or a worker died; the
            frames that are done stay.
        GraphicsError: No off-screen OpenGL, or no worker did anything.
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
        with compiled_world(job.world, job.seed, job.trajectory.t_ns) as scene, _unfinished(job, mav0):
            truth = _exposed(job, scene, shares)
            write_text(mav0 / FRAME_TRUTH_FILE, frame_truth_text(truth))
            if "segmentation" in job.truth_images:
                write_text(mav0 / FOLDERS["segmentation"] / "names.csv", names_table(scene.instance_names))
            run_tasks([RenderTask(job, scene, share, truth, mav0) for share in shares], count, heard)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        raise IncompleteError(f"stopped after {finished} of {count} frames: {where}{error.strerror}") from error
    except GraphicsError as error:
        if not finished:
            raise
        raise IncompleteError(f"stopped after {finished} of {count} frames: {error}") from error
    return truth


@contextmanager
def _unfinished(job: RenderJob, mav0: Path) -> Iterator[None]:
    """Make the folders, and mark them as long as the work in them is not done."""
    names = [f"cam{number}" for number in range(len(job.rig.cameras))] + [FOLDERS[kind] for kind in job.truth_images]
    folders = [mav0 / name / "data" for name in names]
    for folder in folders:
        folder.mkdir(parents=True, exist_ok=True)
    mark = mav0 / INCOMPLETE
    mark.write_text("Frames are missing here: the recording is under way, or was cut off.\n", encoding="utf-8")
    try:
        yield
    except BaseException:
        for folder in folders:
            for half_written in folder.glob(f"*{PARTIAL_SUFFIX}"):
                half_written.unlink()
        raise
    mark.unlink()


def _exposed(job: RenderJob, scene: CompiledWorld, shares: list[npt.NDArray[np.int64]]) -> FrameTruth:
    """Return how the frames are exposed, having metered them where the control asks for it."""
    schedule = job.schedule
    histograms = np.zeros((len(schedule), 256))
    if job.imaging.control.needs_histograms:
        results = [scene.model_path.with_name(f"histograms-{number}.npy") for number in range(len(shares))]
        tasks = [MeterTask(job, scene, share, result) for share, result in zip(shares, results, strict=True)]
        run_tasks(tasks, len(schedule))
        for share, result in zip(shares, results, strict=True):
            histograms[share] = np.load(result)
    exposures = job.imaging.exposures(histograms, scene.illumination * schedule.lit.astype(np.float64))
    return FrameTruth(schedule.stamps_ns, schedule.exposed_ns, exposures.time_s, exposures.gain, schedule.lit)
