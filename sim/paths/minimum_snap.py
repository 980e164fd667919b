"""Minimum-snap curves through waypoints, and their times for the fastest motion within limits.

Of all curves through given points at given times, at rest at both ends, the spline of degree 7 has the smallest
integral of squared snap (Mellinger and Kumar, "Minimum snap trajectory generation and control for quadrotors", 2011;
Schoenberg for splines in general). The times minimize the total duration under the limits of the motion by a sequence
of linear programs in a trust region (Fletcher and Sainz de la Maza, "Nonlinear programming and nonsmooth optimization
by successive linear programming", 1989).
"""

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline
from scipy.optimize import linprog
from scipy.sparse import coo_array

from dronevio.models.arrays import Array
from dronevio.sim.paths.limits import Limits

_DEGREE = 7
_ZERO_AT_ENDS = (1, 2, 3)  # velocity, acceleration and jerk: the orders of derivatives
_SAMPLES_PER_LEG = 12  # samples of the limit ratio on each leg during the search
_FINAL_SAMPLES = 60  # and at its end; a polynomial of degree 7 varies little between them
_SHARE = 0.6  # exponent of the initial duration as a function of the length of a leg
_AT_ENDS = 1.5  # initial factor of the first and last leg, which start or end at rest
_ROUNDS = 15  # largest number of linear programs; further ones gain less than a percent
_TRUST = 0.4  # initial trust region: relative change of a leg's duration
_LEAST_TRUST, _LEAST_GAIN = 0.02, 0.002  # trust region and relative gain at which the search ends
_NUDGE = 0.01  # relative step of the finite differences
_FAR = 6  # distance of legs with negligible mutual influence, which falls by 2/3 per leg
_HALVINGS = 40  # bisections of the bracket of the time scale


def minimum_snap(knots: Array, points: Array) -> BSpline:
    """Return the minimum-snap curve through points (K,) or (K, D) at times (K,), at rest at both ends."""
    at_rest = [(order, np.zeros(points.shape[1:])) for order in _ZERO_AT_ENDS]
    return make_interp_spline(knots, points, k=_DEGREE, bc_type=(at_rest, at_rest))


def minimum_time_knots(points: Array, limits: Limits, knots: Array | None = None, rounds: int = _ROUNDS) -> Array:
    """Return times (K,) from 0 of a fast minimum-snap curve through points (K, 3) within limits [s].

    Args:
        points: Waypoints [m]; consecutive ones differ.
        limits: Limits of the motion, one of which the curve reaches.
        knots: Initial times of the search; by default from the lengths of the legs.
        rounds: Largest number of iterations.
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
    """Return initial durations (K - 1,) of legs as a function of their lengths, up to a common scale."""
    legs = np.linalg.norm(np.diff(points, axis=0), axis=1) ** _SHARE
    legs[[0, -1]] *= _AT_ENDS
    return np.asarray(legs)


def _improvement(legs: Array, points: Array, limits: Limits, trust: float) -> Array:
    """Return the relative changes (K - 1,) of durations with the smallest sum, with limit ratios of at most 1.

    The Jacobian is computed by finite differences of every sixth duration at once, since each affects its neighbours
    only.
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
    """Return the largest limit ratio (K - 1,) on each leg of the minimum-snap curve with these durations [s]."""
    return np.asarray(limits.limit_ratio(*_derivatives(legs, points)).max(axis=0))


def _scaled_to_limits(legs: Array, points: Array, limits: Limits, samples: int = _SAMPLES_PER_LEG) -> Array:
    """Return the durations (K - 1,) scaled by a common factor so that the largest limit ratio is 1."""
    return legs * _least_scale(_derivatives(legs, points, samples), limits)


def _derivatives(legs: Array, points: Array, samples: int = _SAMPLES_PER_LEG) -> tuple[Array, Array, Array]:
    """Return velocity, acceleration and jerk (S, K - 1, 3) at times evenly spaced over each leg."""
    knots = np.concatenate([[0.0], np.cumsum(legs)])
    curve = minimum_snap(knots, points)
    t = np.linspace(knots[:-1], knots[1:], samples)
    velocity = curve.derivative()
    acceleration = velocity.derivative()
    return velocity(t), acceleration(t), acceleration.derivative()(t)


def _stretched(derivatives: tuple[Array, Array, Array], scale: float) -> tuple[Array, Array, Array]:
    """Return velocity, acceleration and jerk after multiplication of all times by ``scale``."""
    velocity, acceleration, jerk = derivatives
    return velocity / scale, acceleration / scale**2, jerk / scale**3


def _least_scale(derivatives: tuple[Array, Array, Array], limits: Limits) -> float:
    """Return the factor of all times for which the largest limit ratio is 1."""
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
