"""The body of the drone for plans: an upright flat cylinder, and the room around it in horizontal slices of a map.

A multirotor is wide and flat, and flies nearly level. A sphere around it would close doors under whose lintel it fits.
"""

from dataclasses import dataclass, replace
from typing import Annotated, Self

import cv2
import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Floats, Mask
from dronevio.models.occupancy import DistanceField, OccupancyGrid
from dronevio.models.ranges import Range, Settings


@dataclass(frozen=True)
class Body(Settings):
    """Upright cylinder around the centre of mass that must be free, with margins for errors of control and map.

    The propellers of the research quadrotor reach 0.33 m from its axis, its feet 0.13 m below its centre. The cylinder
    is measured between centres of cells: surface and vehicle may each be half a cell nearer.
    """

    radius_m: Annotated[float, Range(0.05, 5.0)] = 0.45
    """Radius that keeps clear of surfaces [m]."""
    bare_radius_m: Annotated[float, Range(0.05, 5.0)] = 0.35
    """Radius without margins, which does not enter unknown space [m]."""
    half_height_m: Annotated[float, Range(0.0, 5.0)] = 0.2
    """Half the height [m]."""

    def grown(self, margin_m: float) -> Self:
        """Return the body with a further margin around it [m]."""
        return replace(self, radius_m=self.radius_m + margin_m, bare_radius_m=self.bare_radius_m + margin_m)


def horizontal_distance(blocked: Mask, cell_m: float, half_height_m: float) -> Floats:
    """Return the distances to the nearest blocked cell in the horizontal slice, for a body of some height.

    Blocked cells are first dilated vertically by half the height, rounded up to whole cells. A cylinder around the
    centre of a cell then touches no centre of a blocked cell if the distance exceeds its radius.

    Args:
        blocked: (X, Y, Z) Where the body may not touch; nothing outside is blocked.
        cell_m: Side of a cell [m].
        half_height_m: Half the height of the body [m].

    Returns:
        The distances (X, Y, Z) between centres of cells [m]: 0 in a dilated cell, inf in a slice without one.
    """
    slices = np.ascontiguousarray(np.moveaxis(blocked, 2, 0))
    dilated = slices.copy()
    for shift in range(1, min(int(np.ceil(half_height_m / cell_m - 1e-6)) + 1, len(slices))):
        dilated[shift:] |= slices[:-shift]
        dilated[:-shift] |= slices[shift:]
    distance = np.full(slices.shape, np.inf, np.float32)
    is_clear: npt.NDArray[np.uint8] = (~dilated).view(np.uint8)
    for index in np.flatnonzero(dilated.any(axis=(1, 2))):
        cv2.distanceTransform(is_clear[index], cv2.DIST_L2, cv2.DIST_MASK_PRECISE, dst=distance[index])
    distance *= np.float32(cell_m)
    return np.moveaxis(distance, 0, 2)


def body_distance(grid: OccupancyGrid, blocked: Mask, body: Body) -> DistanceField:
    """Return the field of `horizontal_distance` for the cells (X, Y, Z) of a grid that block a body."""
    distance = np.ascontiguousarray(horizontal_distance(blocked, grid.cell_m, body.half_height_m))
    return DistanceField(grid.low_m, grid.cell_m, distance, grid.frame)
