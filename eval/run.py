"""The run of an estimator on a recording: its estimates frame by frame, and their cost."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import numpy.typing as npt

from dronevio.eval.metrics.scores import coverage_percent, initialization_s
from dronevio.models.arrays import Array
from dronevio.models.defects import Defect
from dronevio.models.errors import EvaluationError
from dronevio.models.imu import Times
from dronevio.models.protocols import Recording
from dronevio.models.slam_map import SlamMap
from dronevio.models.state import Estimate, FeatureTracks, Health, NavState, Trajectory
from dronevio.models.summary import Summarized, duration_text, html_table

POSE_IS_VALID = frozenset({Health.TRACKING, Health.INERTIAL_ONLY})
"""Health states in which the pose of an estimate is valid."""
_WARNING = re.compile(
    r"lost: |inconsistent: |probable cause: |time offset of camera and IMU|the image does not change"
    r"|camera \d+ contradicts"
)
"""Beginning of the events that tell of wrong measurements or a wrong calibration."""
_OUTLIERS = re.compile(r"(\d+) outlying samples of the IMU")
"""Beginning of the events that tell of IMU samples that are left out."""
_SHOWN_WARNINGS = 5  # in notebooks


@dataclass(frozen=True, eq=False, repr=False)
class EstimatorRun(Summarized):
    """The estimates of all frames of a recording, in time order, with their costs."""

    estimates: tuple[Estimate, ...]
    """(M,) Estimates of all frames, also of those without a pose."""
    cpu_ms: Array
    """(M,) Processor time of all threads for each frame and the IMU samples before it [ms]."""
    wall_ms: Array
    """(M,) Elapsed time for the same [ms]."""
    defects: tuple[Defect, ...] = ()
    """Defects of the recording, and of the images that were read."""
    map: SlamMap | None = None
    """The map after the last frame; None if the estimator has none, or if it was not asked for."""
    later: tuple["EstimatorRun", ...] = ()
    """The runs on the segments of the recording after steps of its clock, each with a world frame of its own."""

    def __post_init__(self) -> None:
        """Check the lengths.

        Raises:
            EvaluationError: The numbers of estimates and costs differ.
        """
        m = len(self.estimates)
        if self.cpu_ms.shape != (m,) or self.wall_ms.shape != (m,):
            raise EvaluationError(
                f"a run of {m} estimates with costs of shapes {self.cpu_ms.shape}, {self.wall_ms.shape};"
                f" expected ({m},), ({m},)"
            )

    def _summary(self) -> list[tuple[str, str]]:
        poses = self.trajectory
        rows = [("frames", f"{len(self.estimates)} in {duration_text(self.t_ns)}"), ("poses", f"{len(poses)}")]
        if len(poses):
            start = duration_text(np.append(self.t_ns[:1], poses.t_ns[:1]))
            rows += [
                ("first pose", f"{start} after the first frame"),
                ("length of the path", f"{poses.length_m:.2f} m"),
            ]
        if len(self.cpu_ms):
            cost = Latency.of(self.cpu_ms)
            rows += [("processor time per frame", f"mean {cost.mean:.1f} ms, 99 % below {cost.p99:.1f} ms")]
        if self.real_time_factor is not None:
            rows += [("real-time factor on one core", f"{self.real_time_factor:.1f}")]
        if self.map is not None:
            of_map = f"keyframes {len(self.map.t_ns)}, loops {len(self.map.closed)}, points {len(self.map.points)}"
            rows += [("map", of_map)]
        counts = {"warnings": len(self.warnings), "defects": len(self.defects), "later segments": len(self.later)}
        outliers = {"outlying IMU samples": self.imu_outliers}
        return rows + [(name, f"{count}") for name, count in (counts | outliers).items() if count]

    def _repr_html_(self) -> str:
        """Return the summary with the first warnings as HTML, by which notebooks show it."""
        shown = self.warnings[:_SHOWN_WARNINGS]
        texts = [(f"warning at {duration_text(np.append(self.t_ns[:1], t_ns))}", text) for t_ns, text in shown]
        return html_table(type(self).__name__, [*self._summary(), *texts])

    @property
    def t_ns(self) -> Times:
        """(M,) Time stamps of the frames [ns]."""
        return np.array([estimate.t_ns for estimate in self.estimates], dtype=np.int64)

    @property
    def trajectory(self) -> Trajectory:
        """The valid poses, which are scored."""
        return Trajectory.from_states(
            estimate.state
            for estimate in self.estimates
            if estimate.health in POSE_IS_VALID and estimate.state is not None
        )

    @property
    def map_trajectory(self) -> Trajectory:
        """The valid poses in the map frame, as they were corrected when they were published.

        It is empty if the estimator has no map.
        """
        return map_trajectory_of(self.estimates)

    @property
    def final_trajectory(self) -> Trajectory:
        """The valid poses, corrected by the map after the last frame; without velocities. Empty without a map."""
        return Trajectory.from_states(()) if self.map is None else self.trajectory.corrected(self.map.correction)

    @property
    def real_time_factor(self) -> float | None:
        """Seconds of flight per second of processor time; None if no time was measured."""
        return real_time_factor(self.t_ns, self.cpu_ms)

    @property
    def cpu_growth(self) -> float | None:
        """Mean processor time per frame in the last quarter of the frames, relative to the second quarter.

        The first quarter contains the initialization. None if a quarter has no frame, or no time was measured.
        """
        second, last = (
            self.cpu_ms[len(self.cpu_ms) // 4 : len(self.cpu_ms) // 2],
            self.cpu_ms[-(len(self.cpu_ms) // 4) :],
        )
        return float(last.mean() / second.mean()) if len(self.cpu_ms) >= 4 and second.sum() > 0.0 else None

    @property
    def warnings(self) -> tuple[tuple[int, str], ...]:
        """Time stamps [ns] and texts of the events that tell of wrong measurements or a wrong calibration."""
        return tuple((e.t_ns, text) for e in self.estimates for text in e.events if is_warning(text))

    @property
    def imu_outliers(self) -> int:
        """Number of IMU samples that the estimator has left out as outliers."""
        matches = (_OUTLIERS.match(text) for estimate in self.estimates for text in estimate.events)
        return sum(int(match[1]) for match in matches if match)

    @property
    def innovations(self) -> "Innovations | None":
        """Statistics of the innovations; None if no estimate has one."""
        reports = [e.health_report for e in self.estimates if e.health_report is not None]
        px = [report.innovation_px for report in reports if report.innovation_px is not None]
        nis = [report.innovation_nis for report in reports if report.innovation_nis is not None]
        return Innovations.of(np.array(px), np.array(nis)) if px and nis else None

    @property
    def n_tracks(self) -> npt.NDArray[np.int64]:
        """(M,) Numbers of features that were tracked into each frame."""
        return np.array([len(tracks_of(estimate).ids) for estimate in self.estimates], dtype=np.int64)

    def check_belongs_to(self, recording: Recording) -> None:
        """Check that this is a run on a recording.

        Raises:
            EvaluationError: The time stamps of the estimates differ from those of the frames.
        """
        if not np.array_equal(self.t_ns, recording.frame_times_ns):
            raise EvaluationError(
                f"{len(self.estimates)} estimates with other time stamps than the {len(recording.frame_times_ns)}"
                f" frames of {recording.name}"
            )


@dataclass(frozen=True)
class Innovations:
    """Statistics over all frames of the innovations: how well images agree with the predictions of the estimator."""

    median_px: float
    """Median of the frames' innovations [px]."""
    p95_px: float
    """95th percentile of the frames' innovations [px]."""
    median_nis: float
    """Median of the frames' normalized innovations squared (NIS), relative to its expectation: 1 expected."""
    p95_nis: float
    """95th percentile of the frames' NIS."""

    @classmethod
    def of(cls, innovation_px: Array, innovation_nis: Array) -> Self:
        """Return the statistics of the innovations (N,) [px] and NIS (M,) of frames, N > 0 and M > 0."""
        px, nis = (np.percentile(values, [50.0, 95.0]).tolist() for values in (innovation_px, innovation_nis))
        return cls(*px, *nis)


def map_trajectory_of(estimates: Sequence[Estimate]) -> Trajectory:
    """Return the valid poses of estimates in the map frame, with velocities and, if all are known, covariances.

    The covariance of the pose in the map is that of the map; those of velocity and biases are the odometry's.
    """
    mapped = [e for e in estimates if e.health in POSE_IS_VALID and e.state is not None and e.T_map_imu is not None]
    return Trajectory.from_states(map_state(estimate) for estimate in mapped)


def map_state(estimate: Estimate) -> NavState:
    """Return the state of an estimate that has a pose in the map frame, in that frame."""
    state, T_map_odom, T_map_imu = estimate.state, estimate.T_map_odom, estimate.T_map_imu
    assert state is not None and T_map_odom is not None and T_map_imu is not None
    covariance = None
    if estimate.map_covariance is not None and state.covariance is not None:
        S = np.eye(9)
        S[:3, :3] = T_map_odom[:3, :3]
        covariance = np.zeros_like(state.covariance)
        covariance[:6, :6] = estimate.map_covariance
        covariance[6:, 6:] = S @ state.covariance[6:, 6:] @ S.T
    velocity_m_s = T_map_odom[:3, :3] @ state.velocity_m_s
    return replace(state, T_world_imu=T_map_imu, velocity_m_s=velocity_m_s, covariance=covariance)


def is_warning(event: str) -> bool:
    """Return whether an event of an estimate tells of wrong measurements or a wrong calibration."""
    return _WARNING.match(event) is not None


def real_time_factor(t_ns: Times, times_ms: Array) -> float | None:
    """Return the duration of a flight relative to the time that its estimation took; None if that is zero.

    Args:
        t_ns: (M,) Time stamps of the frames [ns].
        times_ms: (M,) Processor or elapsed time of each frame [ms].
    """
    duration_s = float(np.ptp(t_ns)) * 1e-9 if len(t_ns) else 0.0
    spent_s = float(times_ms.sum()) * 1e-3
    return duration_s / spent_s if spent_s > 0.0 else None


def tracks_of(estimate: Estimate) -> FeatureTracks:
    """Return the feature tracks of an estimate, which are empty if it has none."""
    if estimate.tracks is not None:
        return estimate.tracks
    return FeatureTracks(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0, np.int64))


@dataclass(frozen=True)
class Latency:
    """Statistics of the time per frame [ms]."""

    mean: float
    """Mean time per frame [ms]."""
    median: float
    """Median time per frame [ms]."""
    p95: float
    """95th percentile of the time per frame [ms]."""
    p99: float
    """99th percentile of the time per frame [ms]."""
    max: float
    """Longest time of a frame [ms]."""

    @classmethod
    def of(cls, times_ms: Array) -> Self:
        """Return the statistics of times (M,) [ms], M > 0."""
        p50, p95, p99 = np.percentile(times_ms, [50.0, 95.0, 99.0])
        return cls(float(times_ms.mean()), float(p50), float(p95), float(p99), float(times_ms.max()))


@dataclass(frozen=True)
class RunScores:
    """Availability and cost of an estimator's run, which do not need the ground truth."""

    frames: int
    """Number of frames of the recording."""
    poses: int
    """Number of frames with a valid pose."""
    initialization_s: float | None
    """Time from the first frame to the first valid pose [s]; None if there is none."""
    coverage_percent: float | None
    """Share of the frames later than 3 s after the first that have a valid pose [%]; None without such frames."""
    lost_frames: int
    """Number of frames without a valid pose after the first valid pose."""
    resets: int
    """Number of times that valid poses began again after frames without one."""
    cpu_ms: Latency | None
    """Processor time of all threads per frame [ms]; None without frames."""
    latency_ms: Latency | None
    """Elapsed time per frame [ms]; None without frames."""
    real_time_factor: float | None
    """Seconds of flight per second of processor time; None if no time was measured."""
    real_time_factor_wall: float | None
    """Seconds of flight per second of elapsed time; None if no time was measured."""


def score_run(run: EstimatorRun) -> RunScores:
    """Return the availability and cost of an estimator's run."""
    t_ns, poses_ns = run.t_ns, run.trajectory.t_ns
    valid = np.array([e.health in POSE_IS_VALID and e.state is not None for e in run.estimates], dtype=bool)
    since_first = valid[int(np.argmax(valid)) :] if valid.any() else valid[:0]
    return RunScores(
        frames=len(t_ns),
        poses=len(poses_ns),
        initialization_s=initialization_s(t_ns, poses_ns),
        coverage_percent=coverage_percent(t_ns, poses_ns),
        lost_frames=int(np.sum(~since_first)),
        resets=int(np.sum(~since_first[:-1] & since_first[1:])),
        cpu_ms=Latency.of(run.cpu_ms) if len(t_ns) else None,
        latency_ms=Latency.of(run.wall_ms) if len(t_ns) else None,
        real_time_factor=run.real_time_factor,
        real_time_factor_wall=real_time_factor(t_ns, run.wall_ms),
    )
