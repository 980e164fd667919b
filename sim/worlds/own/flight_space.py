"""The free box and the route of a world, found in the space that its obstacles leave."""

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.sim.appearance.solids import Box
from dronevio.sim.paths.route import collision_free_polyline, leg_clearances
from dronevio.sim.paths.solid_cells import near_obstacles
from dronevio.sim.paths.space import Space
from dronevio.sim.worlds.layout import ROUTE_CLEARANCE_M

_MARGIN_M = 0.3  # of the free box from obstacles and bounds
_LEAST_HALF_M, _LEAST_HEIGHT_M = 0.6, 1.8
_USEFUL_HEIGHT_M = 3.0
_HEIGHTS = 24  # that are tried for the free box
_CLEARANCE_M = ROUTE_CLEARANCE_M + 0.02  # of a route that is found
_SPACING_M, _MOST_SAMPLES = 0.25, 1_000_000
_HOVER_M = 1.3  # height of the start of a route above the pad
_HEIGHTS_M = (0.9, 2.6)  # of its other points
_POINTS = 9  # of a route, with its start, before detours


def found_free_box(low: Array, high: Array, pad: Array, solids: Sequence[Box]) -> Array | None:
    """Return a box free of obstacles whose centre is above the pad, of large volume; None if all are small.

    Args:
        low: (3,) Lower corner of the world [m].
        high: (3,) Upper corner of the world [m].
        pad: (3,) Centre of the pad [m].
        solids: What is solid.

    Returns:
        Its lower and upper corner (2, 3) [m].
    """
    reach = np.array([np.abs(box.R) @ box.half for box in solids]).reshape(-1, 3)
    centre = np.array([box.centre for box in solids]).reshape(-1, 3)
    gap = np.maximum(np.abs(centre - pad)[:, :2] - reach[:, :2] - _MARGIN_M, 0.0)
    bottom = centre[:, 2] - reach[:, 2] - _MARGIN_M
    widest = np.minimum(pad - low, high - pad)[:2] - _MARGIN_M
    highest = high[2] - _MARGIN_M
    tops = np.unique(np.append(bottom[(bottom > low[2] + _LEAST_HEIGHT_M) & (bottom < highest)], highest))
    tops = tops[np.linspace(0, len(tops) - 1, min(len(tops), _HEIGHTS)).astype(int)]
    best, best_volume = None, 0.0
    for top in tops:
        order = np.argsort(gap[:, 0])
        order = order[bottom[order] < top]
        x = np.append(np.minimum(gap[order, 0], widest[0]), widest[0])
        y = np.minimum(np.minimum.accumulate(np.append(np.inf, gap[order, 1])), widest[1])
        volume = x * y * min(top - low[2], _USEFUL_HEIGHT_M)
        volume[(x < _LEAST_HALF_M) | (y < _LEAST_HALF_M) | (top - low[2] < _LEAST_HEIGHT_M)] = 0.0
        k = int(volume.argmax())
        if volume[k] > best_volume:
            best_volume = float(volume[k])
            half = np.array([x[k], y[k]])
            best = np.array([[*(pad[:2] - half), low[2]], [*(pad[:2] + half), top]])
    return best


def found_route(space: Space, pad: Array, rng: np.random.Generator) -> Array | None:
    """Return a closed tour of straight legs with clearance that starts above the pad; None if there is none.

    The points are far from each other among those that can be reached, in the order of their direction as seen from
    their middle.

    Args:
        space: Bounds and obstacles.
        pad: (3,) Centre of the pad [m].
        rng: Draws the candidates.

    Returns:
        The tour (R, 3) [m].
    """
    start = pad + [0.0, 0.0, min(_HOVER_M, space.high[2] - space.low[2] - _CLEARANCE_M - 0.1)]
    places = _reached(space, start)
    heights = places[:, 2] - space.low[2]
    places = places[(heights >= _HEIGHTS_M[0]) & (heights <= _HEIGHTS_M[1])]
    if len(places) < 3:
        return None
    candidates = places[rng.permutation(len(places))[:2000]]
    chosen = [start]
    for _ in range(_POINTS - 1):
        apart = np.linalg.norm(candidates[:, None, :2] - np.array(chosen)[:, :2], axis=2).min(axis=1)
        chosen.append(candidates[int(apart.argmax())])
    points = np.array(chosen)
    offset = points[:, :2] - points[:, :2].mean(axis=0)
    order = np.argsort(np.arctan2(offset[:, 1], offset[:, 0]))
    order = np.roll(order, -int(np.flatnonzero(order == 0)[0]))
    return _joined(space, points[order])


def _joined(space: Space, points: Array) -> Array | None:
    """Return a closed tour (R, 3) through the first of some points (K, 3) and the others, with detours.

    Points to which no detour leads from the one before are left out. None if fewer than three remain.
    """
    ways: list[Array] = [points[:1]]  # to each point, without the one before
    for goal in points[1:]:
        way = _way(space, ways[-1][-1], goal)
        if way is not None:
            ways.append(way)
    while len(ways) > 2:
        back = _way(space, ways[-1][-1], points[0])
        if back is not None:
            return np.concatenate([*ways, back[:-1]])
        ways.pop()
    return None


def _way(space: Space, start: Array, goal: Array) -> Array | None:
    """Return a way (M, 3) with clearance from a point to another, without the first one; None if none is found."""
    try:
        return collision_free_polyline(space, np.stack([start, goal]), _CLEARANCE_M)[1:]
    except ConfigError:
        return None


def route_clearance(space: Space, route: Array) -> float:
    """Return the smallest clearance on the legs of a closed route (R, 3) [m]."""
    return float(leg_clearances(space, route, np.roll(route, -1, axis=0)).min())


def _reached(space: Space, start: Array) -> Array:
    """Return points (N, 3) of a lattice that a path with clearance reaches from a start (3,) [m].

    A leg between neighbours is at most half a spacing from one of them, whose clearance is larger by that.
    """
    volume = float(np.prod(space.high - space.low))
    spacing_m = max(_SPACING_M, (volume / _MOST_SAMPLES) ** (1.0 / 3.0))
    least_m = _CLEARANCE_M + 0.5 * spacing_m
    first = start - spacing_m * np.floor((start - space.low - least_m) / spacing_m)
    shape = np.floor((space.high - least_m - first) / spacing_m).astype(int) + 1
    origin = np.round((start - first) / spacing_m).astype(int)
    if np.any(shape < 1) or np.any(origin < 0) or np.any(origin >= shape):
        return np.zeros((0, 3))
    free = ~near_obstacles(space, first, spacing_m, shape, least_m)
    label, _ = ndimage.label(free)
    here = label[tuple(origin)]
    if here == 0:
        return np.zeros((0, 3))
    return np.asarray(first + spacing_m * np.argwhere(label == here))
