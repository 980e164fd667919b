"""The space that a vehicle needs: a flat cylinder around its centre, with margins for tracking and mapping errors."""

from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Floats, Mask
from dronevio.models.occupancy import DistanceField, OccupancyGrid
from dronevio.models.ranges import Range, Settings


@dataclass(frozen=True)
class Body(Settings):
    """Flat cylinder that must be free around the centre of mass.

    The propellers of the research quadrotor reach 0.33 m from its axis, its feet 0.13 m below its centre. Cells whose
    centres are within these bounds of the centre of the vehicle's cell are free, so that with cells of 10 cm the
    nearest surface is at least half a cell and the vehicle's offset in its cell, 0.1 m together, closer.
    """

    radius_m: Annotated[float, Range(0.05, 5.0)] = 0.45
    """Horizontal distance between centres of cells within which all is free [m]."""
    half_height_m: Annotated[float, Range(0.0, 5.0)] = 0.2
    """Vertical distance between centres of cells within which all is free [m]."""


def horizontal_distance(grid: OccupancyGrid, is_blocked: Mask, body: Body) -> DistanceField:
    """Return how far blocked cells are on each level, if a cell blocks the levels within half the body's height.

    Args:
        grid: Grid that defines the cells.
        is_blocked: (X, Y, Z) Cells where the body may not be; what lies outside the grid does not count.
        body: The body.

    Returns:
        The horizontal distances between centres of cells [m], inf on a level that nothing blocks.
    """
    levels = int(body.half_height_m / grid.cell_m + 1e-6)
    blocked = is_blocked.copy()
    for shift in range(1, min(levels, is_blocked.shape[2] - 1) + 1):
        blocked[..., shift:] |= is_blocked[..., :-shift]
        blocked[..., :-shift] |= is_blocked[..., shift:]
    clear: npt.NDArray[np.uint8] = np.ascontiguousarray(np.moveaxis(~blocked, 2, 0)).view(np.uint8)
    distance: Floats = np.full(clear.shape, np.inf, np.float32)
    for level in np.flatnonzero(~clear.all(axis=(1, 2))):
        distance[level] = cv2.distanceTransform(clear[level], cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    distance *= np.float32(grid.cell_m)
    return DistanceField(grid.low_m, grid.cell_m, np.ascontiguousarray(np.moveaxis(distance, 0, 2)), grid.frame)
