"""Objects around a race course: banners, flags, straw bales, a grandstand, tents, containers."""

from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.rotation import rotation_z
from dronevio.sim.appearance import textures
from dronevio.sim.appearance import textures_race as race
from dronevio.sim.appearance.instances import Instance
from dronevio.sim.appearance.solids import Box, Face, parts_of
from dronevio.sim.appearance.textures import Colour

Random = np.random.Generator

STEEL: Colour = (150, 152, 156)
_STRAW: Colour = (204, 172, 98)
_BLACK = partial(textures.plain, colour=race.BLACK)


def flag(rng: Random) -> tuple[Box, ...]:
    """Return a tall flag on a pole."""
    high = rng.uniform(2.4, 3.4)
    cloth = partial(race.lettered, colour=race.PAINTS[int(rng.integers(len(race.PAINTS)))])
    boxes = [
        Box(np.array([0.0, 0.0, 0.5 * high]), np.array([0.02, 0.02, 0.5 * high]), _BLACK, pixels_per_m=100.0),
        Box(np.array([0.32, 0.0, 0.56 * high]), np.array([0.3, 0.008, 0.42 * high]), cloth, cloth, pixels_per_m=150.0),
        Box(np.array([0.0, 0.0, 0.03]), np.array([0.22, 0.22, 0.03]), _BLACK, pixels_per_m=100.0),
    ]
    return parts_of(Instance("flag"), boxes)


def bales(rng: Random) -> tuple[Box, ...]:
    """Return a few stacked straw bales."""
    straw = partial(race.bale, colour=textures.vary(rng, _STRAW, 0.08))
    half = np.array([0.45, 0.24, 0.2])
    boxes = [Box(np.array([x, 0.0, half[2]]), half, straw, pixels_per_m=110.0) for x in (-0.47, 0.47)]
    if rng.random() < 0.6:
        boxes.append(Box(np.array([rng.uniform(-0.2, 0.2), 0.0, 3.0 * half[2]]), half, straw, pixels_per_m=110.0))
    return parts_of(Instance("bales"), boxes)


def fence(half_m: Array) -> tuple[Face, ...]:
    """Return the banners around a field of half the given size (2,) [m], seen from inside."""
    x, y = half_m
    high = 1.05
    corners = np.array([[-x, y], [x, y], [x, -y], [-x, -y], [-x, y]])
    boards = []
    for a, b in pairwise(corners):
        count = round(float(np.linalg.norm(b - a)) / 4.0)
        posts = np.linspace(a, b, count + 1)
        for p, q in pairwise(posts):
            right = np.array([*(q - p), 0.0])
            boards.append(
                Face(np.array([*p, high]), right, np.array([0.0, 0.0, -high]), race.banner, pixels_per_m=96.0)
            )
    return parts_of(Instance("fence"), boards)


def stand(rng: Random, half_m: Array) -> tuple[Box, ...]:
    """Return a grandstand with spectators on the north or south side of a field of half size (2,) [m]."""
    seats = partial(race.crowd, colour=race.PAINTS[int(rng.integers(len(race.PAINTS)))])
    plain, cloth = partial(textures.plain, colour=(172, 170, 164)), partial(race.tarpaulin, colour=(232, 230, 224))
    wide, at, north = 12.0, half_m[1] + 2.0, rng.random() < 0.5
    boxes = []
    for row in range(6):
        centre = np.array([0.0, at + 0.9 * row, 0.45 + 0.225 * row])
        half = np.array([wide, 0.45, 0.45 + 0.225 * row])
        boxes.append(Box(centre, half, plain, pixels_per_m=24.0))
        people = np.array([0.0, at + 0.9 * row, 2.0 * half[2] + 0.42])
        boxes.append(Box(people, np.array([wide - 0.3, 0.02, 0.42]), plain, seats, pixels_per_m=44.0))
    back = at + 5.2
    boxes += [
        Box(np.array([x, back, 2.8]), np.array([0.08, 0.08, 2.8]), plain, pixels_per_m=32.0)
        for x in np.linspace(-wide, wide, 6)
    ]
    boxes.append(Box(np.array([0.0, back + 0.15, 3.4]), np.array([wide, 0.04, 1.2]), cloth, cloth, pixels_per_m=40.0))
    boxes.append(Box(np.array([0.0, at + 2.4, 5.7]), np.array([wide + 0.6, 3.4, 0.07]), cloth, pixels_per_m=20.0))
    valance = np.array([wide + 0.6, 0.03, 0.3])
    boxes.append(Box(np.array([0.0, at - 1.02, 5.45]), valance, race.banner, race.banner, pixels_per_m=60.0))
    # so far it faces −y from the north; the front of a box is its +y side
    turned = [replace(box, centre=-box.centre * [1.0, 1.0, -1.0]) for box in boxes]
    placed = [box.moved(rotation_z(np.pi) if north else np.eye(3), np.zeros(3)) for box in turned]
    return parts_of(Instance("stand"), placed)


def paddock(rng: Random, half_m: Array) -> tuple[Box, ...]:
    """Return tents and containers east and west of a field of half the given size (2,) [m]."""
    boxes: list[Box] = []
    for x in (-1.0, 1.0):
        for y in rng.permutation(np.linspace(-12.0, 12.0, 5))[:4]:
            R, at = rotation_z(0.5 * np.pi * x), np.array([x * (half_m[0] + rng.uniform(3.5, 5.5)), y, 0.0])
            parts = _tent(rng) if rng.random() < 0.55 else _container(rng)
            boxes += [box.moved(rotation_z(rng.uniform(-0.15, 0.15)) @ R, at) for box in parts]
    return tuple(boxes)


def _tent(rng: Random) -> tuple[Box, ...]:
    """Return a tent with an open front."""
    colour = (*race.PAINTS, race.WHITE, race.WHITE)[int(rng.integers(len(race.PAINTS) + 2))]
    cloth, words = partial(race.tarpaulin, colour=colour), partial(race.lettered, colour=colour)
    pole = partial(textures.plain, colour=STEEL)
    boxes = [
        Box(np.array([x, y, 1.15]), np.array([0.03, 0.03, 1.15]), pole, pixels_per_m=60.0)
        for x in (-1.45, 1.45)
        for y in (-1.45, 1.45)
    ]
    c, s = np.cos(0.5), np.sin(0.5)
    for side in (-1.0, 1.0):
        tilt = np.array([[1.0, 0.0, 0.0], [0.0, c, side * s], [0.0, -side * s, c]])
        boxes.append(
            Box(np.array([0.0, 0.78 * side, 2.72]), np.array([1.6, 0.95, 0.02]), cloth, R=tilt, pixels_per_m=50.0)
        )
    boxes.append(Box(np.array([0.0, 1.6, 2.12]), np.array([1.6, 0.015, 0.18]), words, words, pixels_per_m=100.0))
    boxes.append(Box(np.array([0.0, -1.5, 1.1]), np.array([1.5, 0.015, 1.1]), cloth, cloth, pixels_per_m=50.0))
    boxes.append(Box(np.array([0.0, 0.9, 0.72]), np.array([1.2, 0.35, 0.03]), pole, pixels_per_m=80.0))
    boxes.append(Box(np.array([0.0, 1.25, 0.36]), np.array([1.2, 0.01, 0.36]), words, words, pixels_per_m=100.0))
    return parts_of(Instance("tent"), boxes)


def _container(rng: Random) -> tuple[Box, ...]:
    """Return a shipping container, along the field."""
    colour = textures.vary(
        rng, ((150, 66, 48), (46, 84, 120), (86, 110, 84), (168, 128, 60))[int(rng.integers(4))], 0.1
    )
    steel = partial(race.container, colour=colour)
    half = np.array([3.0, 1.22, 1.3])
    return (Box(np.array([0.0, 0.0, 1.3]), half, steel, steel, pixels_per_m=64.0, instance=Instance("container")),)
