"""Boxes and the faces they show: the geometry that a room and its furniture are built from."""

import itertools
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from dronevio.sim.appearance.instances import UNNAMED, Instance
from dronevio.sim.appearance.textures import PIXELS_PER_M, Image

Array = npt.NDArray[np.float64]
Paint = Callable[[np.random.Generator, int, int], Image]
"""Draws an image of the given height and width [px]."""

_HIDDEN_BELOW_M = 0.03  # a face this close to what it faces is never seen


class Surface(Protocol):
    """Something flat or curved that is painted, lit and drawn: a grid of points under an image."""

    @property
    def grid(self) -> Array:
        """(R + 1, C + 1, 3) Points on it [m]: the first row is its top, the first column its left, as one sees it."""

    @property
    def paint(self) -> Paint:
        """What it shows."""

    @property
    def glow(self) -> float:
        """Light of its own, relative to a well lit surface."""

    @property
    def pixels_per_m(self) -> float:
        """Resolution of its image [px/m]."""

    @property
    def instance(self) -> Instance:
        """What it belongs to."""


def size_m(surface: Surface) -> tuple[float, float]:
    """Return the height and the width of a surface [m]: the mean lengths of its columns and rows, rolled out flat."""
    grid = surface.grid
    down, along = (np.linalg.norm(np.diff(grid, axis=axis), axis=2).sum(axis=axis).mean() for axis in (0, 1))
    return float(down), float(along)


@dataclass(frozen=True, eq=False)
class Sheet:
    """A painted curved surface: the mantle of a tank, a hill, the sky."""

    grid: Array
    """(R + 1, C + 1, 3) Points on it [m]: the first row is its top and the first column its left, as one looks at it.
    The image is spread evenly over the cells between them."""
    paint: Paint
    """What it shows."""
    glow: float = 0.0
    """Light of its own, relative to a well lit surface."""
    pixels_per_m: float = PIXELS_PER_M
    """Resolution of its image [px/m]."""
    instance: Instance = UNNAMED
    """What it belongs to."""


@dataclass(frozen=True, eq=False)
class Face:
    """A painted rectangle in space."""

    corner: Array
    """(3,) Top left corner as one looks at it [m]."""
    right: Array
    """(3,) Edge from the left to the right [m]."""
    down: Array
    """(3,) Edge from the top to the bottom [m]."""
    paint: Paint
    """What it shows."""
    glow: float = 0.0
    """Light of its own, relative to a well lit surface."""
    pixels_per_m: float = PIXELS_PER_M
    """Resolution of its image [px/m]."""
    instance: Instance = UNNAMED
    """What it belongs to."""

    @property
    def grid(self) -> Array:
        """(2, 2, 3) Its corners [m]: top left and right, bottom left and right."""
        top = np.stack([self.corner, self.corner + self.right])
        return np.stack([top, top + self.down])

    @property
    def normal(self) -> Array:
        """(3,) Unit vector toward the one who looks at it."""
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
    """(3,) Centre [m]."""
    half: Array
    """(3,) Half of its width (x), depth (y) and height (z) [m]."""
    paint: Paint
    """What covers it."""
    front: Paint | None = None
    """What covers its front (+y) instead."""
    R: Array = field(default_factory=lambda: np.eye(3))
    """(3, 3) Orientation."""
    glow: float = 0.0
    """Light of its own, relative to a well lit surface."""
    pixels_per_m: float = PIXELS_PER_M
    """Resolution of its images [px/m]."""
    instance: Instance = UNNAMED
    """What it belongs to."""

    def moved(self, R: Array, position: Array) -> "Box":
        """Return the box turned by R (3, 3) about the origin, then shifted by ``position`` (3,)."""
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
    """Return parts as those of a thing."""
    return tuple(replace(part, instance=instance) for part in parts)


def enclosure(faces: Iterable[Face]) -> tuple[Face, ...]:
    """Return the inside of a room as the things that it is: floor, ceiling and walls, in this order."""
    kinds = itertools.chain(("floor", "ceiling"), itertools.repeat("wall"))
    return tuple(replace(face, instance=Instance(kind)) for face, kind in zip(faces, kinds, strict=False))


def visible_faces(boxes: Iterable[Box], room_min: Array, room_max: Array) -> list[Face]:
    """Return the boxes' faces without those that lie against the floor, the ceiling or a wall.

    Args:
        boxes: The boxes.
        room_min: (3,) Corner of the room [m].
        room_max: (3,) Opposite corner [m].
    """
    kept = []
    for face in (face for box in boxes for face in box.faces()):
        middle, normal = face.corner + 0.5 * (face.right + face.down), face.normal
        to_shell = np.where(normal > 0.0, room_max - middle, middle - room_min)
        if not np.any((np.abs(normal) > 0.99) & (to_shell < _HIDDEN_BELOW_M)):
            kept.append(face)
    return kept
