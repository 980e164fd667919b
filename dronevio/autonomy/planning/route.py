"""Global routes through the known-free space of a map: shortest paths between cells, then shortcuts.

A cell is *clear* if it is free and nothing that is not known to be free, and no border of the grid, is nearer than the
clearance. A route passes clear cells only. What determines it are the arguments alone, never the time that it takes.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import ndimage

from dronevio.autonomy.planning.lattice_search import shortest_path
from dronevio.models.arrays import Array, Floats, Integers, Mask
from dronevio.models.errors import ConfigError
from dronevio.models.occupancy import FREE, DistanceField, OccupancyGrid

_ROUNDING_M = 1e-6  # by which the cost of a straight line may exceed that of the path that it replaces
_NEIGHBOURS = np.ones((3, 3, 3), np.bool_)


@dataclass(frozen=True, eq=False)
class Route:
    """Polyline through clear cells."""

    waypoints: Array
    """(N, 3) Corners from the start to the end, in the frame of the grid [m]."""
    short_of_goal_m: float
    """Distance of the end from the goal, 0 if the goal is reached [m]."""
    expansions: int
    """Number of cells that the search expanded; 0 for a straight line."""

    @property
    def length_m(self) -> float:
        """Length of the polyline [m]."""
        return float(np.linalg.norm(np.diff(self.waypoints, axis=0), axis=1).sum())


@dataclass(frozen=True)
class NoRoute:
    """Why there is no route."""

    cause: Literal["start", "goal", "search"]
    """No clear cell is in reach of the start, none that can be reached is near the goal, or the search was ended."""
    reason: str
    """The same with figures, for people."""


def route(
    grid: OccupancyGrid,
    distance: DistanceField,
    start: Array,
    goal: Array,
    *,
    clearance_m: float,
    near_m: float = 1.0,
    cell_costs: Floats | None = None,
    max_expansions: int = 1_000_000,
) -> Route | NoRoute:
    """Return a short route from a start to a goal, or to the nearest place that can be reached.

    Distances are those of the field, between centres of cells: any point of the route is at least `clearance_m` less
    √3 cells from what is not known to be free. A start that is not clear but free is left along a straight line through
    free cells to the nearest clear one. In place of a goal that is not clear, or that cannot be reached, the route
    leads to the nearest clear cell that can.

    Args:
        grid: What is free.
        distance: Distances to the nearest cell that is not free, of the cells of the grid.
        start: (3,) First point [m].
        goal: (3,) Point to be reached [m].
        clearance_m: Least distance of cells on the route from what is not free [m].
        near_m: Distance from a start or goal within which a place is sought instead [m].
        cell_costs: (X, Y, Z) Cost of a metre in each cell, at least 1; by default 1, so that the route is short.
        max_expansions: Number of cells after which the search is ended.

    Raises:
        ConfigError: Grid and distances are not of the same cells, or a point is not finite.
    """
    _check(grid, distance, start, goal)
    is_clear = _clear(grid, distance, clearance_m)
    is_free, near = grid.states == FREE, _nearest(grid, is_clear, start, near_m)
    first = next((cell for cell in near if _passes(is_free, grid, start, grid.centres(cell))), None)
    if first is None:
        return NoRoute("start", f"no cell with {clearance_m:.2f} m of clearance within {near_m:.2f} m of {_at(start)}")
    ends = [start] if is_clear[tuple(grid.cells(start))] else [start, grid.centres(first)]
    cost = np.where(is_clear, np.float32(1.0) if cell_costs is None else cell_costs, np.float32(np.inf))
    if _cost(cost, grid, ends[-1], goal) <= np.linalg.norm(goal - ends[-1]) + _ROUNDING_M:
        return Route(np.stack([*ends, goal]), 0.0, 0)
    parts, _ = ndimage.label(is_clear, _NEIGHBOURS)
    last = next(_nearest(grid, parts == parts[tuple(first)], goal, near_m), None)
    if last is None:
        return NoRoute("goal", f"nothing within {near_m:.2f} m of {_at(goal)} can be reached from {_at(start)}")
    path = shortest_path(is_clear, first, last, max_expansions, cell_costs=cell_costs)
    if path.cells is None:
        return NoRoute("search", f"none found from {_at(start)} to {_at(goal)} in {max_expansions} expansions")
    is_goal = bool(np.all(last == grid.cells(goal)))
    end = goal if is_goal else grid.centres(last)
    points = np.concatenate([ends[-1:], grid.centres(path.cells), end[None]])  # points and centres of the same cells
    shortened = _shortcut(cost, grid, points[np.append(True, np.diff(points, axis=0).any(axis=1))])
    waypoints = np.concatenate([[start], shortened]) if len(ends) > 1 else shortened
    return Route(waypoints, 0.0 if is_goal else float(np.linalg.norm(end - goal)), path.expansions)


def _check(grid: OccupancyGrid, distance: DistanceField, start: Array, goal: Array) -> None:
    """Check that a field has the cells of a grid and that points are finite."""
    same = grid.frame == distance.frame and grid.cell_m == distance.cell_m
    if not same or distance.distance_m.shape != grid.states.shape or not np.array_equal(distance.low_m, grid.low_m):
        raise ConfigError(
            f"distances of shape {distance.distance_m.shape} in the frame {distance.frame} for a grid of shape"
            f" {grid.states.shape} in the frame {grid.frame}; expected those of the same cells"
        )
    for name, point in (("start", start), ("goal", goal)):
        if np.shape(point) != (3,) or not np.isfinite(point).all():
            raise ConfigError(f"{name} of the route = {point}; expected three finite numbers")


def _clear(grid: OccupancyGrid, distance: DistanceField, clearance_m: float) -> Mask:
    """Return the mask (X, Y, Z) of the cells that a route may pass; what lies outside the grid is not free."""
    is_clear = np.zeros(grid.states.shape, np.bool_)
    border = max(int(np.ceil(clearance_m / grid.cell_m - 1e-6)) - 1, 0)
    inner = tuple(slice(border, max(size - border, border)) for size in grid.states.shape)
    is_clear[inner] = (grid.states[inner] == FREE) & (distance.distance_m[inner] >= clearance_m - 1e-6)
    return is_clear


def _nearest(grid: OccupancyGrid, mask: Mask, point: Array, radius_m: float) -> Iterator[Integers]:
    """Yield the cells (3,) of a mask, that of a point or those whose centres are within a radius of it, by distance."""
    cell = grid.cells(point)
    if np.all((cell >= 0) & (cell < mask.shape)) and mask[tuple(cell)]:
        yield cell
        return
    reach = int(np.ceil(radius_m / grid.cell_m))
    low, high = np.clip(cell - reach, 0, mask.shape), np.clip(cell + reach + 1, 0, mask.shape)
    cells = np.argwhere(mask[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]) + low
    apart = np.linalg.norm(grid.centres(cells) - point, axis=-1)
    yield from cells[[k for k in np.argsort(apart, kind="stable") if apart[k] <= radius_m]]


def _passes(mask: Mask, grid: OccupancyGrid, start: Array, end: Array) -> bool:
    """Return whether all cells that a straight line passes are in a mask; none outside the grid is."""
    cells, _ = _crossed(mask.shape, grid, start, end)
    return cells is not None and bool(mask[tuple(cells.T)].all())


def _cost(cost: Floats, grid: OccupancyGrid, start: Array, end: Array) -> float:
    """Return the cost of a straight line through cells with a cost (X, Y, Z) of a metre each; inf outside the grid."""
    cells, lengths_m = _crossed(cost.shape, grid, start, end)
    costs = np.full(1, np.inf) if cells is None else cost[tuple(cells.T)]
    return float(lengths_m @ costs) if np.isfinite(costs).all() else np.inf


def _crossed(shape: tuple[int, ...], grid: OccupancyGrid, start: Array, end: Array) -> tuple[Integers | None, Array]:
    """Return the cells (K, 3) that a straight line passes, and the lengths (K,) in them [m]; None outside the grid."""
    a, b = (start - grid.low_m) / grid.cell_m, (end - grid.low_m) / grid.cell_m
    if not all(np.all((p >= 0.0) & (p < shape)) for p in (a, b)):
        return None, np.zeros(0)
    crossed = [np.arange(np.floor(min(p, q)) + 1.0, np.ceil(max(p, q))) for p, q in zip(a, b, strict=True)]
    share = np.concatenate([(c - p) / (q - p) for c, p, q in zip(crossed, a, b, strict=True) if len(c)] + [[0.0, 1.0]])
    share.sort()
    cells = np.floor(a + (0.5 * (share[1:] + share[:-1]))[:, None] * (b - a)).astype(np.int64)
    return cells, np.diff(share) * float(np.linalg.norm(end - start))


def _shortcut(cost: Floats, grid: OccupancyGrid, path: Array) -> Array:
    """Return the points (L, 3) of a path (M, 3) that remain after shortcuts along straight lines of no larger cost.

    From each point, the reach of the line is doubled until it is blocked or costs more, and then found by bisection.

    Args:
        cost: (X, Y, Z) Cost of a metre in each cell; inf where a path may not pass.
        grid: The grid of the cells.
        path: (M, 3) Centres of neighbouring cells, and the two ends [m].
    """
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    of_points = cost[tuple(grid.cells(path).T)]
    so_far = np.append(0.0, np.cumsum(steps * 0.5 * (of_points[1:] + of_points[:-1])))

    def is_no_worse(i: int, j: int) -> bool:
        return _cost(cost, grid, path[i], path[j]) <= float(so_far[j] - so_far[i]) + _ROUNDING_M

    kept, here, end = [0], 0, len(path) - 1
    while here < end:
        reached, beyond, step = here + 1, end + 1, 2
        while beyond > end and reached < end:
            there = min(here + step, end)
            if is_no_worse(here, there):
                reached, step = there, 2 * step
            else:
                beyond = there
        while beyond - reached > 1 and reached < end:
            there = (reached + beyond) // 2
            reached, beyond = (there, beyond) if is_no_worse(here, there) else (reached, there)
        here = reached
        kept.append(here)
    return path[kept]


def _at(point: Array) -> str:
    """Return a point for messages."""
    return f"{np.round(point, 2).tolist()} m"
