"""Minimum-snap trajectories inside a corridor, from any state to rest.

A trajectory is a sequence of Bézier curves of degree 7, each in one box, continuous up to the jerk. A Bézier curve lies
in the convex hull of its control points, so that it stays in its box if these do. For given durations, the squared snap
is a quadratic function of the states at the joints, and the boxes bound linear functions of them: a quadratic program
for each axis. Durations are then changed until the motion reaches a limit and exceeds none.

A trajectory ends at rest. If the last one is flown on whenever there is no new one, the vehicle always stops inside the
corridor in which it is.

Sources: Mellinger and Kumar, "Minimum snap trajectory generation and control for quadrotors", 2011; Gao et al., "Online
safe trajectory generation for quadrotors using fast marching method and Bernstein basis polynomial", 2018.
"""

from dataclasses import dataclass
from functools import cache
from math import comb

import numpy as np
from scipy.interpolate import BPoly

from dronevio.autonomy.planning.corridor import Corridor
from dronevio.autonomy.planning.quadratic_program import bounded_minimum
from dronevio.models.arrays import Array
from dronevio.sim.paths.limits import Limits

_ORDERS = 4  # position, velocity, acceleration, jerk: half of the control points
_SAMPLES = 16  # of a piece, where its limits are checked; the limits have a reserve for what lies between
_ROUNDS = 10  # programs that are solved for a trajectory
_ALLOCATING = 5  # of them, in which the pieces change separately
_STRETCH = 1.02  # further duration if a limit is exceeded
_GAIN = 0.6  # exponent of the ratio to the limits by which the duration of a piece changes
_SCALES = (1.0, 0.7, 1.4)  # of the initial durations, tried in turn until there is a trajectory
_LEAST_S = 0.05  # duration of a piece
_INSIDE_M = 1e-4  # distance of control points from the faces of the box, within which the programs are solved
_RELAXATIONS = 20  # of the initial points on the portals toward the shortest path


@dataclass(frozen=True, eq=False)
class CorridorTrajectory:
    """Positions over time in a corridor, at rest at the end."""

    control_points: Array
    """(S, 8, 3) Control points of the pieces [m]."""
    knots_s: Array
    """(S + 1,) Times between the pieces, from 0 [s]."""
    boxes: Array
    """(S,) Index of the box of the corridor in which each piece lies."""

    @property
    def duration_s(self) -> float:
        """Time of the end, from which the vehicle is at rest [s]."""
        return float(self.knots_s[-1])

    @property
    def path(self) -> BPoly:
        """Function from times (N,) to positions (N, 3) in the frame of the corridor [m]."""
        return BPoly(np.moveaxis(self.control_points, 1, 0), self.knots_s)

    def state(self, time_s: float) -> Array:
        """Return position, velocity, acceleration and jerk (4, 3) at a time [m, s]; at rest after the end."""
        path = self.path
        time_s = min(max(time_s, 0.0), self.duration_s)
        return np.stack([path(time_s), *(path.derivative(order)(time_s) for order in range(1, _ORDERS))])


def corridor_trajectory(
    corridor: Corridor, start: Array, goal: Array | None, limits: Limits
) -> CorridorTrajectory | None:
    """Return a fast minimum-snap trajectory inside a corridor, or None if none was found.

    Args:
        corridor: Boxes from the one that contains the start to the one that contains the end.
        start: (4, 3) Position, velocity, acceleration and jerk at the start [m, s].
        goal: (3,) End [m]; None for any place in the last box, to stop.
        limits: Limits of the motion.
    """
    boxes = _boxes_of_pieces(len(corridor.low_m))
    low, high = corridor.low_m[boxes], corridor.high_m[boxes]
    legs = _initial_durations(low, high, start, goal, limits)
    for scale in _SCALES:
        found = _fastest(scale * legs, low, high, start, goal, limits)
        if found is not None:
            return CorridorTrajectory(found[0], np.append(0.0, np.cumsum(found[1])), boxes)
    return None


def _fastest(
    legs: Array, low: Array, high: Array, start: Array, goal: Array | None, limits: Limits
) -> tuple[Array, Array] | None:
    """Return the control points (S, 8, 3) and durations (S,) of the fastest curve found from initial durations (S,)."""
    best: tuple[Array, Array] | None = None
    for number in range(_ROUNDS):
        legs = _shortened_start(legs, start, low[0], high[0])
        points = _minimum_snap(legs, start, goal, low, high)
        if points is None:
            legs = legs * 0.8  # a start in motion leaves its box the further, the slower the vehicle may brake
            continue
        ratios = _limit_ratios(points, legs, limits)
        if ratios.max() <= 1.0 and (best is None or legs.sum() < best[1].sum()):
            best = points, legs
        if number < _ALLOCATING:
            shared = np.maximum(ratios, 0.7 * np.maximum(np.append(ratios[1:], 0.0), np.append(0.0, ratios[:-1])))
            legs = np.maximum(legs * np.clip(shared, 0.4, 2.0) ** _GAIN, _LEAST_S)
        elif best is not None and ratios.max() <= 1.0 and number > _ALLOCATING:
            break
        else:
            legs = legs * (ratios.max() * (_STRETCH if ratios.max() > 1.0 else 1.0) + 1e-9)
    return best


def _boxes_of_pieces(count: int) -> Array:
    """Return the box of each piece: one piece in each box, and further ones for the start and for the end."""
    return np.concatenate([[0], np.arange(count), [count - 1]])


def _initial_durations(low: Array, high: Array, start: Array, goal: Array | None, limits: Limits) -> Array:
    """Return durations (S,) at moderate speed along a short path through the portals of the boxes (S, 3) [s]."""
    velocity = start[1]
    braking = 0.5 * float(velocity @ velocity) / limits.accel_m_s2
    ahead = start[0] + braking * velocity / max(float(np.linalg.norm(velocity)), 1e-9)
    end = np.clip(ahead, low[-1], high[-1]) if goal is None else goal
    below, above = np.maximum(low[:-1], low[1:]), np.minimum(high[:-1], high[1:])
    inner = 0.5 * (below + above)
    for _ in range(_RELAXATIONS):
        path = np.vstack([start[:1], inner, end])
        inner = np.clip(0.5 * (path[:-2] + path[2:]), below, above)
    # The end may be any place; the durations of such a stop are those of braking straight ahead.
    lengths = np.linalg.norm(np.diff(np.vstack([start[:1], inner, end]), axis=0), axis=1)
    speed = 0.7 * limits.speed_m_s
    legs = lengths / speed
    # Each end at rest needs time to reach the speed.
    legs[-1] += speed / limits.accel_m_s2
    legs[0] += max(speed - float(np.linalg.norm(velocity)), 0.0) / limits.accel_m_s2
    return np.asarray(np.maximum(legs, 0.2 * speed / limits.accel_m_s2))


def _shortened_start(legs: Array, start: Array, low: Array, high: Array) -> Array:
    """Return durations of which the first is so short that the control points of the start are in their box."""
    legs = legs.copy()
    while legs[0] > _LEAST_S:
        points = _ends(legs[:1])[0] @ start
        if np.all((points >= low) & (points <= high)):
            break
        legs[0] *= 0.8
    return legs


def _ends(legs: Array) -> Array:
    """Return the matrices (S, 4, 4) from the state at the start of pieces to their first four control points.

    For negative durations it is the state at the end, and the last four control points in reverse order.
    """
    n, t, one = 7.0, legs / 7.0, np.ones_like(legs)
    matrices = np.zeros((len(legs), _ORDERS, _ORDERS))
    for k in range(_ORDERS):
        terms = (one, k * t, comb(k, 2) * t**2 * n / (n - 1), comb(k, 3) * t**3 * n**2 / ((n - 1) * (n - 2)))
        matrices[:, k] = np.stack(terms, axis=-1)
    return matrices


def _minimum_snap(legs: Array, start: Array, goal: Array | None, low: Array, high: Array) -> Array | None:
    """Return the control points (S, 8, 3) of the curve of minimum snap with pieces in boxes (S, 3), if there is one."""
    count, unit = len(legs), float(legs.mean())
    maps = np.zeros((count, 2 * _ORDERS, count + 1, _ORDERS))
    piece = np.arange(count)
    maps[piece, :_ORDERS, piece] = _ends(legs / unit)
    maps[piece, _ORDERS:, piece + 1] = _ends(-legs / unit)[:, ::-1]
    snap = _SNAP @ maps.reshape(count, 8, -1) * ((legs / unit) ** -3.5)[:, None, None]
    states = np.zeros((count + 1, _ORDERS, 3))
    states[0] = start * unit ** np.arange(_ORDERS)[:, None]
    is_free = np.ones((count + 1, _ORDERS), dtype=bool)
    is_free[0] = is_free[-1] = False
    if goal is None:
        is_free[-1, 0] = True
    else:
        states[-1, 0] = goal
    free, fixed = np.flatnonzero(is_free), np.flatnonzero(~is_free)
    rows, snap_rows = maps.reshape(8 * count, -1), snap.reshape(_ORDERS * count, -1)
    known = states.reshape(-1, 3)[fixed]
    constant = rows[:, fixed] @ known
    least, most = (np.repeat(side, 8, axis=0) for side in (low, high))
    bound = np.any(rows[:, free] != 0.0, axis=1)
    if not np.all((constant >= least) & (constant <= most) | bound[:, None]):
        return None
    snap_free = snap_rows[:, free]
    found = bounded_minimum(
        snap_free.T @ snap_free,
        snap_free.T @ (snap_rows[:, fixed] @ known),
        rows[np.ix_(bound, free)],
        (least - constant)[bound] + _INSIDE_M,
        (most - constant)[bound] - _INSIDE_M,
        0.1 * _INSIDE_M,
    )
    return None if found is None else np.asarray(constant + rows[:, free] @ found).reshape(count, 8, 3)


def _limit_ratios(points: Array, legs: Array, limits: Limits) -> Array:
    """Return the largest ratio (S,) of the motion of pieces with control points (S, 8, 3) to the limits."""
    motions = []
    for order in range(1, _ORDERS):
        points = np.diff(points, axis=1) * ((8 - order) / legs)[:, None, None]
        motions.append(np.moveaxis(_bernstein(7 - order) @ points, 1, 0))
    return np.asarray(limits.limit_ratio(*motions).max(axis=0))


@cache
def _bernstein(degree: int) -> Array:
    """Return the Bernstein polynomials (_SAMPLES, degree + 1) at evenly spaced times."""
    t, k = np.linspace(0.0, 1.0, _SAMPLES)[:, None], np.arange(degree + 1)
    return np.asarray([comb(degree, i) for i in k] * t**k * (1.0 - t) ** (degree - k))


def _snap_of_control_points() -> Array:
    """Return the matrix (4, 8) from control points to a vector whose squared length is the integral of squared snap."""
    k = np.arange(_ORDERS)
    binomials = np.array([comb(3, i) for i in k])
    doubled = np.array([[comb(6, i + j) for j in k] for i in k])
    gram = np.outer(binomials, binomials) / (7.0 * doubled)
    return np.asarray(np.linalg.cholesky(gram).T @ (840.0 * np.diff(np.eye(8), 4, axis=0)))


_SNAP = _snap_of_control_points()
