"""Corridors: overlapping boxes of free cells along a polyline.

Each box begins as the longest stretch of the polyline whose bounding box is free, and is then grown by one layer of
cells at a time on each side, until it meets a cell that is not free. Sums over boxes of cells are taken from a
summed-volume table.

Source: Gao, Wu, Gao and Shen, "Flying on point clouds: Online trajectory generation and autonomous navigation for
quadrotors in cluttered environments", 2019, for the corridors of boxes.
"""

from dataclasses import dataclass
from itertools import pairwise, permutations

import numpy as np

from dronevio.models.arrays import Array, Integers, Mask
from dronevio.models.occupancy import FREE, DistanceField, OccupancyGrid

_SAMPLES_PER_CELL = 4  # of the polyline; cells that it clips by less are not visited


@dataclass(frozen=True, eq=False)
class Corridor:
    """Boxes aligned with the axes of their frame, each of which overlaps the next."""

    low_m: Array
    """(K, 3) Lower corners of the boxes [m]."""
    high_m: Array
    """(K, 3) Upper corners of the boxes [m]."""

    @property
    def portals(self) -> tuple[Array, Array]:
        """Lower and upper corners (K - 1, 3) of the intersections of consecutive boxes [m]."""
        return np.maximum(self.low_m[:-1], self.low_m[1:]), np.minimum(self.high_m[:-1], self.high_m[1:])


def passable(grid: OccupancyGrid, distance: DistanceField, clearance_m: float) -> Mask:
    """Return which cells (X, Y, Z) are free and at least a distance [m] from obstacles, between centres of cells."""
    return np.asarray((grid.states == FREE) & (distance.distance_m >= clearance_m))


def corridor_along(grid: OccupancyGrid, is_passable: Mask, waypoints: Array, reach_m: float) -> Corridor | None:
    """Return the corridor along a polyline, or None if the polyline leaves the passable cells.

    Every point of a box lies in a passable cell. Where the polyline passes between cells diagonally, it goes through
    one of the cells beside that is passable; there is one for a polyline whose cells have two cells more clearance than
    passable ones need.

    Args:
        grid: Grid that defines the cells.
        is_passable: (X, Y, Z) Where the centre of the vehicle may be.
        waypoints: (N, 3) Polyline from the start to the goal in the frame of the grid [m].
        reach_m: Largest distance by which a box exceeds its stretch of the polyline, and length of that stretch along
            an axis [m]. It bounds the time of a call.
    """
    cells = _cells_along(grid, waypoints)
    if not (np.all((cells >= 0) & (cells < is_passable.shape)) and np.all(is_passable[tuple(cells.T)])):
        return None
    cells = _through_faces(cells, is_passable)
    reach = max(int(reach_m / grid.cell_m), 1)
    low, high = np.maximum(cells.min(axis=0) - reach, 0), cells.max(axis=0) + reach + 1
    window = is_passable[tuple(slice(*ends) for ends in zip(low, high, strict=True))]
    blocked, cells = _summed(~window), cells - low
    boxes, first = [], 0
    while True:
        stretch = _free_stretch(blocked, cells[first:], reach)
        box = _grown(blocked, *stretch, reach)
        boxes.append(box)
        outside = np.flatnonzero(np.any((cells[first:] < box[0]) | (cells[first:] >= box[1]), axis=1))
        if not len(outside):
            break
        if outside[0] == 1:
            return None
        first += outside[0] - 1
    corners = np.array(boxes) + low
    return Corridor(grid.low_m + grid.cell_m * corners[:, 0], grid.low_m + grid.cell_m * corners[:, 1])


def _cells_along(grid: OccupancyGrid, waypoints: Array) -> Integers:
    """Return the cells (M, 3) along a polyline without repetition of one by the next."""
    lengths = np.linalg.norm(np.diff(waypoints, axis=0), axis=1)
    counts = np.ceil(lengths / grid.cell_m * _SAMPLES_PER_CELL).astype(int) + 1
    legs = zip(waypoints[:-1], waypoints[1:], counts, strict=True)
    points = [waypoints[:1], *(np.linspace(start, end, count) for start, end, count in legs)]
    cells = grid.cells(np.vstack(points))
    return np.asarray(cells[np.append(True, np.any(np.diff(cells, axis=0) != 0, axis=1))])


def _through_faces(cells: Integers, is_passable: Mask) -> Integers:
    """Return cells (M, 3) with further ones between those that share no face, by way of passable cells if there are."""
    chain = [cells[:1]]
    for a, b in pairwise(cells):
        axes = np.flatnonzero(a != b)
        if len(axes) > 1:
            ways = (_steps(a, b, order) for order in permutations(axes.tolist()))
            chain.append(next((way for way in ways if is_passable[tuple(way.T)].all()), b[None]))
        else:
            chain.append(b[None])
    return np.concatenate(chain)


def _steps(a: Integers, b: Integers, axes: tuple[int, ...]) -> Integers:
    """Return the cells (K, 3) from one to another by a step along each axis in turn, without the first."""
    way = np.repeat(a[None], len(axes), axis=0)
    for k, axis in enumerate(axes):
        way[k:, axis] = b[axis]
    return way


def _summed(values: Mask) -> Integers:
    """Return the table (X + 1, Y + 1, Z + 1) of the sums of all values (X, Y, Z) below an index on each axis."""
    table = np.zeros(np.add(values.shape, 1), np.int64)
    table[1:, 1:, 1:] = values.astype(np.int64).cumsum(0).cumsum(1).cumsum(2)
    return table


def _sums(table: Integers, low: Integers, high: Integers) -> Integers:
    """Return the sums (…,) of the values of boxes of cells from low (…, 3) up to but not including high (…, 3)."""
    (i, j, k), (x, y, z) = np.moveaxis(low, -1, 0), np.moveaxis(high, -1, 0)
    above = table[x, y, z] - table[i, y, z] - table[x, j, z] + table[i, j, z]
    below = table[x, y, k] - table[i, y, k] - table[x, j, k] + table[i, j, k]
    return np.asarray(above - below)


def _free_stretch(blocked: Integers, cells: Integers, reach: int) -> tuple[Integers, Integers]:
    """Return the bounding box of as many of the first cells (M, 3) as it can contain without a blocked one."""
    low, high = np.minimum.accumulate(cells), np.maximum.accumulate(cells) + 1
    unfit = (_sums(blocked, low, high) > 0) | np.any(high - low > reach, axis=1)
    last = (int(np.argmax(unfit)) if unfit.any() else len(cells)) - 1
    return low[last], high[last]


def _grown(blocked: Integers, low: Integers, high: Integers, reach: int) -> tuple[Integers, Integers]:
    """Return a free box of cells, grown in turn by one layer on each side until it meets a blocked one."""
    corners = np.array([low, high])
    sides = [(end, axis) for axis in range(3) for end in range(2)]
    for _ in range(reach):
        for end, axis in list(sides):
            layer = corners.copy()
            layer[1 - end, axis] = corners[end, axis]
            layer[end, axis] += 2 * end - 1
            fits = 0 <= layer[end, axis] < blocked.shape[axis]
            if fits and not _sums(blocked, *layer):
                corners[end, axis] = layer[end, axis]
            else:
                sides.remove((end, axis))
    return corners[0], corners[1]
