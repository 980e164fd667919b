"""Association of estimated poses with true poses by time stamp."""

from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.errors import EvaluationError, unknown_name
from dronevio.models.imu import Times
from dronevio.models.quaternions import slerp_quat_wxyz
from dronevio.models.state import Trajectory

Rows = npt.NDArray[np.int64]

Association = Literal["interpolate", "nearest", "evo"]
"""How the true pose of an estimated pose is found: interpolated at its time stamp; the nearest in time, which is used
once at most; or as evo does."""

SAME_INSTANT_NS = 1_000
"""Largest difference of equal time stamps [ns]; many programs write microseconds."""
_MAX_GAP_S = {"interpolate": 0.5, "nearest": 0.01, "evo": 0.01}
_MIN_POSES = 3


def associate(
    truth: Trajectory, estimate: Trajectory, how: Association = "interpolate", max_gap_s: float | None = None
) -> tuple[Trajectory, Trajectory]:
    """Return N true and N estimated poses at the same times.

    Args:
        truth: The true trajectory.
        estimate: The estimated trajectory.
        how: How the true pose of an estimated pose is found.
        max_gap_s: Longest gap of the truth that is interpolated, or largest time difference to the nearest true pose
            [s]; None for 0.5 s and 0.01 s, respectively.

    Raises:
        ConfigError: There is no such association.
        EvaluationError: Fewer than three poses can be associated.
    """
    if how not in get_args(Association):
        raise unknown_name("association", how, get_args(Association))
    limit_s = _MAX_GAP_S[how] if max_gap_s is None else max_gap_s
    if how == "interpolate":
        true, rows = interpolate(truth, estimate.t_ns, limit_s)
        estimated = estimate[rows]
    else:
        pair = nearest if how == "nearest" else evo_pairs
        true_rows, rows = pair(truth.t_ns, estimate.t_ns, limit_s)
        # evo may use a row of the longer trajectory several times; only time stamps of the shorter one increase.
        by_truth = how == "evo" and len(estimate) > len(truth)
        t_ns = truth.t_ns[true_rows] if by_truth else estimate.t_ns[rows]
        true, estimated = _restamped(truth, true_rows, t_ns), _restamped(estimate, rows, t_ns)
    if len(rows) < _MIN_POSES:
        raise EvaluationError(
            f"truth ({_span(truth)}) and estimate ({_span(estimate)}) have {len(rows)} poses in common;"
            f" expected at least {_MIN_POSES}"
        )
    return true, estimated


def interpolate(truth: Trajectory, t_ns: Times, max_gap_s: float = 0.5) -> tuple[Trajectory, Rows]:
    """Return the true poses at given times, and the rows of those times at which the truth is known.

    Positions, velocities and biases are interpolated linearly, orientations by slerp. Nothing is extrapolated beyond
    the rounding of a time stamp, and gaps of the truth longer than ``max_gap_s`` are not interpolated.

    Args:
        truth: The true trajectory.
        t_ns: (N,) Increasing time stamps [ns].
        max_gap_s: Longest interval between true poses that is interpolated [s].

    Returns:
        The true trajectory at M of the times, without covariances, and the rows (M,) of these times.
    """
    if len(truth) == 0 or len(t_ns) == 0:
        return truth[:0], np.zeros(0, np.int64)
    t = np.clip(t_ns, truth.t_ns[0], truth.t_ns[-1])
    before = np.searchsorted(truth.t_ns, t, side="right") - 1
    after = before + (truth.t_ns[before] < t)  # the same row if there is a true pose at that time
    gap_ns = truth.t_ns[after] - truth.t_ns[before]
    rows = np.flatnonzero((np.abs(t_ns - t) <= SAME_INSTANT_NS) & (gap_ns <= max_gap_s * 1e9))
    t, before, after, gap_ns = t[rows], before[rows], after[rows], gap_ns[rows]
    fraction = (t - truth.t_ns[before]) / np.maximum(gap_ns, 1)

    def between(values: Array | None) -> Array | None:
        return None if values is None else values[before] + fraction[:, None] * (values[after] - values[before])

    quat_wxyz, moving = truth.quat_wxyz[before], np.flatnonzero(gap_ns)
    if len(moving):
        ends = quat_wxyz[moving], truth.quat_wxyz[after[moving]]
        quat_wxyz[moving] = slerp_quat_wxyz(*ends, fraction[moving])
    p = between(truth.p_world_imu)
    assert p is not None
    others = (between(v) for v in (truth.velocity_m_s, truth.gyro_bias_rad_s, truth.accel_bias_m_s2))
    return Trajectory(t_ns[rows], p, quat_wxyz, *others), rows


def nearest(t_truth_ns: Times, t_estimate_ns: Times, max_gap_s: float = 0.01) -> tuple[Rows, Rows]:
    """Return the rows (M,) of truth and estimate that are paired because they are nearest in time.

    Each estimated pose is paired with the nearest true pose within ``max_gap_s``. Of several estimated poses with the
    same nearest true pose, the nearest one is kept.
    """
    if len(t_truth_ns) == 0 or len(t_estimate_ns) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    rows = nearest_rows(t_truth_ns, t_estimate_ns)
    gap_ns = np.abs(t_truth_ns[rows] - t_estimate_ns)
    order = np.lexsort((gap_ns, rows))
    first = order[np.unique(rows[order], return_index=True)[1]]
    kept = first[gap_ns[first] <= max_gap_s * 1e9]
    return rows[kept], kept


def nearest_rows(t_ns: Times, wanted_ns: Times) -> Rows:
    """Return the row of increasing time stamps ``t_ns`` (N,), N > 0, that is nearest to each of ``wanted_ns`` (M,)."""
    after = np.clip(np.searchsorted(t_ns, wanted_ns), 0, len(t_ns) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(wanted_ns - t_ns[before] <= np.abs(t_ns[after] - wanted_ns), before, after)


def evo_pairs(t_truth_ns: Times, t_estimate_ns: Times, max_gap_s: float = 0.01) -> tuple[Rows, Rows]:
    """Return the rows (M,) of truth and estimate that evo pairs, in order to reproduce its figures.

    Each pose of the shorter trajectory is paired with the nearest one of the longer trajectory, which may be used
    several times. Times are compared in seconds as doubles, whose resolution is 0.24 µs for Unix time, so that rounding
    decides between two poses that are equally near.
    """
    if len(t_truth_ns) == 0 or len(t_estimate_ns) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    estimate_is_longer = len(t_estimate_ns) > len(t_truth_ns)
    short, long = _seconds(t_estimate_ns), _seconds(t_truth_ns)
    if estimate_is_longer:
        short, long = long, short
    after = np.minimum(np.searchsorted(long, short, side="right"), len(long) - 1)
    before = np.maximum(after - 1, 0)
    rows = np.where(long[after] - short < np.where(after > 0, short - long[before], np.inf), after, before)
    kept = np.flatnonzero(np.abs(long[rows] - short) <= max_gap_s)
    return (kept, rows[kept]) if estimate_is_longer else (rows[kept], kept)


def _seconds(t_ns: Times) -> Array:
    """Return times [s] as doubles with a single rounding."""
    whole = t_ns // 10**9
    return np.asarray(whole + (t_ns - whole * 10**9) / 1e9)


def _restamped(trajectory: Trajectory, rows: Rows, t_ns: Times) -> Trajectory:
    """Return rows (M,) of a trajectory, which may repeat, with other time stamps (M,) [ns]."""

    def pick(values: Array | None) -> Array | None:
        return None if values is None else values[rows]

    return Trajectory(
        t_ns,
        trajectory.p_world_imu[rows],
        trajectory.quat_wxyz[rows],
        pick(trajectory.velocity_m_s),
        pick(trajectory.gyro_bias_rad_s),
        pick(trajectory.accel_bias_m_s2),
        pick(trajectory.covariance),
    )


def _span(trajectory: Trajectory) -> str:
    """Return the time span of a trajectory for messages."""
    if len(trajectory) == 0:
        return "empty"
    return f"{trajectory.t_ns[0] * 1e-9:.3f} to {trajectory.t_ns[-1] * 1e-9:.3f} s"
