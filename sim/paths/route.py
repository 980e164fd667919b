"""Collision-free routes: clearance of straight legs, detours around obstacles, and curves with clearance.

A curve through waypoints deviates from its straight legs. Where its clearance is too small, a waypoint is inserted in
the middle of the leg, which itself is clear, until the curve follows the legs closely enough (Richter, Bry and Roy,
"Polynomial trajectory planning for aggressive quadrotor flight in dense indoor environments", 2016).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise, product

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.sim.paths.limits import Limits
from dronevio.sim.paths.minimum_snap import minimum_snap, minimum_time_knots
from dronevio.sim.paths.space import Space

Index = npt.NDArray[np.int64]

_SPACING_M = 0.05  # between the points at which clearance is evaluated
_GUARD_M = 0.005  # more than clearance can fall between two of them: 0.8 mm at 0.4 m from an edge
_LEAST_GUARD_M = 0.001  # the same after `_ROUNDS`: legs themselves may have less clearance than margin and guard
_SWING_M = 0.1  # preferred additional clearance of a detour, for the deviation of the curve
_ROUNDS = 9  # number of bisections of a leg, to 1/512, with the larger guard
_MAX_ROUNDS = 18  # largest number of bisections
_GRID_NODES = 20_000  # of the coarsest search grid
_CELL_M = (0.25, 0.6)  # smallest and largest width of its cells
_REFINEMENTS = 2  # number of refinements of the grid if no route is found
_STEPS = np.array([step for step in product((-1, 0, 1), repeat=3) if step > (0, 0, 0)])  # to half of the neighbours


def leg_clearances(space: Space, starts: Array, ends: Array) -> Array:
    """Return the smallest clearance (K,) on each straight leg between points (K, 3) [m]."""
    legs = ends - starts
    if not len(legs):
        return np.zeros(0)
    number, share, first = _leg_samples(np.linalg.norm(legs, axis=1))
    return np.asarray(np.minimum.reduceat(space.clearance(starts[number] + share[:, None] * legs[number]), first))


def collision_free_polyline(space: Space, points: Array, margin_m: float, names: Sequence[str] = ()) -> Array:
    """Return points (M, 3) with collision-free straight legs: the given ones (K, 3) and detours between them.

    Args:
        space: Bounds and obstacles.
        points: Waypoints [m].
        margin_m: Smallest clearance [m].
        names: Names of the points for error messages; ``waypoint 3`` and so on by default.

    Raises:
        ConfigError: A waypoint is too close to a surface, or there is no route between two waypoints.
    """
    names = names or [f"waypoint {number}" for number in range(len(points))]
    clearance = space.clearance(points)
    fine = clearance >= margin_m  # False for NaN
    if not fine.all():
        k = int(fine.argmin())
        raise ConfigError(
            f"{names[k]} at {np.round(points[k], 2).tolist()} m has {clearance[k]:.2f} m of clearance; expected at"
            f" least {margin_m:.2f} m"
        )
    blocked = leg_clearances(space, points[:-1], points[1:]) < margin_m
    route = [points[:1]]
    for k, (start, goal) in enumerate(pairwise(points)):
        detour = _detour(space, tuple(start), tuple(goal), margin_m) if blocked[k] else np.zeros((0, 3))
        if detour is None:
            raise ConfigError(
                f"no route from {names[k]} at {np.round(start, 2).tolist()} m to {names[k + 1]} at"
                f" {np.round(goal, 2).tolist()} m; expected one with {margin_m:.2f} m of clearance"
            )
        route += [detour, goal[None]]
    return np.concatenate(route)


def collision_free_curve(space: Space, points: Array, margin_m: float, limits: Limits) -> tuple[Array, Array]:
    """Return times (M,) from 0 [s] and points (M, 3) of a minimum-snap curve that keeps clearance and limits.

    Args:
        space: Bounds and obstacles.
        points: (K, 3) Waypoints with collision-free straight legs, as from `collision_free_polyline` [m].
        margin_m: Smallest clearance [m].
        limits: Limits of the motion.

    Raises:
        ConfigError: A waypoint is too close to a surface for the curve around it.
    """
    knots = minimum_time_knots(points, limits)
    for n in range(_MAX_ROUNDS):
        low = _curve_clearances(space, knots, points)
        close = low < margin_m + (_GUARD_M if n < _ROUNDS else _LEAST_GUARD_M)
        if not close.any():
            return knots, points
        halves = np.flatnonzero(close) + 1
        points = np.insert(points, halves, 0.5 * (points[halves - 1] + points[halves]), axis=0)
        knots = np.insert(knots, halves, 0.5 * (knots[halves - 1] + knots[halves]))
        knots = minimum_time_knots(points, limits, knots)
    worst = int(low.argmin())
    raise ConfigError(
        f"the curve near {np.round(points[worst], 2).tolist()} m has {low[worst]:.2f} m of clearance; expected"
        f" more than {margin_m:.2f} m"
    )


def _curve_clearances(space: Space, knots: Array, points: Array) -> Array:
    """Return the smallest clearance (K - 1,) of the minimum-snap curve on each leg [m]."""
    curve = minimum_snap(knots, points)
    rough = curve(np.linspace(knots[:-1], knots[1:], 9))
    length = np.linalg.norm(np.diff(rough, axis=0), axis=-1).sum(axis=0)
    number, share, first = _leg_samples(2.0 * length)  # twice as many, since the speed along the curve varies
    return np.asarray(
        np.minimum.reduceat(space.clearance(curve(knots[number] + share * np.diff(knots)[number])), first)
    )


def _leg_samples(lengths: Array) -> tuple[Index, Array, Index]:
    """Return the sample points on legs of some lengths (K,) [m]: the index of the leg and the fraction along it, both
    ends included, of each sample, and the first sample of each leg.
    """
    counts = np.ceil(lengths / _SPACING_M).astype(np.int64) + 2
    first = np.concatenate([[0], np.cumsum(counts)[:-1]])
    number = np.repeat(np.arange(len(counts)), counts)
    return number, (np.arange(len(number)) - first[number]) / (counts[number] - 1), first


@lru_cache(maxsize=256)
def _detour(space: Space, start: tuple[float, ...], goal: tuple[float, ...], margin_m: float) -> Array | None:
    """Return the intermediate points (M, 3) of a short collision-free route, or None if there is none.

    Results are cached, since every lap requires the same routes.
    """
    volume = float(np.prod(space.high - space.low))
    cell_m = float(np.clip((volume / _GRID_NODES) ** (1.0 / 3.0), *_CELL_M))
    for refinement in range(_REFINEMENTS):
        grid = _grid(space, cell_m / 2**refinement)
        for wanted_m in (margin_m + _SWING_M, margin_m + 2.0 * _GUARD_M):
            way = grid.way(np.array(start), np.array(goal), margin_m, wanted_m)
            if way is not None:
                return _shortcut(space, way, wanted_m)[1:-1]
    return None


def _shortcut(space: Space, way: Array, margin_m: float) -> Array:
    """Return the points (L, 3) of a route (M, 3) that remain after shortcuts along clear lines of sight."""
    kept, here = [0], 0
    while here < len(way) - 1:
        beyond = way[here + 2 :]
        seen = np.flatnonzero(leg_clearances(space, np.broadcast_to(way[here], beyond.shape), beyond) >= margin_m)
        here += 2 + int(seen[-1]) if len(seen) else 1
        kept.append(here)
    return way[kept]


@dataclass(frozen=True, eq=False)
class _Grid:
    """Grid of points in a space, with the legs from each point to its 26 neighbours."""

    space: Space
    """Bounds and obstacles of the space."""
    cell_m: float
    """Distance of neighbours along an axis [m]."""
    nodes: Array
    """(N, 3) Positions of the points [m]."""
    tails: Index
    """(E,) Index of the first point of each leg."""
    heads: Index
    """(E,) Index of the last point of each leg."""
    lengths: Array
    """(E,) Length of each leg [m]."""
    least: Array
    """(E,) Lower bound of the clearance on each leg [m]."""

    def way(self, start: Array, goal: Array, margin_m: float, wanted_m: float) -> Array | None:
        """Return the shortest route (M, 3) along legs with clearance, both ends included, or None if there is none.

        Args:
            start: (3,) First point of the route [m].
            goal: (3,) Last point of the route [m].
            margin_m: Clearance of the legs at the start and the goal [m].
            wanted_m: Clearance of all other legs [m].
        """
        ends, n = np.stack([start, goal]), len(self.nodes)
        end, node = np.nonzero(np.linalg.norm(self.nodes - ends[:, None], axis=-1) < 1.8 * self.cell_m)
        joined = leg_clearances(self.space, ends[end], self.nodes[node]) >= margin_m
        end, node = end[joined], node[joined]
        clear = self.least >= wanted_m
        lengths = np.concatenate([self.lengths[clear], np.linalg.norm(self.nodes[node] - ends[end], axis=1) + 1e-9])
        tails = np.concatenate([self.tails[clear], n + end])
        heads = np.concatenate([self.heads[clear], node])
        graph = coo_array((lengths, (tails, heads)), shape=(n + 2, n + 2)).tocsr()
        distance, before = dijkstra(graph, directed=False, indices=n, return_predecessors=True)
        if not np.isfinite(distance[n + 1]):
            return None
        way = [n + 1]
        while way[-1] != n:
            way.append(int(before[way[-1]]))
        return np.concatenate([self.nodes, ends])[way[::-1]]


@lru_cache(maxsize=4)
def _grid(space: Space, cell_m: float) -> _Grid:
    """Return a grid over a space; cached, since many routes may be searched in one space."""
    axes = [np.arange(low + 0.5 * cell_m, high, cell_m) for low, high in zip(space.low, space.high, strict=True)]
    shape = np.array([len(axis) for axis in axes])
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    place = np.stack(np.unravel_index(np.arange(len(nodes)), shape), axis=-1)
    blocks = np.lexsort((place // 4).T)  # points evaluated together should be close together
    clearance = np.empty(len(nodes))
    clearance[blocks] = space.clearance(nodes[blocks])
    tails, heads = [], []
    for step in _STEPS:
        tail = np.flatnonzero(np.all((place + step >= 0) & (place + step < shape), axis=1))
        tails.append(tail)
        heads.append(np.ravel_multi_index((place[tail] + step).T, shape))
    tail, head = np.concatenate(tails), np.concatenate(heads)
    lengths = np.linalg.norm(nodes[head] - nodes[tail], axis=1)
    # Clearance is Lipschitz continuous with constant 1, which bounds it on the leg.
    least = 0.5 * (clearance[tail] + clearance[head] - lengths)
    return _Grid(space, cell_m, nodes, tail, head, lengths, least)
