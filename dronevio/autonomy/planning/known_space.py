"""Space that a vehicle may enter, by what is known of it."""

from dataclasses import dataclass, replace

import numpy as np

from dronevio.autonomy.planning.body import Body, body_distance
from dronevio.models.arrays import Array, Mask
from dronevio.models.occupancy import FREE, OCCUPIED, UNKNOWN, DistanceField, OccupancyGrid

NEAR_M = 1.9
"""Distance along each axis within which the vehicle sees what is 4 cm wide, and from which its front can stop: from
2 m/s with twice 3 m/s² in 0.64 m, after 0.2 s until the next plan and as long until it is flown [m]."""


@dataclass(frozen=True, eq=False)
class LocalSpace:
    """Where the centre of the vehicle may be, by the local map.

    The body keeps its margin from surfaces, whose places have errors. It does not enter unknown space, but for gaps in
    free space that are one cell thick, and beyond `NEAR_M` four cells: along edges in the image, the depth is unknown
    until they are seen from another side, and what such a gap may hide is seen from `NEAR_M` away.
    """

    grid: OccupancyGrid
    """The local map, in which the thin gaps are free."""
    distance: DistanceField
    """Horizontal distances to surfaces, or to what is unknown if that is nearer less the margin of the body."""

    @classmethod
    def of(cls, grid: OccupancyGrid, body: Body, position: Array, heights_m: Array | None = None) -> "LocalSpace":
        """Return the space for a body; nothing outside the grid is known.

        Args:
            grid: The local map.
            body: The body.
            position: (3,) Where it is [m].
            heights_m: (2,) Least and greatest z that it may have, but for where it is; None for any [m].
        """
        unknown = grid.states == UNKNOWN
        unseen = _thick(unknown, 5)
        reach = round(NEAR_M / grid.cell_m)
        low, high = (np.clip(grid.cells(position) + end, 0, grid.states.shape) for end in (-reach, reach + 1))
        near = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        unseen[near] = _thick(unknown[near], 2)
        for axis in range(3):
            ends = np.moveaxis(unseen, axis, 0)
            ends[0] = ends[-1] = True
        to_surfaces = body_distance(grid, grid.states == OCCUPIED, body).distance_m
        to_unseen = body_distance(grid, unseen, body).distance_m
        to_unseen += np.where(to_unseen > 0.0, np.float32(body.radius_m - body.bare_radius_m), np.float32(0.0))
        distance = DistanceField(grid.low_m, grid.cell_m, np.minimum(to_surfaces, to_unseen), grid.frame)
        if heights_m is not None:
            z = grid.low_m[2] + grid.cell_m * (np.arange(grid.states.shape[2]) + 0.5)
            half_m = 0.5 * grid.cell_m
            least, most = min(heights_m[0], position[2] - half_m), max(heights_m[1], position[2] + half_m)
            distance.distance_m[..., (z < least - 1e-6) | (z > most + 1e-6)] = 0.0
        states = np.where((grid.states == UNKNOWN) & ~unseen, np.uint8(FREE), grid.states)
        return cls(replace(grid, states=states), distance)

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


def _thick(cells: Mask, side: int) -> Mask:
    """Return the cells (X, Y, Z) of a mask that lie in a cube of its cells with a side of some cells."""
    cubes = cells
    for axis in range(3):
        for _ in range(side - 1):
            a = np.moveaxis(cubes, axis, 0)
            cubes = np.moveaxis(a[:-1] & a[1:], 0, axis)
    for axis in range(3):
        for _ in range(side - 1):
            a = np.moveaxis(cubes, axis, 0)
            grown = np.zeros((a.shape[0] + 1, *a.shape[1:]), np.bool_)
            grown[:-1] |= a
            grown[1:] |= a
            cubes = np.moveaxis(grown, 0, axis)
    return np.asarray(cubes)


def with_free_column(grid: OccupancyGrid, foot: Array, radius_m: float, top_m: float) -> OccupancyGrid:
    """Return a grid in which the unknown cells of an upright column are free.

    Args:
        grid: The grid.
        foot: (3,) Foot of the axis in the frame of the grid [m].
        radius_m: Radius [m].
        top_m: Height [m].
    """
    reach = np.array([radius_m, radius_m, 0.0])
    low, high = grid.cells(foot - reach), grid.cells(foot + reach + [0.0, 0.0, top_m]) + 1
    low, high = np.clip(low, 0, grid.states.shape), np.clip(high, 0, grid.states.shape)
    if np.any(high <= low):
        return grid
    states = grid.states.copy()
    part = states[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
    x, y = (grid.low_m[k] + grid.cell_m * (np.arange(low[k], high[k]) + 0.5) - foot[k] for k in (0, 1))
    is_near = np.hypot(x[:, None], y) <= radius_m
    part[is_near[..., None] & (part == UNKNOWN)] = FREE
    return replace(grid, states=states)


def around(points: Array, body: Body, cell_m: float) -> Array:
    """Return points (K, 3), one in each cell or so, of the space of a body at points (N, 3) [m]."""
    aside = np.arange(-body.radius_m, body.radius_m + 0.5 * cell_m, cell_m)
    up = np.arange(-body.half_height_m, body.half_height_m + 0.5 * cell_m, cell_m)
    offsets = np.stack(np.meshgrid(aside, aside, up, indexing="ij"), axis=-1).reshape(-1, 3)
    offsets = offsets[np.hypot(offsets[:, 0], offsets[:, 1]) <= body.radius_m]
    return np.asarray((points[:, None] + offsets).reshape(-1, 3))
