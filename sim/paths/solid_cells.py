"""Solid cells: a space as a lattice, for rays of many vehicles at once."""

from dataclasses import dataclass

import numpy as np

from dronevio.models.arrays import Array, Integers, Mask
from dronevio.sim.paths.space import Space


@dataclass(frozen=True, eq=False)
class SolidCells:
    """Cells of a box that a solid may touch."""

    low_m: Array
    """(3,) Lower corner of the first cell, and of the bounds [m]."""
    high_m: Array
    """(3,) Upper corner of the bounds, within or at the end of the last cell [m]."""
    cell_m: float
    """Side of a cell [m]."""
    is_solid: Mask
    """(X, Y, Z) Whether the centre of a cell is within half its diagonal of a solid, so that no solid is missed."""


def solid_cells(space: Space, cell_m: float) -> SolidCells:
    """Return the solid cells within the bounds of a space, whose first cell begins at its lower corner.

    Args:
        space: Bounds and obstacles; a bound is no solid.
        cell_m: Side of a cell [m].
    """
    shape = np.ceil((space.high - space.low) / cell_m - 1e-9).astype(int)
    near_m = 0.5 * 3.0**0.5 * cell_m
    is_solid = near_obstacles(space, space.low + 0.5 * cell_m, cell_m, shape, near_m)
    return SolidCells(space.low.copy(), space.high.copy(), cell_m, is_solid)


def near_obstacles(space: Space, first: Array, spacing_m: float, shape: Integers, least_m: float) -> Mask:
    """Return which samples (X, Y, Z) of a space are nearer to an obstacle than a distance.

    Each obstacle is compared with the samples in its axis-aligned bounding box, which takes a small share of the time
    of `Space.clearance`.

    Args:
        space: Obstacles; its bounds are none.
        first: (3,) Position of the first sample [m].
        spacing_m: Distance between samples along each axis [m].
        shape: (3,) Number of samples along each axis.
        least_m: The distance, more than 0 [m].
    """
    axes = [first[k] + spacing_m * np.arange(shape[k]) for k in range(3)]
    is_near = np.zeros(shape, np.bool_)
    reach = np.einsum("kij,kj->ki", np.abs(space.rotations), space.halves) + least_m
    low = np.clip(np.floor((space.centres - reach - first) / spacing_m), 0, shape).astype(int)
    high = np.clip(np.ceil((space.centres + reach - first) / spacing_m) + 1, 0, shape).astype(int)
    for centre, half, R, a, b in zip(space.centres, space.halves, space.rotations, low, high, strict=True):
        if np.any(a >= b):
            continue
        x, y, z = (axes[k][a[k] : b[k]] - centre[k] for k in range(3))
        squared = np.zeros(b - a)
        for along, half_m in zip(R.T, half, strict=True):
            beyond = np.abs((along[0] * x[:, None] + along[1] * y)[..., None] + along[2] * z) - half_m
            squared += np.maximum(beyond, 0.0) ** 2
        is_near[a[0] : b[0], a[1] : b[1], a[2] : b[2]] |= squared < least_m * least_m
    return is_near
