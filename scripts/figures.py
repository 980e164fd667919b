"""What a run is worth: all figures of one estimate of a flight, and of the times in it to look at closely."""

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
from dronevio.models.errors import EvaluationError
from dronevio.models.state import Estimate, Health, Trajectory

WORST = math.inf
"""What a failed run's errors count as."""
HOLDS_S = 0.5
"""So long an estimator must go on tracking before it counts as recovered [s]."""


@dataclass(frozen=True)
class Figures:
    """One run in figures. Of a failed one, errors are infinite, and what is not known is None."""

    flight: str
    """What was estimated."""
    mode: str
    """By whom: mono or stereo."""
    status: str = "ok"
    """How the run ended: ok, failed, timeout or crashed."""
    reason: str = ""
    """Why it is not ok, or what is wrong with it all the same."""
    frames: int = 0
    """Frames of the recording."""
    duration_s: float = 0.0
    """From the first frame to the last [s]."""
    path_m: float = math.nan
    """Length of the true path, frame by frame over the whole recording [m]."""
    ate_m: float = WORST
    """Absolute error of position, yaw and position aligned, root mean square [m]."""
    max_m: float = WORST
    """The largest of these errors [m]."""
    ate_deg: float = WORST
    """Absolute error of orientation, root mean square [°]."""
    rpe_m: float = WORST
    """Relative error of position over one second, root mean square [m]."""
    rpe_deg: float = WORST
    """Relative error of orientation over one second, root mean square [°]."""
    end_m: float = WORST
    """Error of the last position, where the first poses meet [m]."""
    scale_error_percent: float | None = None
    """By how much the estimated path is too large [%]."""
    coverage_percent: float = 0.0
    """Share of the frames later than 3 s after the first that have a pose [%]."""
    first_s: float = WORST
    """From the first frame to the first pose [s]."""
    nees_position: float = WORST
    """Squared error of position in units of its covariance, mean over time, gauge fixed at the first pose."""
    nees_orientation: float = WORST
    """The same of orientation."""
    nees_position_over_time: tuple[float, ...] = ()
    """NEES of position at each second since the first pose."""
    nees_orientation_over_time: tuple[float, ...] = ()
    """NEES of orientation at each second since the first pose."""
    cpu_ms_mean: float | None = None
    """Processor time a frame, of all threads [ms]."""
    cpu_ms_p99: float | None = None
    """Its 99th percentile [ms]."""
    cpu_ms_max: float | None = None
    """The most that one frame cost [ms]."""
    health: dict[str, float] = field(default_factory=dict)
    """Share of the frames in each state of health [%]."""
    longest_gap_s: float = WORST
    """Longest time between two poses [s]."""
    step_error_m: float = WORST
    """Largest difference between an estimated step from one frame to the next and the true step [m]."""
    step_jump_m: float = WORST
    """Largest difference between an estimated step and the one that the estimated velocities explain [m]."""
    step_jump_s: float | None = None
    """When that was, from the first frame [s]."""
    window_drift_m: float | None = None
    """Largest error of position since the beginning of the time to look at closely [m]; None where there is none."""
    recovery_s: float | None = None
    """From its end until the estimator says for half a second that it is tracking [s]."""
    not_finite: int = 0
    """Estimates in which a number is not finite."""
    peak_mb: float | None = None
    """The most memory that the process held [MB]."""

    @property
    def ate_percent(self) -> float:
        """Absolute error as a share of the path [%]."""
        return 100.0 * self.ate_m / self.path_m if math.isfinite(self.ate_m) else WORST

    @property
    def failed(self) -> bool:
        """Whether it did not end well: no score, frames without poses, or an error above 1 % of the path."""
        return self.status != "ok" or self.coverage_percent < 99.0 or self.ate_percent > 1.0


def figures_of(
    flight: str, mode: str, run: EstimatorRun, truth: Trajectory, frame_times_ns: npt.NDArray[np.int64]
) -> Figures:
    """Return the figures of a run."""
    at_frames, _ = interpolate(truth, frame_times_ns)
    bare = Figures(
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
    if bare.not_finite:
        return replace(bare, status="failed", reason=f"{bare.not_finite} estimates are not finite")
    estimate, reason = run.trajectory, ""
    try:
        scored = score_trajectory(truth, estimate, frame_times_ns)
    except EvaluationError as error:
        reason, estimate = str(error), replace(estimate, covariance=None)
        try:
            scored = score_trajectory(truth, estimate, frame_times_ns)
        except EvaluationError:
            return replace(bare, status="failed", reason=reason)
    s = scored.scores
    assert s.rpe_m is not None and s.rpe_deg is not None
    step_error_m, step_jump_m, when_s = steps(scored.truth, estimate, int(frame_times_ns[0]))
    found = replace(
        bare,
        reason=reason,
        ate_m=s.ate_m.rmse,
        max_m=s.ate_m.max,
        ate_deg=s.ate_deg.rmse,
        rpe_m=s.rpe_m.rmse,
        rpe_deg=s.rpe_deg.rmse,
        scale_error_percent=s.scale_error_percent,
        coverage_percent=s.coverage_percent or 0.0,
        first_s=WORST if s.initialized_s is None else s.initialized_s,
        longest_gap_s=s.longest_gap_s,
        step_error_m=step_error_m,
        step_jump_m=step_jump_m,
        step_jump_s=when_s,
    )
    if scored.consistency is None:
        return found
    c = scored.consistency
    each = [int(np.argmin(np.abs(c.t_ns - (c.t_ns[0] + t * 10**9)))) for t in range(1, int(np.ptp(c.t_ns) * 1e-9) + 1)]
    return replace(
        found,
        end_m=float(np.linalg.norm(c.position_error_m[-1])),
        nees_position=float(c.position_nees.mean()),
        nees_orientation=float(c.orientation_nees.mean()),
        nees_position_over_time=tuple(np.round(c.position_nees[each], 4).tolist()),
        nees_orientation_over_time=tuple(np.round(c.orientation_nees[each], 4).tolist()),
    )


def health_shares(estimates: Sequence[Estimate]) -> dict[str, float]:
    """Return the share of the frames in each state of health [%]."""
    counts = {health.value: sum(e.health == health for e in estimates) for health in Health}
    return {name: 100.0 * count / max(len(estimates), 1) for name, count in counts.items()}


def is_finite(estimate: Estimate) -> bool:
    """Say whether all numbers of an estimate are finite."""
    state = estimate.state
    if state is None:
        return True
    optional = (state.covariance, state.angular_velocity_rad_s)
    given = (state.T_world_imu, state.velocity_m_s, state.gyro_bias_rad_s, state.accel_bias_m_s2, *optional)
    return all(bool(np.isfinite(values).all()) for values in given if values is not None)


def steps(truth: Trajectory, estimate: Trajectory, start_ns: int) -> tuple[float, float, float | None]:
    """Return how far the largest step of an estimate is off, the largest that velocity does not explain, and when.

    A step leads from one pose to the next. It is compared with the true one, both seen from where they begin, and with
    the mean of the estimated velocities at its ends, times its duration: an estimate that is put elsewhere, a teleport,
    stands out in both.

    Args:
        truth: N true poses at the estimate's instants.
        estimate: N estimated poses with velocities.
        start_ns: From when times are counted [ns].
    """
    estimate = estimate[np.isin(estimate.t_ns, truth.t_ns)]
    if len(estimate) < 2 or estimate.velocity_m_s is None:
        return WORST, WORST, None
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
    """Return the largest error of position since the beginning of a time, where the poses meet [m].

    The first pose after the end counts as well: where the estimator is when it sees again. Infinite without poses.
    """
    estimate = run.trajectory
    t_s = (estimate.t_ns - run.t_ns[0]) * 1e-9
    last = int(np.searchsorted(t_s, window_s[1]))
    rows = (
        np.flatnonzero((t_s >= window_s[0]) & (t_s <= t_s[min(last, len(t_s) - 1)])) if len(t_s) else np.zeros(0, int)
    )
    if len(rows) < 2:
        return WORST
    estimate = estimate[rows]
    true, found = interpolate(truth, estimate.t_ns)
    estimate = estimate[found]
    moved = anchor_first(true, estimate).positions(estimate.p_world_imu)
    return float(translation_errors_m(true.p_world_imu, moved).max())


def recovery_s(run: EstimatorRun, end_s: float) -> float:
    """Return how long after a time the estimator begins to track for at least half a second [s]; infinite if never."""
    t_s = (run.t_ns - run.t_ns[0]) * 1e-9
    tracking = np.array([estimate.health == Health.TRACKING for estimate in run.estimates])
    bad_s = np.append(t_s[~tracking], math.inf)  # nothing is known beyond the end
    following = bad_s[np.searchsorted(bad_s, t_s)]
    good = np.flatnonzero((t_s >= end_s - 1e-6) & tracking & (following - t_s >= HOLDS_S))
    return float(t_s[good[0]] - end_s) if len(good) else WORST


def failures(rows: Iterable[Figures]) -> str:
    """Return a list of the runs that failed, and why; empty if none did."""
    lines = [f"- {row.flight} {row.mode}: {row.status}, {row.reason}" for row in rows if row.status != "ok"]
    return "\n".join(["", "Failed runs, which count as ∞:", *lines]) if lines else ""
