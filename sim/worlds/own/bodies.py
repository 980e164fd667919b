"""Bodies: the objects of a world of one's own, with what is seen of them and what is solid.

Round bodies are prisms and polyhedra, so that what collides is what is seen.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from dronevio.models.arrays import Array
from dronevio.sim.appearance.cutouts import Cutouts, Print
from dronevio.sim.appearance.instances import Instance
from dronevio.sim.appearance.prisms import UNPAINTED, lateral_surface, prism_boxes
from dronevio.sim.appearance.scenery import quads_of
from dronevio.sim.appearance.solids import Box, Sheet, Surface, parts_of
from dronevio.sim.props.vegetation import PLATE_M, plates
from dronevio.sim.worlds.own.looks import LARGEST_SIDE_PX, Look

DEVIATION_M = 0.005
"""Largest distance of the surface of a prism from the cylinder that it stands for, if that has a radius of at most
2 m [m]."""
_SIDES = (8, 32)  # smallest and largest number of sides of a cylinder
_SIDES_OF_BALL = (8, 16)
_INSCRIBED = np.array(  # half extents of boxes in the unit ball
    [[0.57, 0.57, 0.57]] + [np.roll(half, k) for half in ([0.9, 0.3, 0.3], [0.68, 0.68, 0.25]) for k in range(3)]
)
_SHADOW = 0.95  # of the size of a box in a round body that casts its shadow


@dataclass(frozen=True, eq=False)
class Body:
    """An object at its place."""

    boxes: tuple[Box, ...] = ()
    """Boxes that are seen and solid."""
    sheets: tuple[Surface, ...] = ()
    """Other surfaces that are seen."""
    filling: tuple[Box, ...] = ()
    """Boxes that are solid, not seen."""
    prints: tuple[Print, ...] = ()
    """Surfaces with a texture that includes its light."""
    pasted: tuple[tuple[Look, Cutouts], ...] = ()
    """Surfaces that show an image at given positions, in its own light."""
    core: tuple[Box, ...] = ()
    """Few boxes within the solids, for shadows and drawings."""

    @property
    def solids(self) -> tuple[Box, ...]:
        """All that is solid."""
        return (*self.boxes, *self.filling)


@dataclass(frozen=True, eq=False)
class Place:
    """Where a body is, and how it is seen."""

    position: Array
    """(3,) Its centre [m]."""
    R: Array
    """(3, 3) Its orientation."""
    look: Look
    """Its look."""
    ppm: float
    """Largest resolution of its textures [px/m]."""
    instance: Instance
    """The object."""

    def resolution(self, longest_m: float) -> float:
        """Return the resolution of a surface with a longest side [px/m]."""
        return min(self.ppm, LARGEST_SIDE_PX / max(longest_m, 1e-6))

    def sheet(self, grid: Array) -> Sheet:
        """Return a painted surface, given by its grid (R + 1, C + 1, 3) in the frame of the body [m]."""
        lengths = (np.linalg.norm(np.diff(grid, axis=axis), axis=2).sum(axis=axis).max() for axis in (0, 1))
        ppm = self.resolution(float(max(lengths)))
        return Sheet(grid @ self.R.T + self.position, self.look.paint(ppm), pixels_per_m=ppm, instance=self.instance)

    def placed(self, boxes: Iterable[Box]) -> tuple[Box, ...]:
        """Return unpainted boxes from the frame of the body."""
        return parts_of(self.instance, (box.moved(self.R, self.position) for box in boxes))


def box_body(half: Array, place: Place) -> Body:
    """Return a box with half extents (3,) [m]."""
    ppm = place.resolution(2.0 * float(half.max()))
    box = Box(place.position, half, place.look.paint(ppm), R=place.R, pixels_per_m=ppm, instance=place.instance)
    return Body(boxes=(box,), core=(box,))


def cylinder_body(radius_m: float, height_m: float, place: Place) -> Body:
    """Return a cylinder around the z axis of its frame: a prism whose surface is on both sides of the cylinder's."""
    sides = _even_sides(radius_m, _SIDES)
    corner_m, half_m = _corner_radius(radius_m, sides), 0.5 * height_m
    surfaces = (
        lateral_surface(np.array([half_m, -half_m]), np.full(2, corner_m), sides),
        lateral_surface(np.full(2, half_m), np.array([0.0, corner_m]), sides),
        lateral_surface(np.full(2, -half_m), np.array([corner_m, 0.0]), sides),
    )
    inside = _SHADOW * radius_m * 0.5**0.5
    return Body(
        sheets=tuple(place.sheet(grid) for grid in surfaces),
        filling=place.placed(prism_boxes(corner_m, -half_m, half_m, sides)),
        core=place.placed([Box(np.zeros(3), np.array([inside, inside, _SHADOW * half_m]), UNPAINTED)]),
    )


def ellipsoid_body(half: Array, place: Place) -> Body:
    """Return an ellipsoid with half axes (3,) [m], whose surface consists of plane quadrangles."""
    sides = _even_sides(float(half.max()), _SIDES_OF_BALL)
    angle = np.linspace(0.5 * np.pi, -0.5 * np.pi, sides // 2 + 1)
    return round_body(
        lateral_surface(np.sin(angle), np.cos(angle), sides) * half, _INSCRIBED * half, np.zeros(1), place
    )


def capsule_body(radius_m: float, half_m: float, place: Place) -> Body:
    """Return a cylinder of a radius and a half length with half balls at its ends."""
    sides = _even_sides(radius_m, _SIDES_OF_BALL)
    angle = np.linspace(0.5 * np.pi, 0.0, sides // 4 + 1)
    heights, radii = radius_m * np.sin(angle) + half_m, radius_m * np.cos(angle)
    grid = lateral_surface(np.concatenate([heights, -heights[::-1]]), np.concatenate([radii, radii[::-1]]), sides)
    ends = np.array([-half_m, half_m])
    body = round_body(grid, _INSCRIBED * radius_m, ends, place)
    inside = np.array([*_INSCRIBED[0, :2] * radius_m, half_m])
    return Body(
        sheets=body.sheets,
        filling=(*body.filling, *place.placed([Box(np.zeros(3), inside, UNPAINTED)])),
        core=body.core,
    )


def round_body(grid: Array, inside: Array, heights: Array, place: Place) -> Body:
    """Return a body given by the grid (R + 1, C + 1, 3) of its surface in its frame [m].

    A plate behind each quadrangle, and boxes inside, are solid.

    Args:
        grid: The surface.
        inside: (B, 3) Half extents of boxes that fit inside [m].
        heights: (H,) Heights of the centres of these boxes [m].
        place: Place and look.
    """
    cells = quads_of(grid)
    cells = cells[np.linalg.norm(cells[:, 2] - cells[:, 0], axis=1) > 1e-9]
    along = cells[:, 1] + cells[:, 2] - cells[:, 0] - cells[:, 3]
    centres = [np.array([0.0, 0.0, height]) for height in heights]
    boxes = [Box(centre, half, UNPAINTED) for centre in centres for half in inside]
    return Body(
        sheets=(place.sheet(grid),),
        filling=place.placed([*plates(cells, along, depth_m=0.5 * PLATE_M), *boxes]),
        core=place.placed(boxes[:1]),
    )


def _even_sides(radius_m: float, limits: tuple[int, int]) -> int:
    """Return the number of sides, a multiple of four, with which a prism deviates by at most `DEVIATION_M`."""
    sides = np.pi / np.arccos(np.clip(1.0 - 2.0 * DEVIATION_M / max(radius_m, 1e-6), -1.0, 1.0))
    return int(np.clip(4 * np.ceil(0.25 * sides), *limits))


def _corner_radius(radius_m: float, sides: int) -> float:
    """Return the radius of the corners of a prism whose sides are as far inside a cylinder as its corners outside."""
    return float(2.0 * radius_m / (1.0 + np.cos(np.pi / sides)))
