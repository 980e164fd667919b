"""Tours through relative waypoints in a given duration, without limits."""

import numpy as np

from dronevio.models.arrays import Array
from dronevio.sim.paths.minimum_snap import minimum_snap

_CHECK_STEP_S = 0.01  # interval of the comparison with the free space


def timed_knots(fractions: Array, tour_s: float, reach: Array) -> tuple[Array, Array, Array]:
    """Return times (K,) from 0 [s], points (K, 3) relative to the hover [m] and headings (K,) [rad] of a tour.

    The waypoints are scaled by a common factor on each axis until the spline through them stays within reach.

    Args:
        fractions: (M, 3) Relative waypoints: ±1 is the usable extent on an axis, 0 the hover.
        tour_s: Duration from the hover and back to it [s].
        reach: (2, 3) Usable extent relative to the hover, below and above on each axis [m].
    """
    if not len(fractions):
        return np.array([0.0, tour_s]), np.zeros((2, 3)), np.zeros(2)
    offsets = np.where(fractions < 0.0, -fractions * reach[0], fractions * reach[1])
    offsets = np.vstack([np.zeros(3), offsets, np.zeros(3)])
    knots = _allot_time(offsets, tour_s)
    dense = np.arange(0.0, tour_s, _CHECK_STEP_S)
    excursion = minimum_snap(knots, offsets)(dense)
    overshoot = np.maximum(excursion / np.where(reach[1] > 0.0, reach[1], np.inf), 0.0)
    undershoot = np.maximum(excursion / np.where(reach[0] < 0.0, reach[0], -np.inf), 0.0)
    offsets = offsets / np.maximum(1.0, np.maximum(overshoot, undershoot).max(axis=0))
    return knots, offsets, _headings(knots, offsets)


def _allot_time(points: Array, total_s: float) -> Array:
    """Return times (K,) of points (K, 3) by distance, with 1.5 times the duration for the first and last leg."""
    weight = np.linalg.norm(np.diff(points, axis=0), axis=1) ** 0.6  # long legs are flown at higher speed
    weight[[0, -1]] *= 1.5
    return np.asarray(np.concatenate([[0.0], np.cumsum(weight)]) * total_s / weight.sum())


def _headings(knots: Array, points: Array) -> Array:
    """Return smoothed headings (K,) along the path [rad]; 0 at first, and the last one held at the end."""
    velocity = minimum_snap(knots, points).derivative()(knots[1:-1])
    along = np.unwrap(np.concatenate([[0.0], np.arctan2(velocity[:, 1], velocity[:, 0])]))
    along = np.append(along, along[-1])
    smooth = along.copy()
    smooth[1:-1] = 0.2 * along[:-2] + 0.6 * along[1:-1] + 0.2 * along[2:]
    return smooth
