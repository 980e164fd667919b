"""Paths to a goal through a map that is not yet complete: what is unknown is taken as free until it is seen.

Such a path exists unless what was seen separates start and goal. It is flown only as far as it is known to be free;
what is seen from there changes the map, and the path with it. Far outside of what is known it is a straight line.

Source: Koenig, Tovey and Smirnov, "Performance bounds for planning in unknown terrain", 2003, for the free-space
assumption.
"""

from dataclasses import replace

import numpy as np

from dronevio.autonomy.planning.body import Body, body_distance
from dronevio.autonomy.planning.hidden_space import path_costs
from dronevio.autonomy.planning.route import NoRoute, Route, route
from dronevio.models.arrays import Array
from dronevio.models.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

_MARGIN_M = 4.0  # of unknown space around all that is known, for detours
_FAR_M = 15.0  # beyond which a path is not sought, since the search would take long
_NEAR_M = 0.6  # from a goal within which a place is sought instead


def path_to_goal(
    known: OccupancyGrid, start: Array, goal: Array, body: Body, heights_m: tuple[float, float], given_up: Array
) -> Route | NoRoute:
    """Return a short path for a body from a start to a goal through free and unknown space.

    Args:
        known: What is known, in the frame of the map.
        start: (3,) First point; from outside the heights, the path leads straight up or down to them first [m].
        goal: (3,) Last point [m].
        body: What must have room along the path.
        heights_m: Least and greatest z of the path [m].
        given_up: (N, 3) Points of unknown space that could not be seen, and count as occupied [m].
    """
    far_goal, goal = goal, _within(known, start, goal)
    cell_m, levels = known.cell_m, int(body.half_height_m / known.cell_m + 1e-6)
    ends = np.stack([known.low_m, known.high_m, start, goal])
    low = np.floor((ends.min(axis=0) - _MARGIN_M) / cell_m).astype(np.int64)
    high = np.ceil((ends.max(axis=0) + _MARGIN_M) / cell_m).astype(np.int64)
    low[2], high[2] = (round(z / cell_m) for z in heights_m)
    low[2], high[2] = low[2] - levels, high[2] + levels
    within = np.clip(
        start, [-np.inf, -np.inf, heights_m[0] + 0.5 * cell_m], [np.inf, np.inf, heights_m[1] - 0.5 * cell_m]
    )
    # Embed what is known in the box.
    states = np.full(high - low, FREE, np.uint8)
    first = np.round(known.low_m / cell_m).astype(np.int64)
    a, b = np.maximum(first, low), np.minimum(first + known.states.shape, high)
    box = tuple(slice(i, j) for i, j in zip(a - low, np.maximum(b, a) - low, strict=True))
    part = known.states[tuple(slice(i, j) for i, j in zip(a - first, np.maximum(b, a) - first, strict=True))]
    states[box] = np.where(part == OCCUPIED, OCCUPIED, FREE)
    grid = OccupancyGrid(cell_m * low, cell_m, states, known.frame)
    if len(given_up):
        cells = grid.cells(given_up)
        cells = cells[np.all((cells >= 0) & (cells < states.shape), axis=1)]
        unseen = known.at(grid.centres(cells)) != FREE
        states[tuple(cells[unseen].T)] = OCCUPIED
    distance = body_distance(grid, states == OCCUPIED, body)
    # What walls hide costs more.
    is_unknown = np.ones(states.shape, np.bool_)
    is_unknown[box] = part == UNKNOWN
    costs = path_costs(states == OCCUPIED, is_unknown, cell_m)
    # The body stays between the heights.
    distance.distance_m[..., :levels] = 0.0
    distance.distance_m[..., states.shape[2] - levels :] = 0.0
    found = route(grid, distance, within, goal, clearance_m=body.radius_m, near_m=_NEAR_M, cell_costs=costs)
    if isinstance(found, NoRoute) and found.cause == "start":  # closer to a surface than the margin allows
        bare_m, near_m = body.bare_radius_m, 2.0 * _NEAR_M
        found = route(grid, distance, within, goal, clearance_m=bare_m, near_m=near_m, cell_costs=costs)
    if isinstance(found, NoRoute):
        return found
    before = np.zeros((0, 3)) if np.array_equal(within, start) else start[None]
    beyond = np.zeros((0, 3)) if goal is far_goal else far_goal[None]
    return replace(found, waypoints=np.concatenate([before, found.waypoints, beyond]))


def _within(known: OccupancyGrid, start: Array, goal: Array) -> Array:
    """Return a goal (3,), or the place at its height where the way to it leaves what is known and its surroundings."""
    low = np.minimum(known.low_m, start)[:2] - _FAR_M
    high = np.maximum(known.high_m, start)[:2] + _FAR_M
    way = (goal - start)[:2]
    room = np.where(way > 0.0, high - start[:2], start[:2] - low)
    share = np.min(room / np.maximum(np.abs(way), 1e-9))
    return goal if share >= 1.0 else np.append(start[:2] + share * way, goal[2])
