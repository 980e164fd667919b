"""Boxes, faces and curved sheets: the geometry of rooms and furniture."""

import itertools
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Protocol, TypeVar

import numpy as np

from dronevio.models.arrays import Array, Image
from dronevio.sim.appearance.instances import UNNAMED, Instance
from dronevio.sim.appearance.textures import PIXELS_PER_M

Paint = Callable[[np.random.Generator, int, int], Image]
"""Function that draws an image of the given height and width [px]."""

_HIDDEN_BELOW_M = 0.03  # a face this close to a wall is never visible


class Surface(Protocol):
    """Interface of painted surfaces, flat or curved: a grid of points with a texture."""

    @property
    def grid(self) -> Array:
        """(R + 1, C + 1, 3) Points of the surface [m]: the first row is the top, the first column the left, as seen."""

    @property
    def paint(self) -> Paint:
        """Paint of the surface."""

    @property
    def glow(self) -> float:
        """Emission relative to a well-lit surface."""

    @property
    def pixels_per_m(self) -> float:
        """Resolution of the texture [px/m]."""

    @property
    def instance(self) -> Instance:
        """Object instance of the surface."""


def size_m(surface: Surface) -> tuple[float, float]:
    """Return height and width of a surface [m]: the mean lengths of its columns and rows."""
    grid = surface.grid
    down, along = (np.linalg.norm(np.diff(grid, axis=axis), axis=2).sum(axis=axis).mean() for axis in (0, 1))
    return float(down), float(along)


@dataclass(frozen=True, eq=False)
class Sheet:
    """A painted curved surface, such as the wall of a tank, a hill or the sky."""

    grid: Array
    """(R + 1, C + 1, 3) Points of the surface [m]: the first row is the top and the first column the left, as seen. The
    texture is spread evenly over the cells between them."""
    paint: Paint
    """Paint of the surface."""
    glow: float = 0.0
    """Emission relative to a well-lit surface."""
    pixels_per_m: float = PIXELS_PER_M
    """Resolution of the texture [px/m]."""
    instance: Instance = UNNAMED
    """Object instance of the surface."""


@dataclass(frozen=True, eq=False)
class Face:
    """A painted rectangle in space."""

    corner: Array
    """(3,) Top left corner as seen from the visible side [m]."""
    right: Array
    """(3,) Edge from the left to the right [m]."""
    down: Array
    """(3,) Edge from the top to the bottom [m]."""
    paint: Paint
    """Paint of the face."""
    glow: float = 0.0
    """Emission relative to a well-lit surface."""
    pixels_per_m: float = PIXELS_PER_M
    """Resolution of the texture [px/m]."""
    instance: Instance = UNNAMED
    """Object instance of the face."""

    @property
    def grid(self) -> Array:
        """(2, 2, 3) Corners of the face [m]: top left and right, bottom left and right."""
        top = np.stack([self.corner, self.corner + self.right])
        return np.stack([top, top + self.down])

    @property
    def normal(self) -> Array:
        """(3,) Unit normal of the visible side."""
        normal = np.cross(self.down, self.right)
        return np.asarray(normal / np.linalg.norm(normal))

    @property
    def size_m(self) -> tuple[float, float]:
        """Height and width [m]."""
        return float(np.linalg.norm(self.down)), float(np.linalg.norm(self.right))


@dataclass(frozen=True, eq=False)
class Box:
    """A painted box; its local y axis points to the front."""

    centre: Array
    """(3,) Centre of the box [m]."""
    half: Array
    """(3,) Half extents: width (x), depth (y) and height (z) [m]."""
    paint: Paint
    """Paint of all sides."""
    front: Paint | None = None
    """Paint of the front (+y) instead, if there is one."""
    R: Array = field(default_factory=lambda: np.eye(3))
    """(3, 3) Orientation of the box."""
    glow: float = 0.0
    """Emission relative to a well-lit surface."""
    pixels_per_m: float = PIXELS_PER_M
    """Resolution of the textures [px/m]."""
    instance: Instance = UNNAMED
    """Object instance of the box."""

    def moved(self, R: Array, position: Array) -> "Box":
        """Return the box rotated by R (3, 3) about the origin, then translated by ``position`` (3,)."""
        return replace(self, centre=R @ self.centre + position, R=R @ self.R)

    def faces(self) -> Iterable[Face]:
        """Yield the six faces."""
        for axis in range(3):
            for sign in (1.0, -1.0):
                normal = sign * self.R[:, axis]
                up_axis = 1 if axis == 2 else 2
                up = self.R[:, up_axis]
                right = np.cross(up, normal)
                right_axis = 3 - axis - up_axis
                half_up, half_right = up * self.half[up_axis], right * self.half[right_axis]
                middle = self.centre + normal * self.half[axis]
                front = axis == 1 and sign > 0.0 and self.front is not None
                paint = self.front if front and self.front is not None else self.paint
                corner = middle + half_up - half_right
                yield Face(corner, 2.0 * half_right, -2.0 * half_up, paint, self.glow, self.pixels_per_m, self.instance)


_Part = TypeVar("_Part", Box, Face, Sheet)


def parts_of(instance: Instance, parts: Iterable[_Part]) -> tuple[_Part, ...]:
    """Return parts that belong to one instance."""
    return tuple(replace(part, instance=instance) for part in parts)


def enclosure(faces: Iterable[Face]) -> tuple[Face, ...]:
    """Return the faces of a room as instances: floor, ceiling and walls, in this order."""
    kinds = itertools.chain(("floor", "ceiling"), itertools.repeat("wall"))
    return tuple(replace(face, instance=Instance(kind)) for face, kind in zip(faces, kinds, strict=False))


def visible_faces(boxes: Iterable[Box], room_min: Array, room_max: Array) -> list[Face]:
    """Return the faces of boxes except those against the floor, the ceiling or a wall.

    Args:
        boxes: The boxes.
        room_min: (3,) Lower corner of the room [m].
        room_max: (3,) Upper corner of the room [m].
    """
    kept = []
    for face in (face for box in boxes for face in box.faces()):
        middle, normal = face.corner + 0.5 * (face.right + face.down), face.normal
        to_shell = np.where(normal > 0.0, room_max - middle, middle - room_min)
        if not np.any((np.abs(normal) > 0.99) & (to_shell < _HIDDEN_BELOW_M)):
            kept.append(face)
    return kept
