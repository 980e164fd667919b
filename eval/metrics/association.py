"""Association: which true pose belongs to which estimated one."""

import numpy as np
import numpy.typing as npt

from dronevio.models.imu import Times
from dronevio.models.rotation import slerp_quat_wxyz
from dronevio.models.state import Trajectory

Rows = npt.NDArray[np.int64]

SAME_INSTANT_NS = 1_000
"""Time stamps that differ by no more are the same [ns]: many programs write microseconds."""


def interpolate(truth: Trajectory, t_ns: Times, max_gap_s: float = 0.5) -> tuple[Trajectory, Rows]:
    """Return the true poses at the given instants, and the instants' rows, where the truth is known.

    Positions are interpolated linearly, orientations along the shorter arc. Nothing is extrapolated, beyond the
    rounding of a time stamp, and no gap of the truth longer than ``max_gap_s`` is bridged.

    Args:
        truth: The true motion.
        t_ns: (N,) Instants [ns], increasing.
        max_gap_s: The longest interval between true poses that is interpolated [s].

    Returns:
        The truth at M of the instants (positions and orientations only), and their rows (M,).
    """
    if len(truth) == 0 or len(t_ns) == 0:
        return truth[:0], np.zeros(0, np.int64)
    t = np.clip(t_ns, truth.t_ns[0], truth.t_ns[-1])
    before = np.searchsorted(truth.t_ns, t, side="right") - 1
    after = np.searchsorted(truth.t_ns, t, side="left")  # the same row where a true pose stands at that instant
    gap_ns = truth.t_ns[after] - truth.t_ns[before]
    rows = np.flatnonzero((np.abs(t_ns - t) <= SAME_INSTANT_NS) & (gap_ns <= max_gap_s * 1e9))
    t, before, after, gap_ns = t[rows], before[rows], after[rows], gap_ns[rows]
    fraction = (t - truth.t_ns[before]) / np.maximum(gap_ns, 1)
    p0, p1 = truth.p_world_imu[before], truth.p_world_imu[after]
    quat_wxyz = slerp_quat_wxyz(truth.quat_wxyz[before], truth.quat_wxyz[after], fraction)
    return Trajectory(t_ns[rows], p0 + fraction[:, None] * (p1 - p0), quat_wxyz), rows


def nearest(t_truth_ns: Times, t_estimate_ns: Times, max_gap_s: float = 0.01) -> tuple[Rows, Rows]:
    """Return the rows (M,) of truth and estimate that belong together because they are close in time.

    Each estimated pose takes the true one nearest in time, if it is within ``max_gap_s``; of several that would
    take the same, the nearest has it.
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
    """Return for each wanted instant the row of ``t_ns`` (at least one, increasing) that is nearest in time."""
    after = np.clip(np.searchsorted(t_ns, wanted_ns), 0, len(t_ns) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(wanted_ns - t_ns[before] <= np.abs(t_ns[after] - wanted_ns), before, after)
