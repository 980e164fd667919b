"""True maps of simulated worlds: which samples of a space are clear of its solids, and the map that they make.

They serve to draw goals, to score flights, and policies on perfect depth; never the planner of a flight on an estimate.
"""

import numpy as np

from dronevio.models.arrays import Array, Mask
from dronevio.models.occupancy import FREE, OCCUPIED, OccupancyGrid
from dronevio.sim.paths.solid_cells import near_obstacles
from dronevio.sim.paths.space import Space


def true_map(space: Space, cell_m: float = 0.1) -> OccupancyGrid:
    """Return the map of a space in the frame of the world: occupied are the cells that a solid may touch.

    These are the cells whose centres are within half a diagonal of a solid or of the bounds; all others are free. The
    lower corner of the first cell is that of the space, whose height is that of the floor.
    """
    _, is_free = clear_samples(space, cell_m, 0.5, 0.5 * 3.0**0.5 * cell_m)
    states = np.where(is_free, FREE, OCCUPIED).astype(np.uint8)
    return OccupancyGrid(space.low, cell_m, states, "map")


def clear_samples(space: Space, spacing_m: float, shift: float, least_m: float) -> tuple[Array, Mask]:
    """Return which samples of a space have a clearance.

    Args:
        space: Bounds and obstacles.
        spacing_m: Distance between samples along each axis [m].
        shift: Distance of the first sample from the lower corner along each axis [spacings].
        least_m: Clearance, more than 0 [m].

    Returns:
        Position of the first sample (3,) in the world [m], and whether samples (X, Y, Z) are clear.
    """
    first = space.low + spacing_m * shift
    shape = np.ceil((space.high - space.low) / spacing_m - 1e-9).astype(int)
    axes = [first[k] + spacing_m * np.arange(shape[k]) for k in range(3)]
    inside = [np.minimum(x - space.low[k], space.high[k] - x) >= least_m for k, x in enumerate(axes)]
    is_clear = inside[0][:, None, None] & inside[1][:, None] & inside[2]
    is_clear &= ~near_obstacles(space, first, spacing_m, shape, least_m)
    return first, is_clear
