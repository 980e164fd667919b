"""Plans in the local map: along a path as far as it is known to be free, to rest.

A plan is a trajectory inside free boxes around a route through the local map, with a turn toward where it leads next.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from dronevio.autonomy.body import Body, body_distance
from dronevio.autonomy.corridor import Corridor, corridor_along
from dronevio.autonomy.route import NoRoute, route
from dronevio.autonomy.trajectory import CorridorTrajectory, corridor_trajectory
from dronevio.models.arrays import Array, Mask
from dronevio.models.occupancy import OCCUPIED, UNKNOWN, DistanceField, OccupancyGrid
from dronevio.sim.paths.limits import Limits

_REACH_M = 2.0  # of the boxes of a corridor
_STEP_M = 0.1  # between samples of a path
_SPARE_M = (0.2, 0.1, 0.0)  # clearance of the route beyond that of the corridor, tried in turn
_NEIGHBOURS = np.ones((3, 3, 3), np.bool_)


@dataclass(frozen=True, eq=False)
class LocalSpace:
    """Where the centre of the vehicle may be, by the local map.

    The body keeps its margin from surfaces, whose places have errors; it does not enter unknown space, but for gaps in
    free space that are one cell thick: the depth along edges is unknown until an edge is seen from another side, and a
    thing that is hidden there is seen from 1.5 m away.
    """

    grid: OccupancyGrid
    """The local map."""
    distance: DistanceField
    """Horizontal distances to surfaces, or to what is unknown if that is nearer less the margin of the body."""

    @classmethod
    def of(cls, grid: OccupancyGrid, body: Body) -> "LocalSpace":
        """Return the space for a body; nothing outside the grid is known."""
        unseen = _thick(grid.states == UNKNOWN)
        for axis in range(3):
            ends = np.moveaxis(unseen, axis, 0)
            ends[0] = ends[-1] = True
        to_surfaces = body_distance(grid, grid.states == OCCUPIED, body).distance_m
        to_unseen = body_distance(grid, unseen, body).distance_m
        to_unseen += np.where(to_unseen > 0.0, np.float32(body.radius_m - body.bare_radius_m), np.float32(0.0))
        distance = DistanceField(grid.low_m, grid.cell_m, np.minimum(to_surfaces, to_unseen), grid.frame)
        return cls(grid, distance)

    def is_clear(self, clearance_m: float) -> Mask:
        """Return the cells (X, Y, Z) with a clearance [m]."""
        return np.asarray(self.distance.distance_m >= clearance_m - 1e-6)

    def clearances(self, points: Array) -> Array:
        """Return the clearances (N,) of points (N, 3), 0 outside the grid [m]."""
        cells = self.grid.cells(points)
        inside = np.all((cells >= 0) & (cells < self.grid.states.shape), axis=1)
        values = np.zeros(len(points))
        values[inside] = self.distance.distance_m[tuple(cells[inside].T)]
        return values


def _thick(cells: Mask) -> Mask:
    """Return the cells (X, Y, Z) of a mask that lie in a cube of 2 × 2 × 2 of its cells."""
    cubes = cells
    for axis in range(3):
        a = np.moveaxis(cubes, axis, 0)
        cubes = np.moveaxis(a[:-1] & a[1:], 0, axis)
    for axis in range(3):
        a = np.moveaxis(cubes, axis, 0)
        grown = np.zeros((a.shape[0] + 1, *a.shape[1:]), np.bool_)
        grown[:-1] |= a
        grown[1:] |= a
        cubes = np.moveaxis(grown, 0, axis)
    return np.asarray(cubes)


def sampled(path: Array, start: Array, length_m: float) -> Array:
    """Return points (M, 3) along a path (N, 3), from its nearest one to a start (3,), up to a length [m]."""
    legs = np.linalg.norm(np.diff(path, axis=0), axis=1)
    along = np.append(0.0, np.cumsum(legs))
    s = np.arange(0.0, along[-1] + _STEP_M, _STEP_M)
    points = np.stack([np.interp(s, along, path[:, axis]) for axis in range(3)], axis=-1)
    first = int(np.argmin(np.linalg.norm(points - start, axis=1)))
    return points[first : first + int(length_m / _STEP_M) + 1]


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
        The trajectory; None if no point can be reached, or no trajectory was found.
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
        return None
    reachable = np.zeros(len(path), np.bool_)
    reachable[inside] = parts[tuple(cells[inside].T)] == own
    if not reachable.any():
        return None
    target = path[int(np.flatnonzero(reachable)[-1])]
    for spare_m in _SPARE_M:
        found = route(space.grid, space.distance, start[0], target, clearance_m=body.radius_m + spare_m, near_m=0.5)
        if isinstance(found, NoRoute):
            continue
        corridor = corridor_along(space.grid, clear, found.waypoints, _REACH_M)
        if corridor is None:
            continue
        trajectory = corridor_trajectory(corridor, start, found.waypoints[-1], limits)
        if trajectory is not None:
            return trajectory
    return None


def stop(space: LocalSpace, start: Array, body: Body, limits: Limits) -> CorridorTrajectory:
    """Return a trajectory from a state to rest: within free boxes ahead if there is one, else as fast as possible."""
    speed = float(np.linalg.norm(start[1]))
    if speed > 1e-3:
        ahead = start[0] + start[1] / speed * np.linspace(0.0, 1.0, 12)[:, None] * speed**2 / limits.accel_m_s2
        clear = space.is_clear(body.radius_m)
        blocked = np.flatnonzero(space.clearances(ahead) < body.radius_m - 1e-6)
        ahead = ahead[: blocked[0]] if len(blocked) else ahead
        corridor = corridor_along(space.grid, clear, ahead, _REACH_M) if len(ahead) > 1 else None
        if corridor is not None:
            trajectory = corridor_trajectory(corridor, start, None, limits)
            if trajectory is not None:
                return trajectory
    return braking(start, limits)


def braking(start: Array, limits: Limits) -> CorridorTrajectory:
    """Return a trajectory from a state to rest at any place, with twice the acceleration if need be."""
    for factor in (1.0, 2.0, 4.0):
        harder = replace(limits, accel_m_s2=factor * limits.accel_m_s2, speed_m_s=factor * limits.speed_m_s)
        box = Corridor((start[0] - 20.0)[None], (start[0] + 20.0)[None])
        trajectory = corridor_trajectory(box, start, None, harder)
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


def slowed(trajectory: CorridorTrajectory, duration_s: float) -> CorridorTrajectory:
    """Return a trajectory from rest to rest along the same path in a longer time [s]."""
    return replace(trajectory, knots_s=trajectory.knots_s * max(duration_s / trajectory.duration_s, 1.0))
