"""Errors at the beginning of an estimate, which measure its initialization, and discontinuities of an estimate."""

from dataclasses import dataclass

import numpy as np

from dronevio.eval.metrics.alignment import align
from dronevio.eval.metrics.association import interpolate
from dronevio.eval.metrics.errors import relative_errors
from dronevio.eval.metrics.scores import ScoredTrajectory
from dronevio.models.arrays import Array
from dronevio.models.imu import Times
from dronevio.models.state import Trajectory

SPAN_S = 2.0
"""Time after the first frame or pose to which the errors of an initialization refer [s]."""
_WINDOW = 11  # samples of a truth without velocities from which a velocity is computed
_STEPS = 20  # intervals of the accelerations, long enough for the noise of a truth without velocities
_MIN_POSES = 10  # for a scale


@dataclass(frozen=True)
class StartErrors:
    """Errors of an initialization; None where the truth or the estimate is too short, or has no velocities."""

    acceleration_m_s2: float | None
    """Root mean square of the true acceleration in the first two seconds after the first frame [m/s²]: with little of
    it, the scale is hardly observable with one camera."""
    velocity_m_s: float | None
    """Error of the velocity two seconds after the first pose, with yaw aligned over the whole estimate [m/s]."""
    speed_m_s: float | None
    """True speed at that time [m/s]."""
    scale_percent: float | None
    """Relative error of the scale in the two seconds after the first pose, positive if it is too large [%]."""


def start_errors(truth: Trajectory, scored: ScoredTrajectory, first_frame_ns: int) -> StartErrors:
    """Return the errors of an initialization.

    Args:
        truth: Ground truth; without velocities, they are computed from its positions.
        scored: The estimate, aligned with the truth.
        first_frame_ns: Time stamp of the first frame [ns].
    """
    estimate = scored.estimate
    end_ns = int(estimate.t_ns[0]) + round(SPAN_S * 1e9)
    row = int(np.searchsorted(estimate.t_ns, end_ns))
    begun = scored.truth[: row + 1], estimate[: row + 1]
    scale = start_scale(*begun)
    moving = _with_velocities(truth)
    velocity_m_s: float | None = None
    speed_m_s: float | None = None
    if row < len(estimate) and estimate.velocity_m_s is not None and moving is not None:
        then, known = interpolate(moving, estimate.t_ns[row : row + 1])
        if len(known) and then.velocity_m_s is not None:
            velocity_m_s = float(np.linalg.norm(estimate.velocity_m_s[row] - then.velocity_m_s[0]))
            speed_m_s = float(np.linalg.norm(then.velocity_m_s[0]))
    acceleration_m_s2 = None if moving is None else _acceleration_m_s2(moving, first_frame_ns)
    return StartErrors(acceleration_m_s2, velocity_m_s, speed_m_s, None if scale is None else 100.0 * (scale - 1.0))


def start_scale(truth: Trajectory, estimate: Trajectory) -> float | None:
    """Return the ratio of estimated to true displacements from their mean, after alignment of yaw.

    Args:
        truth: N true poses at the times of the estimate.
        estimate: N estimated poses.

    Returns:
        The ratio; None with fewer than ten poses, or if the vehicle is at rest.
    """
    if len(truth) < _MIN_POSES:
        return None
    R = align(truth.p_world_imu, estimate.p_world_imu, "yaw").R_truth_estimate
    a = truth.p_world_imu - truth.p_world_imu.mean(axis=0)
    b = (estimate.p_world_imu - estimate.p_world_imu.mean(axis=0)) @ R.T
    moved = float((a * a).sum())
    return float((a * b).sum()) / moved if moved > 1e-6 * len(a) else None


def largest_step_error_m(scored: ScoredTrajectory) -> float:
    """Return the largest error of a step from one pose to the next, in the frame of its first pose [m].

    A jump of the estimate, which disturbs a controller, is such an error.
    """
    true, estimate = scored.truth, scored.estimate
    rows = np.arange(len(true))
    metres, _ = relative_errors(
        true.p_world_imu, true.quat_wxyz, estimate.p_world_imu, estimate.quat_wxyz, (rows[:-1], rows[1:])
    )
    return float(metres.max())


def velocities_m_s(t_ns: Times, p: Array) -> Array:
    """Return velocities (N, 3) [m/s] of positions (N, 3) at times (N,), N ≥ 11: the slopes of lines through 11 points.

    The first and the last five velocities are those of the first and last 11 points.
    """
    t_s = (t_ns - t_ns[0]) * 1e-9
    times = np.lib.stride_tricks.sliding_window_view(t_s, _WINDOW)
    positions = np.lib.stride_tricks.sliding_window_view(p, _WINDOW, axis=0)  # (M, 3, 11)
    centred = times - times.mean(axis=1, keepdims=True)
    slopes = np.einsum("nw,nkw->nk", centred, positions) / (centred**2).sum(axis=1)[:, None]
    return np.pad(slopes, ((_WINDOW // 2, _WINDOW // 2), (0, 0)), mode="edge")


def _with_velocities(truth: Trajectory) -> Trajectory | None:
    """Return a truth with velocities, computed from positions if it has none; None if it is too short."""
    if truth.velocity_m_s is not None:
        return truth
    if len(truth) < _WINDOW:
        return None
    return Trajectory(truth.t_ns, truth.p_world_imu, truth.quat_wxyz, velocities_m_s(truth.t_ns, truth.p_world_imu))


def _acceleration_m_s2(truth: Trajectory, first_ns: int) -> float | None:
    """Return the root mean square of the acceleration within `SPAN_S` after a time; None without motion data then."""
    rows = (truth.t_ns >= first_ns) & (truth.t_ns <= first_ns + round(SPAN_S * 1e9))
    beginning = truth[rows]
    coarse = beginning[:: max(len(beginning) // _STEPS, 1)]
    if len(coarse) < 2 or coarse.velocity_m_s is None:
        return None
    rates = np.diff(coarse.velocity_m_s, axis=0) / np.diff(coarse.t_s)[:, None]
    return float(np.sqrt(np.mean(np.sum(rates**2, axis=1))))
