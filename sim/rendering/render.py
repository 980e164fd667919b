"""Rendering of the frames of a flight in parallel processes, after the simulation of its motion.

Rendering dominates the cost of a simulated flight, and every frame is independent of the others. A few processes
therefore share the frames, each with its own OpenGL context. The pixels of a frame depend on the job and on its index
only, not on the process that renders it. Automatic exposure depends on earlier frames; for it, all frames are first
metered with images of 1/64 of the pixels.
"""

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dronevio.models.errors import ConfigError, DefectError, GraphicsError, IncompleteError
from dronevio.models.progress import Progress, silent
from dronevio.models.recordings.euroc import INCOMPLETE
from dronevio.models.recordings.files import write_text
from dronevio.models.recordings.frame_truth import FRAME_TRUTH_FILE, FrameTruth, frame_truth_text, read_frame_truth
from dronevio.sim.rendering.compiled_world import CompiledWorld, compiled_world
from dronevio.sim.rendering.frame_files import PARTIAL_SUFFIX, frame_file
from dronevio.sim.rendering.frame_tasks import MeterTask, RenderTask
from dronevio.sim.rendering.render_job import RenderJob
from dronevio.sim.rendering.truth_images import FOLDERS, names_table
from dronevio.sim.rendering.worker_pool import default_workers, run_tasks

_FRAMES_WORTH_A_WORKER = 15  # a process takes a second to start


def render_frames(job: RenderJob, mav0: Path, progress: Progress = silent, workers: int | None = None) -> FrameTruth:
    """Render the frames of a rig: a grey image ``cam{i}/data/<stamp>.png`` for each camera and frame.

    ``frame_groundtruth0/data.csv`` contains the true time on the clock of the IMU and the exposure of each frame;
    images of depth, segmentation and flow lie beside the frames (`dronevio.sim.rendering.truth_images`). A file
    ``INCOMPLETE`` exists while frames are missing.

    Args:
        job: The frames to render.
        mav0: Output folder, created if it is missing.
        progress: Callback that receives the number of completed frames and their total.
        workers: Number of processes, by default that of the cores; the images do not depend on it.

    Returns:
        True time and exposure of each frame.

    Raises:
        ConfigError: The world is unknown.
        IncompleteError: A system error occurred, such as a full disk, or a worker process ended; completed frames are
            kept.
        GraphicsError: Off-screen OpenGL is not available, or no worker completed a frame.
    """
    count = len(job.schedule)
    processes = workers or default_workers(count, _FRAMES_WORTH_A_WORKER)
    shares = [np.arange(number, count, processes) for number in range(min(processes, count))]
    finished = 0

    def report(done: int, total: int) -> None:
        nonlocal finished
        finished = done
        progress(done, total)

    folders = [f"cam{number}" for number in range(len(job.rig.cameras))] + [FOLDERS[kind] for kind in job.truth_images]
    try:
        with _compiled(job) as world, unfinished(mav0, folders):
            truth = _exposed(job, world, shares)
            write_text(mav0 / FRAME_TRUTH_FILE, frame_truth_text(truth))
            if "segmentation" in job.truth_images:
                write_text(mav0 / FOLDERS["segmentation"] / "names.csv", names_table(world.instance_names))
            run_tasks([RenderTask(job, world, share, truth, mav0) for share in shares], count, report)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        raise IncompleteError(f"stopped after {finished} of {count} frames: {where}{error.strerror}") from error
    except (GraphicsError, DefectError) as error:
        if not finished:
            raise
        raise IncompleteError(f"stopped after {finished} of {count} frames: {error}") from error
    return truth


def link_frames(job: RenderJob, images: Path, mav0: Path) -> None:
    """Write the frames of a job as hard links to those of another recording, which has rendered the same.

    Args:
        job: The frames.
        images: The folder ``mav0`` of the other recording, in the same file system.
        mav0: Output folder.

    Raises:
        ConfigError: The other recording has other frames.
        InputError: It has no file with the times of its frames.
    """
    truth = read_frame_truth(images / FRAME_TRUTH_FILE)
    for name, found, expected in (
        ("time stamps", truth.t_ns, job.schedule.stamps_ns),
        ("true times", truth.exposed_ns, job.schedule.exposed_ns),
    ):
        if not np.array_equal(found, expected):
            raise ConfigError(f"{images} has frames at other {name}; expected those of the flight")
    folders = [f"cam{number}" for number in range(len(job.rig.cameras))]
    with unfinished(mav0, folders):
        write_text(mav0 / FRAME_TRUTH_FILE, frame_truth_text(truth))
        for folder in folders:
            for t_ns in truth.t_ns.tolist():
                frame_file(mav0, folder, t_ns).hardlink_to(frame_file(images, folder, t_ns))


def _compiled(job: RenderJob) -> AbstractContextManager[CompiledWorld]:
    """Return the context of the compiled world of a job."""
    seed = job.seed if job.world_seed is None else job.world_seed
    return compiled_world(job.world, seed, job.trajectory.t_ns, job.light_seed)


@contextmanager
def unfinished(mav0: Path, names: Sequence[str]) -> Iterator[None]:
    """Create the folders of images and a file that marks them as incomplete during the context.

    Args:
        mav0: The folder ``mav0`` of a recording.
        names: Names of the folders in it.
    """
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


def _exposed(job: RenderJob, world: CompiledWorld, shares: list[npt.NDArray[np.int64]]) -> FrameTruth:
    """Return times and exposures of the frames, after metering if the exposure control requires it."""
    schedule = job.schedule
    histograms = np.zeros((len(schedule), 256))
    if job.imaging.control.needs_histograms:
        results = [world.model_path.with_name(f"histograms-{number}.npy") for number in range(len(shares))]
        tasks = [MeterTask(job, world, share, result) for share, result in zip(shares, results, strict=True)]
        run_tasks(tasks, len(schedule))
        for share, result in zip(shares, results, strict=True):
            histograms[share] = np.load(result)
    exposures = job.imaging.exposures(histograms, world.scene.illumination * schedule.lit.astype(np.float64))
    return FrameTruth(schedule.stamps_ns, schedule.exposed_ns, exposures.time_s, exposures.gain, schedule.lit)
