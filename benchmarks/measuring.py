"""What the benchmarks share: recordings with ground truth, parts and changes of them, runs, tables, kept results."""

import json
import math
import multiprocessing
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from dronevio.cli.terminal import print_table
from dronevio.estimator.odometry import VisualInertialOdometry
from dronevio.estimators.driver import estimate_recording
from dronevio.eval.metrics.alignment import align
from dronevio.eval.metrics.association import interpolate
from dronevio.eval.metrics.consistency import relative_to_first
from dronevio.eval.run import EstimatorRun
from dronevio.models.arrays import Integers
from dronevio.models.imu import ImuSamples, Times
from dronevio.models.protocols import Recording
from dronevio.models.recordings.open import open_recording
from dronevio.models.rig import Rig
from dronevio.models.state import CameraFrame, Health, Trajectory

Row = Mapping[str, str]
"""The cells of a row by the headings of their columns, which are the same in all rows of a table."""
Result = TypeVar("Result")

NO_POSE = (Health.INITIALIZING, Health.LOST)
MOVING_M_S = 0.1
"""Speed above which a vehicle moves [m/s]."""
_BEFORE_NS, _AFTER_NS = 20_000_000, 50_000_000  # IMU samples around the first frames of a recording


# --- recordings


@dataclass(frozen=True, eq=False)
class ChangedRecording:
    """A recording of which some parts are replaced; is a `Recording`."""

    name: str
    """Name in reports."""
    rig: Rig
    """Calibration that the estimator is given."""
    imu: ImuSamples
    """IMU samples that the estimator is given."""
    frame_times_ns: Times
    """(M,) Time stamps of the frames [ns]."""
    image_of: Callable[[int], CameraFrame]
    """Function that returns a frame by its index, with any time stamp."""
    ground_truth: Trajectory | None = None
    """Ground truth for scores, which estimators do not need; None without one."""

    @classmethod
    def of(cls, recording: Recording) -> "ChangedRecording":
        """Return a recording without changes."""
        r = recording
        return cls(r.name, r.rig, r.imu, r.frame_times_ns, r.frame, r.ground_truth)

    def frame(self, index: int) -> CameraFrame:
        """Return a frame at its time stamp."""
        return replace(self.image_of(index), t_ns=int(self.frame_times_ns[index]))

    def shown(self, rows: Integers) -> "ChangedRecording":
        """Return the recording whose images are those of the rows (M,), at the same times."""
        return replace(self, image_of=lambda index: self.image_of(int(rows[index])))

    def chosen(self, rows: Integers) -> "ChangedRecording":
        """Return the recording with the frames of some rows only, and with all IMU samples."""
        return replace(self.shown(rows), frame_times_ns=self.frame_times_ns[rows])

    def with_images(self, function: Callable[[npt.NDArray[np.uint8]], npt.NDArray[np.uint8]]) -> "ChangedRecording":
        """Return the recording with each image changed by a function."""

        def image_of(index: int) -> CameraFrame:
            frame = self.image_of(index)
            return replace(frame, images=tuple(map(function, frame.images)))

        return replace(self, image_of=image_of)


def with_truth(recording: Recording) -> tuple[Recording, Trajectory]:
    """Return a recording and its ground truth.

    Raises:
        SystemExit: The recording has none.
    """
    if recording.ground_truth is None:
        raise SystemExit(f"{recording.name}: no ground truth; expected a recording with the true motion")
    return recording, recording.ground_truth


def opened(folder: Path, cameras: int | None = None) -> tuple[Recording, Trajectory]:
    """Return a recording of a number of cameras and its ground truth.

    Raises:
        SystemExit: The recording has no ground truth.
    """
    return with_truth(open_recording(folder, cameras))


def section_of(recording: Recording, frames: int) -> ChangedRecording:
    """Return the beginning of a recording, without ground truth."""
    t_ns, imu = recording.frame_times_ns[:frames], recording.imu
    first, last = np.searchsorted(imu.t_ns, [t_ns[0] - _BEFORE_NS, t_ns[-1] + _AFTER_NS]).tolist()
    return ChangedRecording(recording.name, recording.rig, imu[first:last], t_ns, recording.frame)


# --- runs


def odometry(recording: Recording) -> EstimatorRun:
    """Return the run of the odometry on a recording."""
    return estimate_recording(recording, VisualInertialOdometry(recording.rig))


def frames_of(run: EstimatorRun, *healths: Health) -> int:
    """Return the number of frames with one of some healths."""
    counts = Counter(estimate.health for estimate in run.estimates)
    return sum(counts[health] for health in healths)


def first_pose_s(run: EstimatorRun) -> float:
    """Return the time from the first frame to the first pose [s]; NaN without one."""
    return next(((e.t_ns - int(run.t_ns[0])) * 1e-9 for e in run.estimates if e.state is not None), math.nan)


def anchored(truth: Trajectory, estimate: Trajectory) -> Trajectory:
    """Return an estimate whose covariances are those of its errors after alignment at the first pose.

    They contain the covariance of the first pose if the vehicle moves there; see `relative_to_first`.

    Args:
        truth: N true poses at the times of the estimate, N > 1.
        estimate: N estimated poses with covariances.
    """
    step_m = np.linalg.norm(truth.p_world_imu[1] - truth.p_world_imu[0])
    is_moving = step_m > MOVING_M_S * 1e-9 * float(truth.t_ns[1] - truth.t_ns[0])
    return relative_to_first(estimate) if is_moving else estimate


def ate_m(run: EstimatorRun, truth: Trajectory) -> float:
    """Return the RMS position error of a run after alignment of position and yaw [m]; NaN with one or two poses."""
    estimate = run.trajectory
    if len(estimate) < 3:
        return math.nan
    true, rows = interpolate(truth, estimate.t_ns)
    p = estimate[rows].p_world_imu
    errors = align(true.p_world_imu, p).positions(p) - true.p_world_imu
    return float(np.sqrt((errors**2).sum(axis=1).mean()))


class Stopwatch:
    """Elapsed time and processor time since it was made, or since its last lap."""

    def __init__(self) -> None:
        self._start = time.perf_counter(), time.process_time()

    def lap(self) -> tuple[float, float]:
        """Return elapsed time and processor time [s], and begin anew."""
        now = time.perf_counter(), time.process_time()
        elapsed, self._start = (now[0] - self._start[0], now[1] - self._start[1]), now
        return elapsed


# --- tables


def numbers(text: str) -> tuple[int, ...]:
    """Return the numbers that a text such as ``0-4`` or ``0,2,5-7`` lists.

    Raises:
        ValueError: The text lists no numbers.
    """
    found: list[int] = []
    for part in text.split(","):
        first, _, last = part.partition("-")
        found += range(int(first), int(last or first) + 1)
    if not found:
        raise ValueError(f"{text!r} lists no number; expected a text such as 0-4 or 0,2,5")
    return tuple(dict.fromkeys(found))


def text(value: float | None, form: str = ".3f") -> str:
    """Return a number as text for a table: a dash for None and NaN, ∞ for a failed run.

    Args:
        value: The number.
        form: Format specification of finite numbers.
    """
    if value is None or math.isnan(value):
        return "–"
    return "∞" if math.isinf(value) else format(value, form)


def table(headings: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1) -> str:
    """Return a Markdown table.

    Args:
        headings: Headings of the columns.
        rows: Cells of each row.
        left: Number of left-aligned columns; the others are right-aligned.
    """
    rule = [":---" if column < left else "---:" for column in range(len(headings))]
    return "\n".join(map(line, (headings, rule, *rows)))


def line(cells: Iterable[str]) -> str:
    """Return a row of a Markdown table."""
    return f"| {' | '.join(cells)} |"


def print_as_made(rows: Iterable[Row]) -> None:
    """Print a Markdown table whose rows take time: each of them as soon as there is one."""
    for number, row in enumerate(rows):
        print(table(tuple(row), [tuple(row.values())]) if number == 0 else line(row.values()), flush=True)


def print_rows(title: str, rows: Sequence[Row], left: Sequence[str] = ()) -> None:
    """Print rows as a plain table with a title; the first column and those of the headings `left` are left-aligned."""
    if rows:
        print_table(title, tuple(rows[0]), [tuple(row.values()) for row in rows], left)


# --- kept results


def kept_results(file: Path, of: Callable[..., Result]) -> list[Result]:
    """Return the results in a file of one JSON object a line; none where there is no such file."""
    lines = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
    return [of(**json.loads(line)) for line in lines]


def keep(file: Path, result: Any) -> None:
    """Append a result, a dataclass, to a file of one JSON object a line."""
    with file.open("a", encoding="utf-8") as lines:
        lines.write(json.dumps(asdict(result), ensure_ascii=False) + "\n")


def in_processes(function: Callable[..., Result], jobs: Sequence[tuple[Any, ...]], workers: int) -> Iterator[Result]:
    """Yield the results of a function of a module for some arguments as they end, each by a process of its own.

    With one worker, they are computed in this process, in order.
    """
    if workers == 1:
        yield from (function(*job) for job in jobs)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, max_tasks_per_child=1) as pool:
        for future in as_completed([pool.submit(function, *job) for job in jobs]):
            yield future.result()


def computed(
    file: Path,
    known: Iterable[Result],
    function: Callable[..., Result],
    jobs: Sequence[tuple[Any, ...]],
    workers: int,
) -> Iterator[Result]:
    """Yield the results that a file has already, and those of jobs, which are appended to it as they end.

    Args:
        file: File of one JSON object a line, in an existing folder.
        known: Its results.
        function: Function of a module that returns the result of a job, a dataclass.
        jobs: Arguments of the function, for each result that is missing.
        workers: Number of processes at a time.
    """
    yield from known
    for number, result in enumerate(in_processes(function, jobs, workers), 1):
        keep(file, result)
        print(f"{number} of {len(jobs)}: {result}", file=sys.stderr, flush=True)
        yield result
