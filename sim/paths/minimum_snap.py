"""Minimum-snap curves through waypoints, and the times that fly them as quickly as the limits allow.

Of all curves through given points at given times, at rest at both ends, the spline of degree 7 has the least integral
of squared snap (Mellinger and Kumar, "Minimum snap trajectory generation and control for quadrotors", 2011; Schoenberg
for splines in general). Nobody gives the times. Here the sum of the legs' durations is made as small as their strain,
the share of the limits that each uses up, lets it: a sequence of linear programs in a trust region (Fletcher and
Sainz de la Maza, "Nonlinear programming and nonsmooth optimization by successive linear programming", 1989).
"""

import numpy as np
import numpy.typing as npt
from scipy.interpolate import BSpline, make_interp_spline
from scipy.optimize import linprog
from scipy.sparse import coo_array

from dronevio.sim.paths.limits import Limits

Array = npt.NDArray[np.float64]

_DEGREE = 7
_ZERO_AT_ENDS = (1, 2, 3)  # velocity, acceleration and jerk: the orders of derivatives
_SAMPLES_PER_LEG = 12  # where a leg's strain is looked at during the search
_FINAL_SAMPLES = 60  # and at its end; the leg is a polynomial of degree 7, so nothing to speak of hides between
_SHARE = 0.6  # exponent by which a long leg takes longer at first: it is flown faster, too
_AT_ENDS = 1.5  # how much longer the first and the last leg take at first, since the drone stands there
_ROUNDS = 15  # of linear programs at most; what more of them win is below a percent
_TRUST = 0.4  # by which share a leg's duration may change in the first
_LEAST_TRUST, _LEAST_GAIN = 0.02, 0.002  # below this share the search ends
_NUDGE = 0.01  # share by which durations are changed to see what follows
_FAR = 6  # legs that are so far apart hardly feel each other: the influence of a spline's knot falls by 2/3 a leg
_HALVINGS = 40  # of the bracket around the time scale


def minimum_snap(knots: Array, points: Array) -> BSpline:
    """Return the minimum-snap curve through points (K,) or (K, D) at times (K,), at rest at both ends."""
    at_rest = [(order, np.zeros(points.shape[1:])) for order in _ZERO_AT_ENDS]
    return make_interp_spline(knots, points, k=_DEGREE, bc_type=(at_rest, at_rest))


def minimum_time_knots(points: Array, limits: Limits, knots: Array | None = None, rounds: int = _ROUNDS) -> Array:
    """Return times (K,) from 0 at which the minimum-snap curve through points (K, 3) is quick and within limits.

    Args:
        points: Where to fly [m]; consecutive ones differ.
        limits: What the curve may not exceed, and reaches in one place at least.
        knots: Times to start the search from; by default long legs take longer.
        rounds: How long to search.
    """
    legs = _scaled_to_limits(np.diff(knots) if knots is not None else _initial_durations(points), points, limits)
    trust = _TRUST
    for _ in range(rounds):
        trial = _scaled_to_limits(legs * np.exp(_improvement(legs, points, limits, trust)), points, limits)
        gain = 1.0 - trial.sum() / legs.sum()
        if gain > 0.0:
            legs = trial
        if gain < 0.25 * trust:
            trust *= 0.4
        if 0.0 < gain < _LEAST_GAIN or trust < _LEAST_TRUST:
            break
    return np.concatenate([[0.0], np.cumsum(_scaled_to_limits(legs, points, limits, _FINAL_SAMPLES))])


def _initial_durations(points: Array) -> Array:
    """Return durations (K - 1,) of legs, longer for longer ones, of any scale."""
    legs = np.linalg.norm(np.diff(points, axis=0), axis=1) ** _SHARE
    legs[[0, -1]] *= _AT_ENDS
    return np.asarray(legs)


def _improvement(legs: Array, points: Array, limits: Limits, trust: float) -> Array:
    """Return by which shares (K - 1,) to change the durations of legs for the least sum, all strains kept below 1.

    How strains depend on durations is found by changing every sixth of them at once: each touches its neighbours only.
    """
    count = len(legs)
    strain = _limit_ratios(legs, points, limits)
    rows, columns, slopes = [], [], []
    for colour in range(min(_FAR, count)):
        nudged = np.where(np.arange(count) % _FAR == colour, _NUDGE, 0.0)
        slope = (_limit_ratios(legs * np.exp(nudged), points, limits) - strain) / _NUDGE
        culprit = np.arange(count) + (colour - np.arange(count) + _FAR // 2) % _FAR - _FAR // 2
        known = (culprit >= 0) & (culprit < count)
        rows.append(np.flatnonzero(known))
        columns.append(culprit[known])
        slopes.append(slope[known])
    slope_of = coo_array((np.concatenate(slopes), (np.concatenate(rows), np.concatenate(columns))), (count, count))
    program = linprog(legs, slope_of.tocsr(), np.maximum(1.0 - strain, 0.0), bounds=(-trust, trust), method="highs")
    return np.zeros(count) if program.x is None else np.asarray(program.x)


def _limit_ratios(legs: Array, points: Array, limits: Limits) -> Array:
    """Return the greatest strain (K - 1,) on each leg of the minimum-snap curve with such durations [s]."""
    return np.asarray(limits.limit_ratio(*_derivatives(legs, points)).max(axis=0))


def _scaled_to_limits(legs: Array, points: Array, limits: Limits, samples: int = _SAMPLES_PER_LEG) -> Array:
    """Return the durations (K - 1,), all multiplied by the number that makes the greatest strain 1."""
    return legs * _least_scale(_derivatives(legs, points, samples), limits)


def _derivatives(legs: Array, points: Array, samples: int = _SAMPLES_PER_LEG) -> tuple[Array, Array, Array]:
    """Return velocity, acceleration and jerk (S, K - 1, 3) at times evenly spread over each leg."""
    knots = np.concatenate([[0.0], np.cumsum(legs)])
    curve = minimum_snap(knots, points)
    t = np.linspace(knots[:-1], knots[1:], samples)
    velocity, acceleration, jerk = (curve.derivative(order)(t) for order in (1, 2, 3))
    return velocity, acceleration, jerk


def _stretched(derivatives: tuple[Array, Array, Array], scale: float) -> tuple[Array, Array, Array]:
    """Return what velocity, acceleration and jerk become where all times are multiplied by ``scale``."""
    velocity, acceleration, jerk = derivatives
    return velocity / scale, acceleration / scale**2, jerk / scale**3


def _least_scale(derivatives: tuple[Array, Array, Array], limits: Limits) -> float:
    """Return the factor by which to multiply all times for the greatest strain to be 1."""
    low, high = 1e-3, 1.0
    while limits.limit_ratio(*_stretched(derivatives, high)).max() > 1.0:
        low, high = high, 2.0 * high
    for _ in range(_HALVINGS):
        middle = np.sqrt(low * high)
        if limits.limit_ratio(*_stretched(derivatives, middle)).max() > 1.0:
            low = middle
        else:
            high = middle
        if high < 1.0001 * low:
            break
    return float(high)
