"""What lies behind walls: unknown space there is rarely a passage, and a metre of it costs more than one elsewhere.

That the shortest path through unknown space is the best one to try is not true beside racks and rows of houses: behind
their first face it leads along them, since any part that is not seen yet may be a gap. In a plan view, *walls* are
straight parts of what is occupied, and what is *hidden* lies behind or before them.
"""

import cv2
import numpy as np

from dronevio.models.arrays import Floats, Image, Mask

_DIRECTIONS = 8  # of walls
_LEAST_M = 1.2  # length of a wall
_DEPTH_M = 4.0  # of what it hides
_COST = 2.0  # of a metre there


def path_costs(is_occupied: Mask, is_unknown: Mask, cell_m: float) -> Floats:
    """Return what a metre of a path costs (X, Y, Z): 1, but more in unknown space that is hidden by a wall.

    Args:
        is_occupied: (X, Y, Z) What was seen to be occupied.
        is_unknown: (X, Y, Z) What was not seen.
        cell_m: Side of a cell [m].
    """
    plan = np.asarray(is_occupied.any(axis=2), np.uint8)
    thick = cv2.dilate(plan, np.ones((2, 2), np.uint8))  # so that a slanted line has no steps
    hidden = np.zeros(plan.shape, np.bool_)
    for angle in np.pi / _DIRECTIONS * np.arange(_DIRECTIONS):
        walls = cv2.morphologyEx(thick, cv2.MORPH_OPEN, _line(_LEAST_M / cell_m, angle))
        hidden |= cv2.dilate(walls, _line(2.0 * _DEPTH_M / cell_m, angle + 0.5 * np.pi)) > 0
    return np.where(is_unknown & hidden[:, :, None], np.float32(_COST), np.float32(1.0))


def _line(length: float, angle_rad: float) -> Image:
    """Return a line through the centre of a structuring element, by its length [cells] and its angle from the rows."""
    half = round(0.5 * length)
    along = np.linspace(-half, half, 4 * half + 1)
    cells = np.round(np.outer(along, [np.cos(angle_rad), np.sin(angle_rad)])).astype(int) + half
    kernel = np.zeros((2 * half + 1, 2 * half + 1), np.uint8)
    kernel[tuple(cells.T)] = 1
    return kernel
