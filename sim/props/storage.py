"""Equipment of a warehouse: pallets with loads, racks, a forklift, packing tables."""

from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np

from dronevio.models.arrays import Array, Image
from dronevio.sim.appearance import textures, textures_storage
from dronevio.sim.appearance.instances import Instance, single_instance
from dronevio.sim.appearance.solids import Box, Face, Paint, parts_of
from dronevio.sim.appearance.textures import Colour, to_image
from dronevio.sim.props.furniture import METAL, Piece, block

Random = np.random.Generator

PALLET_M = np.array([1.05, 1.0, 0.14])
"""(3,) Width, depth and height of a pallet [m]."""
_LOAD_PX_PER_M, _SIDE_PX_PER_M, _STEEL_PX_PER_M = 132.0, 64.0, 96.0
_VARIANTS = 21
_BLUE: Colour = (46, 78, 128)
_ORANGE: Colour = (216, 110, 36)


@dataclass(frozen=True, eq=False)
class Stock:
    """Textures of the sides of loads, painted once and shared by all pallets."""

    images: tuple[Image, ...]
    """Textures of the kinds of goods, each (H, W, 3)."""

    @classmethod
    def painted(cls, rng: Random) -> "Stock":
        """Paint the textures."""
        size = round(_LOAD_PX_PER_M * PALLET_M[0])
        paints = textures_storage.LOADS
        return cls(tuple(paints[k % len(paints)](rng, size, size) for k in range(_VARIANTS)))

    def side(self, number: int) -> Paint:
        """Return the paint of a side of a load of one kind of goods, with a random brightness."""
        return partial(_restocked, image=self.images[number])


def _restocked(rng: Random, height: int, width: int, image: Image) -> Image:
    """Return an image in another size and shade."""
    fitted = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    return to_image(fitted * np.float32(rng.uniform(0.88, 1.08)))


def loaded_pallet(
    rng: Random, stock: Stock, R: Array, position: Array, most_m: float
) -> tuple[list[Face], tuple[Box, ...], float]:
    """Return the visible faces of a pallet with its load, the boxes of both, and its height [m].

    Args:
        rng: Draws what lies on it.
        stock: The goods.
        R: (3, 3) Its orientation; y points to the front.
        position: (3,) Middle of its foot [m].
        most_m: Height of the space for it [m].
    """
    foot = Box(np.array([0.0, 0.0, 0.5 * PALLET_M[2]]), 0.5 * PALLET_M, textures_storage.pallet)
    foot = foot.moved(R, position)
    faces = [replace(face, pixels_per_m=_SIDE_PX_PER_M) for face in foot.faces()]
    number, tall = int(rng.integers(len(stock.images))), float(rng.uniform(0.55, 0.95)) * (most_m - PALLET_M[2])
    half = 0.5 * np.array([PALLET_M[0] - rng.uniform(0.02, 0.14), PALLET_M[1] - rng.uniform(0.02, 0.14), tall])
    load = Box(np.array([rng.uniform(-0.02, 0.02), 0.0, PALLET_M[2] + half[2]]), half, stock.side(number))
    load = load.moved(R, position)
    densities = (_SIDE_PX_PER_M, _SIDE_PX_PER_M, _LOAD_PX_PER_M, _SIDE_PX_PER_M, _SIDE_PX_PER_M)  # none below
    faces += [replace(face, pixels_per_m=density) for face, density in zip(load.faces(), densities, strict=False)]
    pallet = Instance("pallet")
    return list(parts_of(pallet, faces)), parts_of(pallet, (foot, load)), float(PALLET_M[2] + tall)


@single_instance
def rack(bays: int, bay_m: float, depth_m: float, levels_m: tuple[float, ...], height_m: float) -> Piece:
    """Return the steel of a rack, its back at y = 0: uprights, beams, posts that guard its ends."""
    blue = partial(textures_storage.upright, colour=_BLUE, px_per_m=_STEEL_PX_PER_M)
    orange = partial(textures_storage.beam, colour=_ORANGE)
    length = bays * bay_m
    boxes = []
    for x in np.linspace(-0.5 * length, 0.5 * length, bays + 1):
        boxes += [block(float(x), y, 0.0, 0.1, 0.08, height_m, blue) for y in (0.04, depth_m - 0.04)]
    for x in (-0.5 * length, 0.5 * length):
        boxes += [block(x, 0.5 * depth_m, z, 0.05, depth_m - 0.16, 0.06, blue) for z in np.arange(0.5, height_m, 0.9)]
        boxes.append(block(x, depth_m + 0.02, 0.0, 0.16, 0.12, 0.8, textures_storage.hazard))
    for level in levels_m[1:]:
        for x in (np.arange(bays) + 0.5) * bay_m - 0.5 * length:
            boxes.append(block(float(x), depth_m - 0.03, level - 0.13, bay_m - 0.1, 0.06, 0.12, orange))
    return Piece(tuple(boxes), length, depth_m, height_m)


@single_instance
def forklift(rng: Random) -> Piece:
    """Return a forklift, its forks to the front."""
    yellow = partial(textures.plain, colour=textures.vary(rng, (222, 164, 30), 0.06))
    dark = partial(textures.plain, colour=(44, 44, 48))
    steel = partial(textures.plain, colour=METAL)
    boxes = [
        block(0.0, 0.75, 0.22, 1.05, 1.5, 0.5, yellow),
        block(0.0, 0.3, 0.72, 1.05, 0.6, 0.42, yellow, textures_storage.hazard),
        block(0.0, 0.85, 0.72, 0.5, 0.5, 0.16, dark),
        block(0.0, 0.62, 0.88, 0.5, 0.1, 0.55, dark),
        block(0.0, 1.25, 0.72, 0.6, 0.12, 0.5, dark, partial(textures.screen, colour=(50, 60, 70))),
        block(0.0, 0.75, 2.02, 1.0, 1.3, 0.06, partial(textures.radiator, colour=(70, 70, 74))),
    ]
    boxes += [block(sx * 0.46, y, 1.1, 0.06, 0.06, 0.94, dark) for sx in (-1, 1) for y in (0.15, 1.35)]
    boxes += [block(sx * 0.47, y, 0.0, 0.18, 0.5, 0.46, dark) for sx in (-1, 1) for y in (0.34, 1.25)]
    boxes += [block(s * 0.28, 1.62, 0.05, 0.1, 0.12, 2.5, steel) for s in (-1, 1)]
    boxes += [block(0.0, 1.62, z, 0.5, 0.08, 0.1, steel) for z in (0.3, 1.3, 2.4)]
    boxes += [block(s * 0.25, 2.2, 0.06, 0.12, 1.05, 0.05, steel) for s in (-1, 1)]
    return Piece(tuple(boxes), 1.15, 2.75, 2.55)


@single_instance
def packing_table(rng: Random) -> Piece:
    """Return a table with cartons, tape and a screen."""
    wood, steel = partial(textures.wood, colour=(168, 134, 92)), partial(textures.plain, colour=METAL)
    boxes = [block(0.0, 0.45, 0.82, 1.9, 0.8, 0.05, wood), block(0.0, 0.45, 0.3, 1.8, 0.7, 0.04, wood)]
    boxes += [block(sx * 0.9, 0.45 + sy * 0.35, 0.0, 0.06, 0.06, 0.82, steel) for sx in (-1, 1) for sy in (-1, 1)]
    boxes += [block(sx * 0.9, 0.1, 0.87, 0.05, 0.05, 1.0, steel) for sx in (-1, 1)]
    boxes.append(block(0.0, 0.12, 1.7, 1.85, 0.26, 0.04, wood))
    boxes.append(block(0.55, 0.2, 0.87, 0.5, 0.05, 0.36, steel, partial(textures.screen, colour=(60, 84, 110))))
    for x, z in ((-0.7, 0.34), (-0.2, 0.34), (0.45, 0.34), (-0.6, 0.87), (-0.15, 0.87), (-0.6, 1.74), (0.2, 1.74)):
        w, h = rng.uniform(0.3, 0.42), rng.uniform(0.16, 0.32)
        boxes.append(block(x, 0.42 if z < 1.0 else 0.14, z, w, 0.3, h, textures_storage.one_carton))
    return Piece(tuple(boxes), 2.0, 0.9, 2.1)


@single_instance
def truss(span_m: float, height_m: float) -> Piece:
    """Return a girder of steel along x, its lower edge at z = 0: two chords and diagonals."""
    steel = partial(textures.plain, colour=(120, 126, 132))
    boxes = [block(0.0, 0.0, z, span_m, 0.12, 0.1, steel) for z in (0.0, height_m - 0.1)]
    count = round(span_m / (1.6 * height_m))
    step, bar = span_m / count, float(np.hypot(0.5 * span_m / count, height_m - 0.1))
    angle = float(np.arctan2(height_m - 0.1, 0.5 * step))
    for k in range(2 * count):
        c, s = np.cos(angle), np.sin(angle) * (1.0 if k % 2 == 0 else -1.0)
        R = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
        middle = np.array([-0.5 * span_m + (k + 0.5) * 0.5 * step, 0.0, 0.5 * height_m])
        boxes.append(Box(np.zeros(3), 0.5 * np.array([bar, 0.06, 0.06]), steel).moved(R, middle))
    return Piece(tuple(boxes), span_m, 0.12, height_m)
