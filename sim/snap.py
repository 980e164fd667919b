"""Minimum-snap curves through waypoints, and the times that fly them as quickly as the limits allow.

Of all curves through given points at given times, at rest at both ends, the spline of degree 7 has the least integral
of squared snap (Mellinger and Kumar, "Minimum snap trajectory generation and control for quadrotors", 2011; Schoenberg
for splines in general). Nobody gives the times: here each leg is stretched or squeezed until its strain, the share of
the limits that it uses up, is that of the others, and at last all of them together until the greatest strain is 1.
"""

import numpy as np
import numpy.typing as npt
from scipy.interpolate import BSpline, make_interp_spline

from dronevio.sim.limits import Limits

Array = npt.NDArray[np.float64]

SAMPLES_PER_LEG = 16
"""Where a leg's strain is looked at, evenly in time; a leg is a polynomial of degree 7, so nothing hides between."""

_DEGREE = 7
_ZERO_AT_ENDS = (1, 2, 3)  # velocity, acceleration and jerk: the orders of derivatives
_ROUNDS = 24  # of evening out the strain; the total time no longer changes by a percent after ten
_EAGERNESS = 0.4  # exponent of the strain by which a leg's duration changes; 1 would overshoot
_BOUNDS = (0.7, 1.5)  # by which factor a leg's duration may change in one round
_LEAST_LEG_S = 1e-3
_HALVINGS = 40  # of the bracket around the time scale


def minimum_snap(knots: Array, points: Array) -> BSpline:
    """Return the minimum-snap curve through points (K,) or (K, D) at times (K,), at rest at both ends."""
    at_rest = [(order, np.zeros(points.shape[1:])) for order in _ZERO_AT_ENDS]
    return make_interp_spline(knots, points, k=_DEGREE, bc_type=(at_rest, at_rest))


def leg_times(knots: Array) -> Array:
    """Return times (K - 1, S) within each leg between knots (K,), its ends included."""
    return np.asarray(knots[:-1, None] + np.diff(knots)[:, None] * np.linspace(0.0, 1.0, SAMPLES_PER_LEG))


def quickest_knots(points: Array, limits: Limits, knots: Array | None = None) -> Array:
    """Return times (K,) from 0 at which the minimum-snap curve through points (K, 3) is quick and within limits.

    Args:
        points: Where to fly [m]; consecutive ones differ.
        limits: What the curve may not exceed, and reaches in one place at least.
        knots: Times to start the search from; by default legs flown at the greatest speed.
    """
    legs = np.diff(knots) if knots is not None else _first_guess(points, limits)
    best: Array = np.zeros(0)
    for _ in range(_ROUNDS):
        knots = np.concatenate([[0.0], np.cumsum(legs)])
        derivatives = _derivatives(minimum_snap(knots, points), leg_times(knots))
        scale = _least_scale(derivatives, limits)
        if not len(best) or knots[-1] * scale < best[-1]:
            best = knots * scale
        strain = limits.strain(*_stretched(derivatives, scale)).max(axis=1)
        legs = np.maximum(legs * scale * np.clip(strain**_EAGERNESS, *_BOUNDS), _LEAST_LEG_S)
    return best


def _first_guess(points: Array, limits: Limits) -> Array:
    """Return durations (K - 1,) of legs [s] that are flown at full speed where they are long enough to reach it."""
    length = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return np.asarray(np.maximum(length / limits.speed_m_s, np.sqrt(length / limits.accel_m_s2)))


def _derivatives(curve: BSpline, t: Array) -> tuple[Array, Array, Array]:
    """Return velocity, acceleration and jerk (…, 3) of a curve at times (…)."""
    velocity, acceleration, jerk = (curve.derivative(order)(t) for order in (1, 2, 3))
    return velocity, acceleration, jerk


def _stretched(derivatives: tuple[Array, Array, Array], scale: float) -> tuple[Array, Array, Array]:
    """Return what velocity, acceleration and jerk become where all times are multiplied by ``scale``."""
    velocity, acceleration, jerk = derivatives
    return velocity / scale, acceleration / scale**2, jerk / scale**3


def _least_scale(derivatives: tuple[Array, Array, Array], limits: Limits) -> float:
    """Return the factor by which to multiply all times for the greatest strain to be 1."""
    low, high = 1e-3, 1.0
    while limits.strain(*_stretched(derivatives, high)).max() > 1.0:
        low, high = high, 2.0 * high
    for _ in range(_HALVINGS):
        middle = np.sqrt(low * high)
        if limits.strain(*_stretched(derivatives, middle)).max() > 1.0:
            low = middle
        else:
            high = middle
        if high < 1.0001 * low:
            break
    return float(high)
