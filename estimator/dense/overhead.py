"""View of surfaces vertically from above: the height map and the orthophoto of a flight over ground.

The triangles of the mesh are sampled at the centres of the cells, and the highest one remains (a z-buffer). A cell has
the mean colour of the points of the cloud near its surface, which are finer than the mesh, or else that of the mesh.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array, Floats, Image
from dronevio.models.errors import ConfigError
from dronevio.models.surfaces import Mesh, OverheadMap, PointCloud

Indices = npt.NDArray[np.int64]

LARGEST_SIDE = 8_192
"""Largest number of rows or columns; the cells of larger maps are larger than requested."""
NEAR_CELLS = 3.0
"""Largest distance of a point from the surface along z whose colour it contributes to, in cells."""

_SAMPLES = 1 << 22  # of triangles, at a time


@dataclass(frozen=True)
class _Grid:
    """Cells of a map."""

    west: float
    """Smallest x."""
    north: float
    """Largest y."""
    cell: float
    """Side of a cell."""
    rows: int
    """Number of rows, from north to south."""
    columns: int
    """Number of columns, from west to east."""

    def coordinates(self, xy: Array) -> Array:
        """Return columns and rows (…, 2) of positions (…, 2); the centre of the first cell is (0, 0)."""
        return np.asarray((xy - [self.west, self.north]) / [self.cell, -self.cell] - 0.5)


def overhead_map(cloud: PointCloud, mesh: Mesh, cell: float) -> OverheadMap:
    """Return the view of surfaces vertically from above.

    Args:
        cloud: The points of the surfaces, z up.
        mesh: The triangles of the same surfaces.
        cell: Side of a cell, in the unit of the surfaces; it grows if the map has more than `LARGEST_SIDE` rows or
            columns.

    Raises:
        ConfigError: The mesh has no triangles.
    """
    if not len(mesh.triangles):
        raise ConfigError("a map from above of a mesh without triangles; expected surfaces that images see")
    grid = _grid(mesh.vertices[np.unique(mesh.triangles), :2], cell)
    values = np.full((grid.rows * grid.columns, 4), np.nan, np.float32)  # height, red, green, blue
    corners = np.concatenate([mesh.vertices[:, 2:], mesh.colours], axis=1)[mesh.triangles]
    for cells, samples in _samples(grid.coordinates(mesh.vertices[:, :2])[mesh.triangles], corners, grid):
        order = np.lexsort((samples[:, 0], cells))
        is_top = np.append(np.diff(cells[order]) > 0, True)
        top, of = samples[order][is_top], cells[order][is_top]
        is_higher = ~(values[of, 0] >= top[:, 0])  # also where there is none
        values[of[is_higher]] = top[is_higher]
    heights = values[:, 0]
    colours = _with_points(values[:, 1:], heights, cloud, grid)
    shape = grid.rows, grid.columns
    return OverheadMap((grid.west, grid.north), grid.cell, heights.reshape(shape), colours.reshape(*shape, 3))


def _grid(xy: Array, cell: float) -> _Grid:
    """Return the cells around positions (N, 2); edges are at multiples of the side."""
    low, high = xy.min(axis=0), xy.max(axis=0)
    cell = max(cell, float((high - low).max()) / (LARGEST_SIDE - 1))
    first, last = np.floor(low / cell).astype(int), np.ceil(high / cell).astype(int)
    columns, rows = np.maximum(last - first, 1).tolist()
    return _Grid(float(cell * first[0]), float(cell * last[1]), cell, rows, columns)


def _samples(corners: Array, values: Array, grid: _Grid) -> Iterator[tuple[Indices, Floats]]:
    """Yield cells (S,) whose centres lie in triangles, with the interpolated values (S, V), some triangles at a time.

    Args:
        corners: (F, 3, 2) Columns and rows of the corners of the triangles.
        values: (F, 3, V) Values at the corners.
        grid: The cells.
    """
    last = np.array([grid.columns - 1, grid.rows - 1])
    low = np.clip(np.ceil(corners.min(axis=1) - 1e-9).astype(np.int64), 0, last + 1)
    high = np.clip(np.floor(corners.max(axis=1) + 1e-9).astype(np.int64), -1, last)
    size = np.maximum(high - low + 1, 0)
    ends = np.cumsum(size[:, 0] * size[:, 1])
    bounds = np.searchsorted(ends, np.arange(0, int(ends[-1]) + _SAMPLES, _SAMPLES))
    for start, stop in zip(bounds, np.append(bounds[1:], len(ends)), strict=True):
        count = size[start:stop, 0] * size[start:stop, 1]
        of = np.repeat(np.arange(start, stop), count)
        within = np.arange(len(of)) - np.repeat(np.cumsum(count) - count, count)
        cell = low[of] + np.stack([within % size[of, 0], within // size[of, 0]], axis=1)
        a, b, c = (corners[of, k] for k in range(3))
        with np.errstate(divide="ignore", invalid="ignore"):  # a vertical triangle has no area
            weight_b, weight_c = (_cross(cell - a, c - a), _cross(b - a, cell - a)) / _cross(b - a, c - a)
            weights = np.stack([1.0 - weight_b - weight_c, weight_b, weight_c], axis=1)
        inside = (weights >= -1e-9).all(axis=1)  # not where they are NaN
        if not inside.any():
            continue
        interpolated = np.einsum("sk,skv->sv", weights[inside], values[of[inside]])
        yield cell[inside, 1] * grid.columns + cell[inside, 0], interpolated.astype(np.float32)


def _cross(a: Array, b: Array) -> Array:
    """Return the cross products (S,) of plane vectors (S, 2)."""
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _with_points(colours: Floats, heights: Floats, cloud: PointCloud, grid: _Grid) -> Image:
    """Return colours (N, 3) of cells: those of the points near the surface, and otherwise the given ones."""
    column, row = np.rint(grid.coordinates(cloud.points[:, :2])).astype(np.int64).T
    inside = (column >= 0) & (row >= 0) & (column < grid.columns) & (row < grid.rows)
    cell = (row * grid.columns + column)[inside]
    near = np.abs(cloud.points[inside, 2] - heights[cell]) < NEAR_CELLS * grid.cell  # not where there is no surface
    cell, found = cell[near], cloud.colours[inside][near]
    counts = np.bincount(cell, minlength=len(colours))
    mixed = np.empty(colours.shape, np.uint8)
    for k in range(3):  # one at a time, since maps are large
        mean = np.bincount(cell, found[:, k], len(colours)) / np.maximum(counts, 1)
        mixed[:, k] = np.rint(np.where(counts > 0, mean, np.nan_to_num(colours[:, k])))
    return mixed
