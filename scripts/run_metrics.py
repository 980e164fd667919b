"""Metrics of one run of the odometry, over the whole flight and over a time window of it."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from dronevio.eval.metrics.association import interpolate
from dronevio.eval.metrics.consistency import anchor_first
from dronevio.eval.metrics.errors import relative_errors, translation_errors_m
from dronevio.eval.metrics.scores import score_trajectory
from dronevio.eval.run import EstimatorRun
from dronevio.eval.tracking import tracking_sigmas
from dronevio.models.errors import EvaluationError
from dronevio.models.state import Estimate, Health, Trajectory

FAILED = math.inf
"""Error of a failed run."""
RECOVERED_S = 0.5
"""Time of uninterrupted tracking after which an estimator counts as recovered [s]."""


@dataclass(frozen=True)
class RunMetrics:
    """Metrics of one run. Errors of a failed run are infinite; a value that is not known is None."""

    flight: str
    """Name of the flight."""
    mode: str
    """Cameras of the estimator: mono or stereo."""
    status: str = "ok"
    """Status of the run: ok, failed, timeout or crashed."""
    reason: str = ""
    """Reason of another status than ok, or of a missing metric."""
    frames: int = 0
    """Number of frames of the recording."""
    duration_s: float = 0.0
    """Time from the first frame to the last [s]."""
    path_m: float = math.nan
    """Length of the true path from frame to frame over the whole recording [m]."""
    ate_m: float = FAILED
    """Absolute trajectory error of position after alignment of yaw and position, root mean square [m]."""
    max_m: float = FAILED
    """Largest absolute error of position [m]."""
    ate_deg: float = FAILED
    """Absolute trajectory error of orientation, root mean square [°]."""
    rpe_m: float = FAILED
    """Relative pose error of position over one second, root mean square [m]."""
    rpe_deg: float = FAILED
    """Relative pose error of orientation over one second, root mean square [°]."""
    end_m: float = FAILED
    """Error of the last position when the first poses are aligned [m]."""
    scale_error_percent: float | None = None
    """Scale error of the estimated path, positive if it is too large [%]."""
    coverage_percent: float = 0.0
    """Share of the frames with a pose, among those later than 3 s after the first [%]."""
    first_s: float = FAILED
    """Time from the first frame to the first pose [s]."""
    nees_position: float = FAILED
    """NEES of position with the gauge fixed at the first pose, mean over time."""
    nees_orientation: float = FAILED
    """NEES of orientation with the gauge fixed at the first pose, mean over time."""
    tracking_sigmas: float | None = None
    """Largest error of position while the estimator reports that it tracks, in standard deviations along the least
    certain axis; None without covariances."""
    nees_position_over_time: tuple[float, ...] = ()
    """NEES of position at each second since the first pose."""
    nees_orientation_over_time: tuple[float, ...] = ()
    """NEES of orientation at each second since the first pose."""
    cpu_ms_mean: float | None = None
    """Mean processor time per frame of all threads [ms]."""
    cpu_ms_p99: float | None = None
    """99th percentile of the processor time per frame [ms]."""
    cpu_ms_max: float | None = None
    """Largest processor time of a frame [ms]."""
    health: dict[str, float] = field(default_factory=dict)
    """Share of the frames in each state of health [%]."""
    longest_gap_s: float = FAILED
    """Longest time between two poses [s]."""
    step_error_m: float = FAILED
    """Largest difference between an estimated step from one frame to the next and the true step [m]."""
    step_jump_m: float = FAILED
    """Largest difference between an estimated step and the one that the estimated velocities explain [m]."""
    step_jump_s: float | None = None
    """Time of that step from the first frame on [s]."""
    window_drift_m: float | None = None
    """Largest error of position within the time window, whose first poses are aligned; None without a window [m]."""
    recovery_s: float | None = None
    """Time from the end of the window until the estimator tracks for half a second; None without a window [s]."""
    not_finite: int = 0
    """Number of estimates with a value that is not finite."""
    peak_mb: float | None = None
    """Peak memory of the process [MB]."""

    @property
    def ate_percent(self) -> float:
        """Absolute trajectory error of position relative to the length of the path [%]."""
        return 100.0 * self.ate_m / self.path_m if math.isfinite(self.ate_m) else FAILED

    @property
    def failed(self) -> bool:
        """Whether the run has no error, a coverage below 99 %, or an error above 1 % of the path."""
        return self.status != "ok" or self.coverage_percent < 99.0 or self.ate_percent > 1.0


def metrics_of(
    flight: str, mode: str, run: EstimatorRun, truth: Trajectory, frame_times_ns: npt.NDArray[np.int64]
) -> RunMetrics:
    """Return the metrics of a run.

    Args:
        flight: Name of the flight.
        mode: Cameras of the estimator.
        run: Estimates and processor times.
        truth: Ground truth of the IMU.
        frame_times_ns: (N,) Time stamps of all frames [ns].
    """
    at_frames, _ = interpolate(truth, frame_times_ns)
    basic = RunMetrics(
        flight,
        mode,
        frames=len(frame_times_ns),
        duration_s=float(np.ptp(frame_times_ns)) * 1e-9,
        path_m=at_frames.length_m,
        cpu_ms_mean=float(run.cpu_ms.mean()),
        cpu_ms_p99=float(np.percentile(run.cpu_ms, 99.0)),
        cpu_ms_max=float(run.cpu_ms.max()),
        health=health_shares(run.estimates),
        not_finite=sum(not is_finite(estimate) for estimate in run.estimates),
    )
    if basic.not_finite:
        return replace(basic, status="failed", reason=f"{basic.not_finite} estimates are not finite")
    estimate, reason = run.trajectory, ""
    try:
        scored = score_trajectory(truth, estimate, frame_times_ns)
    except EvaluationError as error:
        reason, estimate = str(error), replace(estimate, covariance=None)
        try:
            scored = score_trajectory(truth, estimate, frame_times_ns)
        except EvaluationError:
            return replace(basic, status="failed", reason=reason)
    s = scored.scores
    assert s.rpe_m is not None and s.rpe_deg is not None
    step_error_m, step_jump_m, when_s = steps(scored.truth, estimate, int(frame_times_ns[0]))
    metrics = replace(
        basic,
        reason=reason,
        ate_m=s.ate_m.rmse,
        max_m=s.ate_m.max,
        ate_deg=s.ate_deg.rmse,
        rpe_m=s.rpe_m.rmse,
        rpe_deg=s.rpe_deg.rmse,
        scale_error_percent=s.scale_error_percent,
        coverage_percent=s.coverage_percent or 0.0,
        first_s=FAILED if s.initialization_s is None else s.initialization_s,
        longest_gap_s=s.longest_gap_s,
        step_error_m=step_error_m,
        step_jump_m=step_jump_m,
        step_jump_s=when_s,
    )
    if scored.consistency is None:
        return metrics
    c = scored.consistency
    each_s = range(1, int(np.ptp(c.t_ns) * 1e-9) + 1)
    rows = [int(np.argmin(np.abs(c.t_ns - (c.t_ns[0] + t * 10**9)))) for t in each_s]
    return replace(
        metrics,
        end_m=float(np.linalg.norm(c.position_error_m[-1])),
        nees_position=float(c.position_nees.mean()),
        nees_orientation=float(c.orientation_nees.mean()),
        tracking_sigmas=tracking_sigmas(run, truth),
        nees_position_over_time=tuple(np.round(c.position_nees[rows], 4).tolist()),
        nees_orientation_over_time=tuple(np.round(c.orientation_nees[rows], 4).tolist()),
    )


def health_shares(estimates: Sequence[Estimate]) -> dict[str, float]:
    """Return the share of the frames in each state of health, by the name of the state [%]."""
    counts = {health.value: sum(e.health == health for e in estimates) for health in Health}
    return {name: 100.0 * count / max(len(estimates), 1) for name, count in counts.items()}


def is_finite(estimate: Estimate) -> bool:
    """Return whether all values of an estimate are finite."""
    state = estimate.state
    if state is None:
        return True
    optional = (state.covariance, state.angular_velocity_rad_s)
    given = (state.T_world_imu, state.velocity_m_s, state.gyro_bias_rad_s, state.accel_bias_m_s2, *optional)
    return all(bool(np.isfinite(values).all()) for values in given if values is not None)


def steps(truth: Trajectory, estimate: Trajectory, start_ns: int) -> tuple[float, float, float | None]:
    """Return the largest error of a step, the largest jump, and the time of the jump.

    A step leads from one pose to the next. Its error is the difference to the true step, both in the frame of their
    first pose. A jump is the difference between a step and the mean of the estimated velocities at its ends times its
    duration. A discontinuity of the estimate is large in both.

    Args:
        truth: True poses at the time stamps of the estimate.
        estimate: Estimated poses with velocities.
        start_ns: Time stamp from which the time of the jump is counted [ns].

    Returns:
        Largest error of a step [m], largest jump [m], and its time [s].
    """
    estimate = estimate[np.isin(estimate.t_ns, truth.t_ns)]
    if len(estimate) < 2 or estimate.velocity_m_s is None:
        return FAILED, FAILED, None
    rows = np.arange(len(estimate))
    metres, _ = relative_errors(
        truth.p_world_imu, truth.quat_wxyz, estimate.p_world_imu, estimate.quat_wxyz, (rows[:-1], rows[1:])
    )
    v, dt_s = estimate.velocity_m_s, np.diff(estimate.t_ns)[:, None] * 1e-9
    explained = 0.5 * (v[:-1] + v[1:]) * dt_s
    jumps_m = translation_errors_m(np.diff(estimate.p_world_imu, axis=0), explained)
    worst = int(jumps_m.argmax())
    return float(metres.max()), float(jumps_m[worst]), float(estimate.t_ns[worst + 1] - start_ns) * 1e-9


def window_drift_m(run: EstimatorRun, truth: Trajectory, window_s: tuple[float, float]) -> float:
    """Return the largest error of position within a time window, whose first poses are aligned [m].

    The first pose after the window counts as well: it is the first after a fault. The error is infinite without poses.

    Args:
        run: The run.
        truth: Ground truth of the IMU.
        window_s: Beginning and end of the window after the first frame [s].
    """
    estimate = run.trajectory
    t_s = (estimate.t_ns - run.t_ns[0]) * 1e-9
    last = int(np.searchsorted(t_s, window_s[1]))
    rows = (
        np.flatnonzero((t_s >= window_s[0]) & (t_s <= t_s[min(last, len(t_s) - 1)])) if len(t_s) else np.zeros(0, int)
    )
    if len(rows) < 2:
        return FAILED
    estimate = estimate[rows]
    true, rows = interpolate(truth, estimate.t_ns)
    estimate = estimate[rows]
    aligned_m = anchor_first(true, estimate).positions(estimate.p_world_imu)
    return float(translation_errors_m(true.p_world_imu, aligned_m).max())


def recovery_s(run: EstimatorRun, end_s: float) -> float:
    """Return the time from ``end_s`` until the estimator begins to track for `RECOVERED_S` [s]; infinite if never.

    Args:
        run: The run.
        end_s: Time after the first frame [s].
    """
    t_s = (run.t_ns - run.t_ns[0]) * 1e-9
    tracking = np.array([estimate.health == Health.TRACKING for estimate in run.estimates])
    interrupted_s = np.append(t_s[~tracking], math.inf)  # no interruption is known after the last frame
    next_s = interrupted_s[np.searchsorted(interrupted_s, t_s)]
    recovered = np.flatnonzero((t_s >= end_s - 1e-6) & tracking & (next_s - t_s >= RECOVERED_S))
    return float(t_s[recovered[0]] - end_s) if len(recovered) else FAILED


def failures(rows: Iterable[RunMetrics]) -> str:
    """Return a Markdown list of the runs whose status is not ok; an empty text if there are none."""
    lines = [f"- {row.flight} {row.mode}: {row.status}, {row.reason}" for row in rows if row.status != "ok"]
    return "\n".join(["", "Failed runs, whose errors count as ∞:", *lines]) if lines else ""
