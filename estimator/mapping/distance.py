"""Euclidean distance field of an occupancy grid.

The distance transform is separable: OpenCV's transform of each horizontal slice, then the lower envelope of the
parabolas along the third axis.

Source: Felzenszwalb and Huttenlocher, "Distance transforms of sampled functions", Theory of Computing 2012.
"""

import cv2
import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Floats, Mask
from dronevio.models.occupancy import FREE, OCCUPIED, DistanceField, OccupancyGrid


def distance_field(grid: OccupancyGrid, *, unknown_is_obstacle: bool) -> DistanceField:
    """Return the distances to the nearest occupied cell, or to the nearest that is not known to be free.

    Args:
        grid: Grid; what lies outside it is no obstacle.
        unknown_is_obstacle: Whether unknown cells are obstacles.

    Returns:
        The distances between centres of cells, inf without an obstacle in the grid.
    """
    is_clear = grid.states == FREE if unknown_is_obstacle else grid.states != OCCUPIED
    squared = _squared_distances(np.ascontiguousarray(np.moveaxis(is_clear, 2, 0)))
    distance = np.sqrt(np.moveaxis(squared, 0, 2)) * np.float32(grid.cell_m)
    return DistanceField(grid.low_m, grid.cell_m, np.ascontiguousarray(distance), grid.frame)


def _squared_distances(is_clear: Mask) -> Floats:
    """Return the squared distances (Z, X, Y) to the nearest cell that is not clear [cells²]."""
    in_slice = np.full(is_clear.shape, np.inf, np.float32)
    slices: npt.NDArray[np.uint8] = is_clear.view(np.uint8)
    for index in np.flatnonzero(~is_clear.all(axis=(1, 2))):
        in_slice[index] = cv2.distanceTransform(slices[index], cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    np.rint(in_slice * in_slice, out=in_slice)
    squared = in_slice.copy()
    for shift in range(1, len(is_clear)):
        if shift * shift >= squared.max(initial=0.0):
            break
        parabola = in_slice + np.float32(shift * shift)
        np.minimum(squared[shift:], parabola[:-shift], out=squared[shift:])
        np.minimum(squared[:-shift], parabola[shift:], out=squared[:-shift])
    return squared
