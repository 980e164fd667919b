"""Prisms that approximate round objects: their lateral surfaces, and the boxes that fill them.

A prism over a regular polygon with an even number of sides is exactly the union of the boxes over its opposite sides.
"""

from functools import partial

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.rotation import rotation_z
from dronevio.sim.appearance import textures
from dronevio.sim.appearance.solids import Box

UNPAINTED = partial(textures.plain, colour=(0.0, 0.0, 0.0))
"""Paint of boxes that are obstacles only and are never visible."""


def lateral_surface(heights: Array, radii: Array, sides: int, axis_offset: Array | None = None) -> Array:
    """Return the lateral surface of an upright round object, a grid (S, sides + 1, 3) [m], seen from outside.

    Args:
        heights: (S,) Heights of its rings, from top to bottom [m].
        radii: (S,) Radii of its rings, from the axis to the corners [m].
        sides: Number of sides; the first corner is on the x axis.
        axis_offset: (S, 2) Offset of each ring from the axis [m]; none by default.
    """
    angle = np.linspace(0.0, 2.0 * np.pi, sides + 1)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    grid = np.empty((len(heights), sides + 1, 3))
    grid[..., :2] = radii[:, None, None] * ring + (0.0 if axis_offset is None else axis_offset[:, None])
    grid[..., 2] = heights[:, None]
    return grid


def prism_boxes(radius_m: float, low_m: float, high_m: float, sides: int) -> list[Box]:
    """Return boxes whose union is the upright prism around the z axis with a corner on the x axis.

    Args:
        radius_m: Distance from the axis to the corners [m].
        low_m: Height of the lower end [m].
        high_m: Height of the upper end [m].
        sides: Number of sides, which is even.
    """
    across, along = radius_m * np.sin(np.pi / sides), radius_m * np.cos(np.pi / sides)
    half = np.array([along, across, 0.5 * (high_m - low_m)])
    centre = np.array([0.0, 0.0, 0.5 * (low_m + high_m)])
    return [Box(centre, half, UNPAINTED, R=rotation_z((k + 0.5) * 2.0 * np.pi / sides)) for k in range(sides // 2)]
