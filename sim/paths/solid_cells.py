"""Solid cells: a space as a lattice, for rays of many vehicles at once."""

from dataclasses import dataclass

import numpy as np

from dronevio.models.arrays import Array, Mask
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
    axes = [space.low[k] + cell_m * (np.arange(shape[k]) + 0.5) for k in range(3)]
    near_m = 0.5 * 3.0**0.5 * cell_m
    is_solid = np.zeros(shape, np.bool_)
    # Each obstacle within its axis-aligned bounding box
    reach = np.einsum("kij,kj->ki", np.abs(space.rotations), space.halves) + near_m
    low = np.clip(np.floor((space.centres - reach - space.low) / cell_m), 0, shape).astype(int)
    high = np.clip(np.ceil((space.centres + reach - space.low) / cell_m), 0, shape).astype(int)
    for centre, half, R, a, b in zip(space.centres, space.halves, space.rotations, low, high, strict=True):
        if np.any(a >= b):
            continue
        x, y, z = (axes[k][a[k] : b[k]] - centre[k] for k in range(3))
        squared = np.zeros(b - a)
        for along, half_m in zip(R.T, half, strict=True):
            beyond = np.abs((along[0] * x[:, None] + along[1] * y)[..., None] + along[2] * z) - half_m
            squared += np.maximum(beyond, 0.0) ** 2
        is_solid[a[0] : b[0], a[1] : b[1], a[2] : b[2]] |= squared <= near_m * near_m
    return SolidCells(space.low.copy(), space.high.copy(), cell_m, is_solid)
