"""What surrounds the drone, for drawings: textured surfaces, or outlines where these are not known."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.scenery import TexturedMesh


@dataclass(frozen=True, eq=False)
class MovingBox:
    """The bounding box of a moving object."""

    name: str
    """Name of the object."""
    low: Array
    """(3,) Smallest corner in the frame of the object [m]."""
    high: Array
    """(3,) Largest corner in the frame of the object [m]."""
    poses: Callable[[Array], Array]
    """Function from times (M,) since the start of the flight [s] to poses (M, 4, 4) in the world frame."""
    meshes: tuple[TexturedMesh, ...] = ()
    """Surfaces in the frame of the object, which are drawn instead of the box."""


@dataclass(frozen=True, eq=False)
class Surroundings:
    """The surroundings of a flight."""

    outline: Array
    """(L, 2, 3) Line segments in the world frame of the ground truth [m]."""
    moving_boxes: tuple[MovingBox, ...] = ()
    """Moving objects in the same frame."""
    meshes: tuple[TexturedMesh, ...] = ()
    """Surfaces in the same frame, which are drawn instead of the outline."""


NO_SURROUNDINGS = Surroundings(np.zeros((0, 2, 3)))
"""Surroundings that are not known."""
