"""Euclidean distance field of an occupancy grid."""

import numpy as np
from scipy.ndimage import distance_transform_edt

from dronevio.models.occupancy import FREE, OCCUPIED, DistanceField, OccupancyGrid


def distance_field(grid: OccupancyGrid, *, unknown_is_obstacle: bool) -> DistanceField:
    """Return the distances to the nearest occupied cell, or to the nearest that is not known to be free."""
    is_clear = grid.states == FREE if unknown_is_obstacle else grid.states != OCCUPIED
    distance = distance_transform_edt(is_clear) * grid.cell_m if not is_clear.all() else np.full(is_clear.shape, np.inf)
    return DistanceField(grid.low_m, grid.cell_m, distance.astype(np.float32), grid.frame)
