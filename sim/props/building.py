"""Building elements: walls and the furniture along them, floors, ceilings, lamps, landing mats."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from dronevio.models.arrays import Array, Image
from dronevio.models.rotation import rotation_z
from dronevio.sim.appearance import pictures, textures_building
from dronevio.sim.appearance.instances import Instance, single_instance
from dronevio.sim.appearance.lightmap import AreaLight
from dronevio.sim.appearance.solids import Box, Face, Paint, enclosure
from dronevio.sim.appearance.textures import plain
from dronevio.sim.props.furniture import METAL, Piece, hung_picture

Random = np.random.Generator

_DOWN = np.array([0.0, 0.0, -1.0])
_SHADY_M = 0.04  # half thickness of the thinnest box that casts a shadow
_MAT_M = 0.006  # thick enough to avoid z-fighting with the floor, thin enough to be ignored by the physics


@dataclass(frozen=True, eq=False)
class Wall:
    """A section of a wall; in its frame x runs along it, y into the room, z up, from the centre of its foot."""

    middle: Array
    """(3,) Centre of the foot of the wall [m]."""
    turn_rad: float
    """Heading of the wall's x axis in the world [rad]."""
    length_m: float
    """Length of the wall [m]."""

    def at(self, x: float, y: float, z: float) -> Array:
        """Return the position (3,) in the world of a point in the frame of the wall [m]."""
        return np.asarray(rotation_z(self.turn_rad) @ np.array([x, y, z]) + self.middle)

    def put(self, piece: Piece, x: float, y: float = 0.0) -> Piece:
        """Return a piece of furniture with its back at distance ``y`` from the wall and its centre at ``x`` [m]."""
        return piece.moved(rotation_z(self.turn_rad), self.at(x, y, 0.0))

    def hull(self, piece: Piece, x: float, y: float = 0.0) -> Box:
        """Return the bounding box of a piece at that position."""
        return piece.hull().moved(rotation_z(self.turn_rad), self.at(x, y, 0.0))

    def face(self, left: Sequence[float], right: Sequence[float], top: float, paint: Paint, px_per_m: float) -> Face:
        """Return an upright face from the floor to ``top`` with the ends (x, y), left and right as seen [m]."""
        a, b = self.at(left[0], left[1], top), self.at(right[0], right[1], top)
        return Face(a, b - a, top * _DOWN, paint, pixels_per_m=px_per_m)


def level_face(low: Array, high: Array, z: float, up: bool, paint: Paint, px_per_m: float) -> Face:
    """Return a floor, or a ceiling that faces down, between two corners (x, y) [m]."""
    (x0, y0), (x1, y1) = low, high
    right, toward_y = np.array([x1 - x0, 0.0, 0.0]), np.array([0.0, y1 - y0, 0.0])
    if up:
        return Face(np.array([x0, y1, z]), right, -toward_y, paint, pixels_per_m=px_per_m)
    return Face(np.array([x0, y0, z]), right, toward_y, paint, pixels_per_m=px_per_m)


def room_walls(low: Array, high: Array) -> tuple[Wall, Wall, Wall, Wall]:
    """Return the south, east, north and west walls of a hall between two corners (3,) [m]."""
    (x, y), (w, d) = 0.5 * (low + high)[:2], (high - low)[:2]
    return (
        Wall(np.array([x, low[1], low[2]]), 0.0, float(w)),
        Wall(np.array([high[0], y, low[2]]), 0.5 * np.pi, float(d)),
        Wall(np.array([x, high[1], low[2]]), np.pi, float(w)),
        Wall(np.array([low[0], y, low[2]]), -0.5 * np.pi, float(d)),
    )


def hall_faces(
    low: Array, high: Array, floor: Paint, ceiling: Paint, walls: Sequence[Paint], px_per_m: tuple[float, float, float]
) -> tuple[Face, ...]:
    """Return the inner faces of a hall between two corners (3,) [m].

    Args:
        low: Least corner.
        high: Greatest corner.
        floor: What covers the floor.
        ceiling: What covers the ceiling.
        walls: What covers the south, east, north and west wall.
        px_per_m: Resolution of the floor, the walls and the ceiling [px/m].
    """
    height = float(high[2] - low[2])
    sides = [
        wall.face((0.5 * wall.length_m, 0.0), (-0.5 * wall.length_m, 0.0), height, paint, px_per_m[1])
        for wall, paint in zip(room_walls(low, high), walls, strict=True)
    ]
    bottom = level_face(low[:2], high[:2], float(low[2]), True, floor, px_per_m[0])
    top = level_face(low[:2], high[:2], float(high[2]), False, ceiling, px_per_m[2])
    return enclosure((bottom, top, *sides))


def stand_along(
    rng: Random,
    wall: Wall,
    makers: Sequence[Callable[[Random], Piece]],
    blocked: Sequence[tuple[float, float]] = (),
    margin_m: float = 0.25,
    gaps_m: tuple[float, float] = (0.15, 0.6),
) -> tuple[list[Piece], list[Box]]:
    """Place furniture along a wall until it is full, with pictures above where there is space.

    Args:
        rng: Draws the things and the gaps.
        wall: The wall.
        makers: What to put there, in turn and over again.
        blocked: Where nothing can stand, along the wall, and how far around [m].
        margin_m: What stays free at both ends [m].
        gaps_m: Least and greatest distance between things [m].

    Returns:
        The things, and the boxes around those that a drone could hit.
    """
    pieces, hulls = [], []
    x, end = -0.5 * wall.length_m + margin_m, 0.5 * wall.length_m - margin_m
    for count in itertools.count():
        piece = makers[count % len(makers)](rng)
        middle = x + 0.5 * piece.width_m
        for place, reach in sorted(blocked):
            if abs(middle - place) < reach + 0.5 * piece.width_m:
                middle = place + reach + 0.5 * piece.width_m
        x = middle + 0.5 * piece.width_m
        if x > end:
            break
        pieces.append(wall.put(piece, middle))
        if piece.height_m > 0.0:
            hulls.append(wall.hull(piece, middle))
        if piece.picture_above:
            pieces.append(wall.put(hung_picture(rng, max(piece.height_m + 0.55, 1.6)), middle))
        x += rng.uniform(*gaps_m)
    return pieces, hulls


def landing_mat(middle: Array, side_m: float = 0.8) -> Box:
    """Return a thin landing mat with its centre on the floor at (3,) [m]."""

    def paint(rng: Random, height: int, width: int) -> Image:
        return pictures.landing_pad(max(height, width))[:height, :width]

    half = 0.5 * np.array([side_m, side_m, _MAT_M])
    return Box(middle + [0.0, 0.0, half[2]], half, paint, instance=Instance("landing_mat"))


@single_instance
def ceiling_lamp(middle: Array, size_m: tuple[float, float], power: float, drop_m: float = 0.0) -> Piece:
    """Return a flat lamp under a ceiling.

    Args:
        middle: (3,) Where it hangs, on the ceiling [m].
        size_m: Its extent along x and y [m].
        power: Of its light.
        drop_m: How far below the ceiling it hangs on two rods [m].
    """
    half = 0.5 * np.array([*size_m, 0.06])
    glass = middle - [0.0, 0.0, drop_m + half[2]]
    shown = partial(textures_building.lamp_panel, colour=(250, 246, 232))
    boxes = [Box(glass, half, shown, glow=1.0)]
    along = 0 if size_m[0] > size_m[1] else 1
    for sign in (-1.0, 1.0) if drop_m > 0.0 else ():
        place = middle - [0.0, 0.0, 0.5 * drop_m]
        place[along] += sign * 0.6 * half[along]
        boxes.append(Box(place, np.array([0.012, 0.012, 0.5 * drop_m]), partial(plain, colour=METAL)))
    spread = np.zeros((1 if max(size_m) < 1.5 else 2, 3))
    spread[:, along] = np.linspace(-0.25, 0.25, len(spread)) * max(size_m) if len(spread) > 1 else 0.0
    light = AreaLight(glass - [0.0, 0.0, 0.05] + spread, power, _DOWN)
    return Piece(tuple(boxes), size_m[0], size_m[1], 0.0, lights=(light,))


def coarse(boxes: Sequence[Box], px_per_m: float) -> tuple[Box, ...]:
    """Return boxes with textures of another resolution [px/m]."""
    return tuple(replace(box, pixels_per_m=px_per_m) for box in boxes)


def shading(boxes: Sequence[Box]) -> tuple[Box, ...]:
    """Return the boxes that cast shadows.

    What is thin hangs on a wall: its shadow would be a smudge around it, light being painted coarsely.
    """
    return tuple(box for box in boxes if box.glow == 0.0 and box.half.min() > _SHADY_M)
