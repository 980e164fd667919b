"""What an estimator made of a recording, frame by frame, and what it cost."""

from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from dronevio.eval.metrics.scores import coverage_percent, initialized_s
from dronevio.models.errors import EvaluationError
from dronevio.models.imu import Times
from dronevio.models.protocols import Recording
from dronevio.models.state import Estimate, FeatureTracks, Health, Trajectory

Array = npt.NDArray[np.float64]

POSE_IS_VALID = frozenset({Health.TRACKING, Health.INERTIAL_ONLY})
"""The healths in which an estimator stands by its pose."""


@dataclass(frozen=True, eq=False)
class EstimatorRun:
    """An estimator's answers to all frames of a recording, in time order."""

    estimates: tuple[Estimate, ...]
    """(M) One for each frame, also for those without a pose."""
    cpu_ms: Array
    """(M,) Processor time of all threads for each frame and the IMU samples before it [ms]."""
    wall_ms: Array
    """(M,) The same by the clock on the wall [ms]."""

    def __post_init__(self) -> None:
        """Check the lengths.

        Raises:
            EvaluationError: The costs do not belong to the estimates.
        """
        m = len(self.estimates)
        if self.cpu_ms.shape != (m,) or self.wall_ms.shape != (m,):
            raise EvaluationError(
                f"a run of {m} estimates with costs of shapes {self.cpu_ms.shape}, {self.wall_ms.shape};"
                f" expected ({m},), ({m},)"
            )

    @property
    def t_ns(self) -> Times:
        """(M,) Time stamps of the frames [ns]."""
        return np.array([estimate.t_ns for estimate in self.estimates], dtype=np.int64)

    @property
    def trajectory(self) -> Trajectory:
        """The poses that the estimator stands by: what is scored."""
        return Trajectory.from_states(
            estimate.state
            for estimate in self.estimates
            if estimate.health in POSE_IS_VALID and estimate.state is not None
        )

    @property
    def real_time_factor(self) -> float:
        """How many seconds of flight are estimated in one second of processor time; above 1 keeps up on one core."""
        span_s = float(np.ptp(self.t_ns)) * 1e-9 if len(self.estimates) else 0.0
        spent_s = float(self.cpu_ms.sum()) * 1e-3
        return span_s / spent_s if spent_s > 0.0 else float("inf")

    @property
    def n_tracks(self) -> npt.NDArray[np.int64]:
        """(M,) How many features were followed into each frame."""
        return np.array([len(tracks_of(estimate).ids) for estimate in self.estimates], dtype=np.int64)

    def check_belongs_to(self, recording: Recording) -> None:
        """Check that this run answers the frames of a recording.

        Raises:
            EvaluationError: The estimates' time stamps are not those of the frames.
        """
        if not np.array_equal(self.t_ns, recording.frame_times_ns):
            raise EvaluationError(
                f"{len(self.estimates)} estimates that are not stamped like the {len(recording.frame_times_ns)} frames"
                f" of {recording.name}"
            )


def tracks_of(estimate: Estimate) -> FeatureTracks:
    """Return an estimate's tracks, none of them where it has none."""
    if estimate.tracks is not None:
        return estimate.tracks
    return FeatureTracks(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0, np.int64))


@dataclass(frozen=True)
class Latency:
    """Time for one frame, of many [ms]."""

    mean: float
    """Mean [ms]."""
    median: float
    """Median [ms]."""
    p95: float
    """What 95 % stay below [ms]."""
    p99: float
    """What 99 % stay below [ms]."""
    max: float
    """Longest [ms]."""

    @classmethod
    def of(cls, times_ms: Array) -> Self:
        """Return the figures of times (M,) [ms], M > 0."""
        p50, p95, p99 = np.percentile(times_ms, [50.0, 95.0, 99.0])
        return cls(float(times_ms.mean()), float(p50), float(p95), float(p99), float(times_ms.max()))


@dataclass(frozen=True)
class RunScores:
    """How an estimator ran, whatever the truth."""

    frames: int
    """Frames of the recording."""
    poses: int
    """Frames with a pose that the estimator stands by."""
    initialized_s: float | None
    """Time from the first frame to the first such pose [s]; None if there is none."""
    coverage_percent: float | None
    """Share of the frames later than 3 s after the first that have one [%]; None if there are none so late."""
    lost_frames: int
    """Frames without a pose after the first pose."""
    resets: int
    """How often poses began anew after frames without one."""
    cpu_ms: Latency | None
    """Processor time of all threads for each frame [ms]; None without frames."""
    latency_ms: Latency | None
    """The same by the clock on the wall: how late a pose is [ms]; None without frames."""
    real_time_factor: float | None
    """Seconds of flight estimated in one second of processor time; None where no time was measured."""
    real_time_factor_wall: float | None
    """Seconds of flight estimated in one second by the clock on the wall; None where no time was measured."""


def running_scores(run: EstimatorRun) -> RunScores:
    """Return how an estimator ran."""
    t_ns, poses_ns = run.t_ns, run.trajectory.t_ns
    valid = np.array([e.health in POSE_IS_VALID and e.state is not None for e in run.estimates], dtype=bool)
    since_first = valid[int(np.argmax(valid)) :] if valid.any() else valid[:0]
    span_s = float(np.ptp(t_ns)) * 1e-9 if len(t_ns) else 0.0
    return RunScores(
        frames=len(t_ns),
        poses=len(poses_ns),
        initialized_s=initialized_s(t_ns, poses_ns),
        coverage_percent=coverage_percent(t_ns, poses_ns),
        lost_frames=int(np.sum(~since_first)),
        resets=int(np.sum(~since_first[:-1] & since_first[1:])),
        cpu_ms=Latency.of(run.cpu_ms) if len(t_ns) else None,
        latency_ms=Latency.of(run.wall_ms) if len(t_ns) else None,
        real_time_factor=_factor(span_s, run.cpu_ms),
        real_time_factor_wall=_factor(span_s, run.wall_ms),
    )


def _factor(span_s: float, times_ms: Array) -> float | None:
    """Return seconds of flight by seconds spent."""
    spent_s = float(times_ms.sum()) * 1e-3
    return span_s / spent_s if spent_s > 0.0 else None
