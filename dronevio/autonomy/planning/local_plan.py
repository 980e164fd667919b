"""Plans in the local map: along a path as far as it is known to be free, to rest.

A plan is a trajectory inside free boxes around a route through the local map, with a turn toward where it leads next.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product

import numpy as np
from scipy import ndimage

from dronevio.autonomy.planning.body import Body
from dronevio.autonomy.planning.corridor import Corridor, corridor_along
from dronevio.autonomy.planning.known_space import LocalSpace
from dronevio.autonomy.planning.lattice_search import shortest_path
from dronevio.autonomy.planning.route import NoRoute, route
from dronevio.autonomy.planning.trajectory import CorridorTrajectory, corridor_trajectory
from dronevio.models.arrays import Array, Mask
from dronevio.models.occupancy import FREE
from dronevio.sim.paths.limits import Limits

_REACH_M = 2.0  # of the boxes of a corridor
_STEP_M = 0.1  # between samples of a path
_SPARE_M = (0.2, 0.1, 0.0)  # clearance of the route beyond that of the corridor, tried in turn
_ASIDE_M, _UPRIGHT_M = (0.3, 1.0), (0.25, 0.5)  # distance of places from which a path is looked at again
_STILL_M_S = 0.1  # up to which a trajectory is sought in every corridor, however long that takes
_LEVEL_M, _FAR_M = 0.15, 20.0  # half the sides of boxes in which the vehicle brakes
_HARDER = (1.0, 2.0, 4.0)  # multiples of the acceleration of stops, tried in turn
_BACK_LEAST_M, _BACK_M = 0.2, 1.0  # length of a way back to more room
_BACK_M_S, _BACK_BESIDE_M = 0.5, 0.05  # speed on it, and half its width
_BACK_TRIES, _BACK_SAMPLES = 200, 21
_MAX_EXPANSIONS = 100_000
_NEIGHBOURS = np.ones((3, 3, 3), np.bool_)


def sampled(path: Array, start: Array, length_m: float = np.inf) -> Array:
    """Return points (M, 3) along a path (N, 3), from its nearest one to a start (3,), up to a length [m]."""
    legs = np.linalg.norm(np.diff(path, axis=0), axis=1)
    along = np.append(0.0, np.cumsum(legs))
    s = np.arange(0.0, along[-1] + _STEP_M, _STEP_M)
    points = np.stack([np.interp(s, along, path[:, axis]) for axis in range(3)], axis=-1)
    first = int(np.argmin(np.linalg.norm(points - start, axis=1)))
    return points[first : first + int(min(length_m, along[-1]) / _STEP_M) + 2]


def trajectory_along(
    space: LocalSpace, path: Array, start: Array, body: Body, limits: Limits
) -> CorridorTrajectory | None:
    """Return a trajectory from a state to the farthest point of a path that known-free space connects, at rest there.

    Args:
        space: The local map.
        path: (M, 3) Points along the path from near the start [m].
        start: (4, 3) Position, velocity, acceleration and jerk [m, s].
        body: What must have room.
        limits: Limits of the motion.

    Returns:
        The trajectory; None if no point can be reached, or no trajectory was found. From a place at rest where the body
        has less room than it should, it leads back to where it has.
    """
    clear = space.is_clear(body.radius_m)
    parts, _ = ndimage.label(clear, _NEIGHBOURS)
    here = space.grid.cells(start[0])
    if not np.all((here >= 0) & (here < clear.shape)):
        return None
    cells = space.grid.cells(path)
    inside = np.all((cells >= 0) & (cells < clear.shape), axis=1)
    own = parts[tuple(here.T)]
    if not own:
        return _back_to_room(space, clear, start, limits)
    reachable = np.zeros(len(path), np.bool_)
    reachable[inside] = parts[tuple(cells[inside].T)] == own
    if not reachable.any():
        return None
    last = int(np.flatnonzero(reachable)[-1])
    for way in _ways(space, clear, start[0], path[last], body):
        corridor = corridor_along(space.grid, clear, way, _REACH_M)
        trajectory = None if corridor is None else corridor_trajectory(corridor, start, way[-1], limits)
        if trajectory is not None:
            return trajectory
        if corridor is not None and np.linalg.norm(start[1]) > _STILL_M_S:
            return None  # what was decided before is flown on
    return None


def _back_to_room(space: LocalSpace, clear: Mask, start: Array, limits: Limits) -> CorridorTrajectory | None:
    """Return a slow trajectory along a straight line to a clear cell nearby, on which the room does not shrink."""
    if np.linalg.norm(start[1]) > _STILL_M_S:
        return None
    cells = np.argwhere(clear)
    centres = space.grid.centres(cells)
    apart_m = np.linalg.norm(centres - start[0], axis=1)
    share = np.linspace(0.0, 1.0, _BACK_SAMPLES)[:, None]
    near = np.flatnonzero((apart_m >= _BACK_LEAST_M) & (apart_m <= _BACK_M))
    for index in near[np.argsort(apart_m[near], kind="stable")][:_BACK_TRIES]:
        line = start[0] + share * (centres[index] - start[0])
        room_m = space.clearances(line)
        is_free = space.grid.at(line) == FREE
        if np.all(np.diff(room_m) >= -space.grid.cell_m) and np.all(is_free[share[:, 0] > 0.3]):
            low, high = line.min(axis=0) - _BACK_BESIDE_M, line.max(axis=0) + _BACK_BESIDE_M
            slow = replace(limits, speed_m_s=min(limits.speed_m_s, _BACK_M_S))
            return corridor_trajectory(Corridor(low[None], high[None]), start, centres[index], slow)
    return None


def _ways(space: LocalSpace, clear: Mask, start: Array, target: Array, body: Body) -> Iterator[Array]:
    """Yield polylines (N, 3) from a start to a target through clear cells, those with the most room first."""
    last = np.zeros((0, 3))
    for spare_m in _SPARE_M:
        found = route(space.grid, space.distance, start, target, clearance_m=body.radius_m + spare_m, near_m=0.5)
        if not isinstance(found, NoRoute) and not np.array_equal(found.waypoints, last):
            last = found.waypoints
            yield last
    # Through a gap that is hardly wider than the body, diagonal steps may leave no room for boxes.
    ends = space.grid.cells(np.stack([start, target]))
    cells = shortest_path(clear, ends[0], ends[1], _MAX_EXPANSIONS, through_faces=True).cells
    if cells is not None:
        yield np.concatenate([start[None], space.grid.centres(cells)])


def place_beside(space: LocalSpace, position: Array, ahead: Array, body: Body) -> Array | None:
    """Return the reachable place (3,) near a position from which what is ahead (3,) is seen from most aside, if any."""
    reached = _reached(space, position, body)
    if reached is None:
        return None
    level = int(space.grid.cells(position)[2])
    places = space.grid.centres(np.argwhere(reached[..., level]) @ np.eye(2, 3, dtype=np.int64))
    offsets = places[:, :2] - position[:2]
    apart = np.linalg.norm(offsets, axis=1)
    direction = ahead[:2] - position[:2]
    direction = direction / max(float(np.linalg.norm(direction)), 1e-6)
    aside = np.abs(offsets @ [-direction[1], direction[0]])
    aside[(apart > _ASIDE_M[1]) | (apart < _ASIDE_M[0])] = 0.0
    best = int(np.argmax(aside + 1e-3 * apart))
    if aside[best] < 0.5 * _ASIDE_M[0]:
        return None
    return np.append(places[best, :2], position[2])


def place_above(space: LocalSpace, position: Array, ahead: Array, body: Body) -> Array | None:
    """Return the farthest reachable place (3,) within half a metre above or below a position; else one beside."""
    reached = _reached(space, position, body)
    if reached is None:
        return None
    here = space.grid.cells(position)
    z = space.grid.centres(here + np.arange(reached.shape[2])[:, None] * [0, 0, 1] - [0, 0, here[2]])[:, 2]
    far = np.abs(z - position[2])
    far[~reached[here[0], here[1]] | (far > _UPRIGHT_M[1])] = 0.0
    best = int(np.argmax(far))
    if far[best] < _UPRIGHT_M[0]:
        return place_beside(space, position, ahead, body)
    return np.append(position[:2], z[best])


def _reached(space: LocalSpace, position: Array, body: Body) -> Mask | None:
    """Return the cells that a body reaches from a position; None if it has no room there."""
    parts, _ = ndimage.label(space.is_clear(body.radius_m), _NEIGHBOURS)
    here = space.grid.cells(position)
    if not np.all((here >= 0) & (here < parts.shape)) or not parts[tuple(here)]:
        return None
    return np.asarray(parts == parts[tuple(here)])


def stop(space: LocalSpace, start: Array, body: Body, limits: Limits) -> CorridorTrajectory:
    """Return a trajectory from a state to rest in free boxes ahead, level and within the limits if possible.

    Where there is less room than that needs, the acceleration is doubled, and again. Where even that needs more room,
    the vehicle brakes as hard as it can.
    """
    speed, factors = float(np.linalg.norm(start[1])), _HARDER
    if speed > 1e-3:
        ahead = start[0] + start[1] / speed * np.linspace(0.0, 1.0, 12)[:, None] * speed**2 / limits.accel_m_s2
        clear = space.is_clear(body.radius_m)
        blocked = np.flatnonzero(space.clearances(ahead) < body.radius_m - 1e-6)
        if len(blocked):
            ahead, factors = ahead[: blocked[0]], _HARDER[::-1]
        corridor = corridor_along(space.grid, clear, ahead, _REACH_M) if len(ahead) > 1 else None
        parts = () if corridor is None else (_level(corridor, float(start[0, 2])), corridor)
        for factor, part in product(_HARDER, parts):
            trajectory = corridor_trajectory(part, start, None, _stopping(limits, speed, factor))
            if trajectory is not None:
                return trajectory
    return braking(start, limits, factors)


def _stopping(limits: Limits, speed_m_s: float, factor: float) -> Limits:
    """Return limits of a stop from a speed, which may be a little above its own limit, with a multiple of the rest."""
    return replace(limits, accel_m_s2=factor * limits.accel_m_s2, speed_m_s=max(limits.speed_m_s, 1.1 * speed_m_s))


def _level(corridor: Corridor, z_m: float) -> Corridor:
    """Return the part of a corridor near a height."""
    low, high = corridor.low_m.copy(), corridor.high_m.copy()
    low[:, 2], high[:, 2] = np.maximum(low[:, 2], z_m - _LEVEL_M), np.minimum(high[:, 2], z_m + _LEVEL_M)
    return Corridor(low, high)


def braking(start: Array, limits: Limits, factors: Sequence[float] = _HARDER) -> CorridorTrajectory:
    """Return a trajectory from a state to rest, at nearly the same height if possible.

    Args:
        start: (4, 3) Position, velocity, acceleration and jerk [m, s].
        limits: Limits of the motion.
        factors: Multiples of the acceleration, of which the first is taken with which there is such a trajectory.
    """
    speed = float(np.linalg.norm(start[1]))
    for depth_m, factor in product((_LEVEL_M, _FAR_M), factors):
        around = np.array([_FAR_M, _FAR_M, depth_m])
        box = Corridor((start[0] - around)[None], (start[0] + around)[None])
        trajectory = corridor_trajectory(box, start, None, _stopping(limits, speed, factor))
        if trajectory is not None:
            return trajectory
    raise AssertionError("no trajectory to rest")  # one exists in an unbounded box


def straight(start: Array, end: Array, speed_m_s: float) -> CorridorTrajectory:
    """Return a trajectory along a straight line from rest to rest."""
    low, high = np.minimum(start, end) - 0.1, np.maximum(start, end) + 0.1
    rest = np.vstack([start[None], np.zeros((3, 3))])
    trajectory = corridor_trajectory(
        Corridor(low[None], high[None]), rest, end, Limits(speed_m_s=speed_m_s, accel_m_s2=2.0)
    )
    assert trajectory is not None  # from rest to rest in a box
    return trajectory


def at_rest(position: Array) -> CorridorTrajectory:
    """Return the trajectory that stays at a position (3,)."""
    return CorridorTrajectory(np.tile(position, (1, 8, 1)), np.array([0.0, 0.1]), np.zeros(1, np.int64))


def slowed(trajectory: CorridorTrajectory, duration_s: float) -> CorridorTrajectory:
    """Return a trajectory from rest to rest along the same path in a longer time [s]."""
    return replace(trajectory, knots_s=trajectory.knots_s * max(duration_s / trajectory.duration_s, 1.0))
