"""Furniture: each piece is a few painted boxes, drawn from a seed.

A piece stands at the origin of its own frame with its back against the wall y = 0, x along the wall, z up.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.rotation import rotation_z
from dronevio.sim.appearance import pictures, textures
from dronevio.sim.appearance.instances import Instance, single_instance
from dronevio.sim.appearance.lightmap import AreaLight
from dronevio.sim.appearance.solids import Box, Paint, parts_of
from dronevio.sim.appearance.textures import Colour

Random = np.random.Generator

WOODS: tuple[Colour, ...] = ((150, 104, 66), (112, 74, 46), (186, 146, 100), (92, 66, 52), (168, 120, 72))
CLOTHS: tuple[Colour, ...] = ((96, 116, 140), (150, 84, 66), (104, 124, 92), (170, 140, 92), (120, 96, 120))
LEAF: Colour = (62, 110, 52)
WHITE: Colour = (222, 218, 208)
METAL: Colour = (76, 78, 84)


@dataclass(frozen=True, eq=False)
class Piece:
    """A piece of furniture."""

    boxes: tuple[Box, ...]
    """Boxes of the piece."""
    width_m: float
    """Extent along the wall, centred [m]."""
    depth_m: float
    """Extent from the wall into the room [m]."""
    height_m: float
    """Extent above the floor [m]; 0 for what only hangs on the wall."""
    picture_above: bool = False
    """Whether the wall above it is free for a picture."""
    lights: tuple[AreaLight, ...] = ()
    """Area lights of the piece."""

    def moved(self, R: Array, position: Array) -> "Piece":
        """Return the piece rotated by R (3, 3) about the origin, then translated by ``position`` (3,)."""
        boxes = tuple(box.moved(R, position) for box in self.boxes)
        return replace(self, boxes=boxes, lights=tuple(light.moved(R, position) for light in self.lights))

    def as_instance(self, kind: str) -> "Piece":
        """Return the piece as one instance of a kind."""
        return replace(self, boxes=parts_of(Instance(kind), self.boxes))

    def hull(self) -> Box:
        """Return the bounding box of the piece in its own frame."""
        half = 0.5 * np.array([self.width_m, self.depth_m, self.height_m])
        return replace(self.boxes[0], centre=np.array([0.0, half[1], half[2]]), half=half, R=np.eye(3))


def block(x: float, y: float, z: float, w: float, d: float, h: float, paint: Paint, front: Paint | None = None) -> Box:
    """Return a box from the centre of its base and its full size [m]."""
    return Box(np.array([x, y, z + 0.5 * h]), 0.5 * np.array([w, d, h]), paint, front)


def pick(rng: Random, colours: tuple[Colour, ...]) -> Colour:
    """Return one of the colours, varied a little."""
    return textures.vary(rng, colours[int(rng.integers(len(colours)))], 0.06)


def _legs(w: float, d: float, h: float, y: float, paint: Paint, thick: float = 0.05) -> list[Box]:
    """Return four legs under a top of width w and depth d whose middle is at depth y."""
    x, dy = 0.5 * (w - thick), 0.5 * (d - thick)
    return [block(sx * x, y + sy * dy, 0.0, thick, thick, h, paint) for sx in (-1, 1) for sy in (-1, 1)]


@single_instance
def bookcase(rng: Random) -> Piece:
    """Return a tall case of five shelves full of books."""
    w, d, h = rng.uniform(1.1, 1.4), 0.34, rng.uniform(1.95, 2.25)
    paint = partial(textures.wood, colour=pick(rng, WOODS))
    boxes = [block(s * (0.5 * w - 0.015), 0.5 * d, 0.0, 0.03, d, h, paint) for s in (-1, 1)]
    boxes.append(block(0.0, 0.02, 0.0, w - 0.06, 0.02, h, paint))
    levels = np.linspace(0.06, h - 0.03, 6)
    boxes += [block(0.0, 0.5 * d, z, w - 0.06, d, 0.03, paint) for z in levels]
    for z, room in zip(levels[:-1] + 0.03, np.diff(levels) - 0.03, strict=True):
        left = -0.5 * w + 0.04
        while left < 0.5 * w - 0.2:
            span = min(rng.uniform(0.22, 0.55), 0.5 * w - 0.04 - left)
            if rng.random() < 0.82:
                deep, tall = rng.uniform(0.18, 0.26), room * rng.uniform(0.62, 0.92)
                boxes.append(
                    block(left + 0.5 * span, 0.03 + 0.5 * deep, z, span, deep, tall, textures.books, textures.books)
                )
            else:
                paint_vase = partial(textures.plain, colour=pick(rng, CLOTHS))
                boxes.append(block(left + 0.5 * span, 0.18, z, 0.09, 0.09, 0.6 * room, paint_vase))
            left += span + rng.uniform(0.01, 0.07)
    return Piece(tuple(boxes), w, d, h)


@single_instance
def sofa(rng: Random) -> Piece:
    """Return a sofa with cushions and pillows."""
    w, d = rng.uniform(1.8, 2.1), 0.88
    colour = pick(rng, CLOTHS)
    cloth, seat = (partial(textures.fabric, colour=textures.vary(rng, colour, a)) for a in (0.0, 0.08))
    boxes = [block(0.0, 0.5 * d, 0.08, w, d, 0.28, cloth), block(0.0, 0.14, 0.36, w - 0.36, 0.24, 0.5, cloth)]
    boxes += [block(s * (0.5 * w - 0.1), 0.5 * d, 0.36, 0.2, d, 0.26, cloth) for s in (-1, 1)]
    each = (w - 0.42) / 2.0
    boxes += [block(s * 0.5 * (each + 0.01), 0.55, 0.36, each, 0.6, 0.13, seat) for s in (-1, 1)]
    for s in (-1, 1):
        pillow = partial(textures.fabric, colour=pick(rng, CLOTHS))
        tilted = block(0.0, 0.0, 0.0, 0.42, 0.12, 0.42, pillow)
        lean = np.array([[1.0, 0.0, 0.0], [0.0, 0.94, 0.34], [0.0, -0.34, 0.94]])
        position = np.array([s * rng.uniform(0.35, 0.6) * (0.5 * w), 0.37, 0.48])
        boxes.append(tilted.moved(rotation_z(rng.uniform(-0.3, 0.3)) @ lean, position))
    return Piece(tuple(boxes), w, d, 0.86, picture_above=True)


@single_instance
def armchair(rng: Random) -> Piece:
    """Return an armchair, turned a little."""
    cloth = partial(textures.fabric, colour=pick(rng, CLOTHS))
    boxes = [block(0.0, 0.0, 0.1, 0.72, 0.7, 0.3, cloth), block(0.0, -0.28, 0.4, 0.72, 0.16, 0.48, cloth)]
    boxes += [block(s * 0.3, 0.04, 0.4, 0.12, 0.56, 0.2, cloth) for s in (-1, 1)]
    boxes += [block(sx * 0.3, sy * 0.29, 0.0, 0.05, 0.05, 0.1, cloth) for sx in (-1, 1) for sy in (-1, 1)]
    R = rotation_z(rng.uniform(-0.4, 0.4))
    return Piece(tuple(box.moved(R, np.array([0.0, 0.48, 0.0])) for box in boxes), 0.95, 0.94, 0.9, picture_above=True)


def _chair(rng: Random, paint: Paint) -> list[Box]:
    """Return a chair at the origin that faces −y."""
    boxes = [block(0.0, 0.0, 0.43, 0.42, 0.42, 0.04, paint), block(0.0, 0.19, 0.62, 0.4, 0.03, 0.3, paint)]
    boxes += [block(s * 0.185, 0.19, 0.47, 0.035, 0.035, 0.45, paint) for s in (-1, 1)]
    return boxes + _legs(0.42, 0.42, 0.43, 0.0, paint, 0.04)


@single_instance
def dining_table(rng: Random) -> Piece:
    """Return a laid table with a chair at each end."""
    paint = partial(textures.wood, colour=pick(rng, WOODS))
    chair = partial(textures.wood, colour=pick(rng, WOODS))
    w, d = rng.uniform(1.2, 1.4), 0.8
    y = 0.5 * d + 0.06
    boxes = [block(0.0, y, 0.71, w, d, 0.04, paint), *_legs(w - 0.06, d - 0.06, 0.71, y, paint, 0.06)]
    for s in (-1, 1):
        R = rotation_z(-s * (0.5 * np.pi + rng.uniform(-0.25, 0.25)))
        boxes += [box.moved(R, np.array([s * (0.5 * w + 0.16), y, 0.0])) for box in _chair(rng, chair)]
    cloth = partial(textures.fabric, colour=pick(rng, CLOTHS))
    boxes.append(block(0.0, y, 0.75, 0.36, d - 0.06, 0.006, cloth))
    for x in (-0.42, 0.42):
        plate = partial(textures.plain, colour=WHITE)
        boxes.append(block(x, y + rng.uniform(-0.1, 0.1), 0.75, 0.2, 0.2, 0.015, plate))
        mug = partial(textures.plain, colour=pick(rng, CLOTHS))
        boxes.append(block(x + 0.16, y + rng.uniform(0.0, 0.25), 0.75, 0.07, 0.07, 0.09, mug))
    boxes.append(block(0.0, y - 0.1, 0.756, 0.14, 0.14, 0.2, partial(textures.plain, colour=pick(rng, CLOTHS))))
    return Piece(tuple(boxes), w + 0.8, d + 0.06, 0.95, picture_above=True)


@single_instance
def desk(rng: Random) -> Piece:
    """Return a desk with a computer, papers and books."""
    w, d = rng.uniform(1.3, 1.5), 0.65
    paint = partial(textures.wood, colour=pick(rng, WOODS))
    dark = partial(textures.plain, colour=(44, 44, 48))
    boxes = [block(0.0, 0.5 * d, 0.7, w, d, 0.035, paint)]
    boxes += [block(s * (0.5 * w - 0.02), 0.5 * d, 0.0, 0.04, d - 0.04, 0.7, paint) for s in (-1, 1)]
    drawer = partial(textures.drawers, colour=pick(rng, WOODS))
    boxes.append(block(0.5 * w - 0.26, 0.5 * d, 0.1, 0.4, d - 0.08, 0.6, paint, drawer))
    boxes.append(block(-0.05, 0.16, 0.735, 0.22, 0.16, 0.02, dark))
    boxes.append(block(-0.05, 0.12, 0.755, 0.05, 0.04, 0.12, dark))
    shown = partial(textures.screen, colour=(60, 84, 110))
    boxes.append(block(-0.05, 0.15, 0.83, 0.6, 0.035, 0.36, dark, shown))
    boxes.append(block(-0.05, 0.42, 0.735, 0.44, 0.14, 0.02, partial(textures.drawers, colour=(90, 90, 96))))
    boxes.append(block(0.45, 0.17, 0.735, 0.26, 0.18, 0.24, textures.books, textures.books))
    boxes.append(block(-0.5, 0.36, 0.735, 0.22, 0.3, 0.004, pictures.chart))
    return Piece(tuple(boxes), w, d, 1.19)


@single_instance
def sideboard(rng: Random) -> Piece:
    """Return a low chest of drawers with things on top."""
    w, d, h = rng.uniform(1.4, 1.7), 0.45, 0.78
    colour = pick(rng, WOODS)
    body, front = partial(textures.wood, colour=colour), partial(textures.drawers, colour=colour)
    boxes = [
        block(0.0, 0.5 * d, 0.1, w, d, h - 0.12, body, front),
        block(0.0, 0.5 * d, h - 0.02, w + 0.04, d, 0.03, body),
    ]
    boxes += _legs(w - 0.08, d - 0.08, 0.1, 0.5 * d, body)
    top = h + 0.01
    boxes.append(block(-0.3 * w, 0.2, top, 0.32, 0.2, 0.24, textures.books, textures.books))
    boxes.append(block(0.02, 0.22, top, 0.1, 0.1, 0.26, partial(textures.plain, colour=pick(rng, CLOTHS))))
    boxes.append(block(0.22, 0.16, top, 0.24, 0.02, 0.3, body, _picture(rng)))
    base = partial(textures.plain, colour=METAL)
    shade = partial(textures.lampshade, colour=(236, 214, 170))
    boxes.append(block(0.38 * w, 0.22, top, 0.05, 0.05, 0.22, base))
    bulb = np.array([0.38 * w, 0.22, top + 0.31])
    boxes.append(Box(bulb, np.array([0.11, 0.11, 0.09]), shade, glow=0.8))
    return Piece(tuple(boxes), w + 0.04, d, top + 0.4, picture_above=True, lights=(AreaLight(bulb[None], 0.2),))


@single_instance
def wardrobe(rng: Random) -> Piece:
    """Return a wardrobe with two panelled doors and a carton on top."""
    w, d, h = rng.uniform(1.05, 1.25), 0.58, rng.uniform(1.9, 2.1)
    colour = pick(rng, WOODS)
    body, leaf = partial(textures.wood, colour=colour), partial(textures.door, colour=colour)
    boxes = [block(0.0, 0.5 * (d - 0.02), 0.0, w, d - 0.02, h, body)]
    boxes += [block(s * 0.25 * w, d - 0.015, 0.05, 0.48 * w, 0.03, h - 0.1, body, leaf) for s in (-1, 1)]
    boxes.append(block(0.0, 0.5 * d, h, w + 0.06, d, 0.05, body))
    carton = partial(textures.cardboard, colour=(176, 136, 92))
    boxes.append(block(rng.uniform(-0.2, 0.2), 0.28, h + 0.05, 0.5, 0.36, 0.28, carton))
    return Piece(tuple(boxes), w + 0.06, d, h + 0.33)


@single_instance
def media_unit(rng: Random) -> Piece:
    """Return a low unit with a loudspeaker at each side of a screen."""
    w, d = rng.uniform(1.5, 1.7), 0.42
    colour = pick(rng, WOODS)
    body, front = partial(textures.wood, colour=colour), partial(textures.drawers, colour=colour)
    dark = partial(textures.plain, colour=(40, 40, 44))
    boxes = [block(0.0, 0.5 * d, 0.06, w, d, 0.4, body, front)]
    boxes.append(block(0.0, 0.2, 0.52, 0.95, 0.05, 0.56, dark, pictures.landscape))
    boxes.append(block(0.0, 0.2, 0.46, 0.3, 0.2, 0.06, dark))
    mesh = partial(textures.fabric, colour=(70, 68, 66))
    boxes += [block(s * (0.5 * w - 0.13), 0.2, 0.46, 0.2, 0.24, 0.42, body, mesh) for s in (-1, 1)]
    return Piece(tuple(boxes), w, d, 1.1, picture_above=True)


@single_instance
def cartons(rng: Random) -> Piece:
    """Return a stack of cartons."""
    boxes, heights = [], []
    for x in (-0.28, 0.28):
        z = 0.0
        for _ in range(int(rng.integers(1, 4))):
            w, d, h = rng.uniform(0.34, 0.5), rng.uniform(0.34, 0.5), rng.uniform(0.24, 0.4)
            paint = partial(textures.cardboard, colour=textures.vary(rng, (178, 138, 94), 0.08))
            box = block(0.0, 0.0, 0.0, w, d, h, paint)
            boxes.append(box.moved(rotation_z(rng.uniform(-0.12, 0.12)), np.array([x, 0.34, z])))
            z += h
        heights.append(z)
    return Piece(tuple(boxes), 1.12, 0.66, max(heights), picture_above=max(heights) < 0.9)


@single_instance
def plant(rng: Random) -> Piece:
    """Return a plant in a pot."""
    pot = partial(textures.plain, colour=textures.vary(rng, (150, 92, 66), 0.15))
    stem = partial(textures.wood, colour=(96, 76, 50))
    tall = rng.uniform(0.7, 1.0)
    boxes = [block(0.0, 0.35, 0.0, 0.34, 0.34, 0.34, pot), block(0.0, 0.35, 0.34, 0.04, 0.04, tall - 0.1, stem)]
    for k in range(26):
        leaf = partial(textures.foliage, colour=textures.vary(rng, LEAF, 0.15))
        length = rng.uniform(0.2, 0.34) * (1.0 - 0.4 * k / 26.0)
        blade = Box(np.array([0.0, 0.5 * length, 0.0]), np.array([0.28 * length, 0.5 * length, 0.003]), leaf)
        pitch = rng.uniform(-0.3, 0.8)
        c, s = np.cos(pitch), np.sin(pitch)
        R = rotation_z(2.4 * k + rng.uniform(-0.3, 0.3)) @ np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
        boxes.append(blade.moved(R, np.array([0.0, 0.35, 0.4 + tall * (k + 1) / 26.0])))
    return Piece(tuple(boxes), 0.72, 0.72, 0.5 + tall)


@single_instance
def floor_lamp(rng: Random) -> Piece:
    """Return a lamp on a pole."""
    metal = partial(textures.plain, colour=METAL)
    shade = partial(textures.lampshade, colour=(240, 220, 180))
    bulb = np.array([0.0, 0.25, 1.56])
    boxes = (
        block(0.0, 0.25, 0.0, 0.3, 0.3, 0.03, metal),
        block(0.0, 0.25, 0.03, 0.03, 0.03, 1.4, metal),
        Box(bulb, np.array([0.19, 0.19, 0.15]), shade, glow=0.9),
    )
    return Piece(boxes, 0.44, 0.46, 1.71, lights=(AreaLight(bulb[None], 0.5),))


@single_instance
def window(rng: Random) -> Piece:
    """Return a window with a sill and a radiator below."""
    w, h, sill = 1.6, 1.35, 1.0
    white = partial(textures.plain, colour=WHITE)
    middle = np.array([0.0, 0.02, sill + 0.5 * h])
    view = Box(middle, np.array([0.5 * w, 0.02, 0.5 * h]), white, pictures.window_view, glow=0.95)
    fins = partial(textures.radiator, colour=WHITE)
    pot = block(rng.uniform(-0.5, 0.5), 0.12, sill, 0.14, 0.14, 0.14, partial(textures.plain, colour=(160, 96, 70)))
    ledge = block(0.0, 0.1, sill - 0.04, w + 0.1, 0.2, 0.04, white)
    grid = np.array([[x, 0.06, sill + z] for x in (-0.4, 0.4) for z in (0.35, 1.0)])
    daylight = AreaLight(grid, 2.2, np.array([0.0, 1.0, 0.0]))
    boxes = (view, ledge, block(0.0, 0.08, 0.12, 1.2, 0.1, 0.62, white, fins), pot)
    return Piece(boxes, w + 0.1, 0.2, sill + h, lights=(daylight,))


@single_instance
def room_door(rng: Random) -> Piece:
    """Return a closed door in its frame."""
    colour = pick(rng, WOODS)
    frame, leaf = partial(textures.wood, colour=colour), partial(textures.door, colour=textures.vary(rng, colour, 0.1))
    boxes = [block(0.0, 0.015, 0.0, 0.92, 0.03, 2.05, frame, leaf)]
    boxes += [block(s * 0.5, 0.03, 0.0, 0.08, 0.06, 2.13, frame) for s in (-1, 1)]
    boxes.append(block(0.0, 0.03, 2.05, 0.92, 0.06, 0.08, frame))
    return Piece(tuple(boxes), 1.1, 0.06, 2.13)


def _picture(rng: Random) -> Paint:
    return pictures.PICTURES[int(rng.integers(len(pictures.PICTURES)))]


@single_instance
def hung_picture(rng: Random, centre_z: float = 1.65) -> Piece:
    """Return a framed picture that hangs on the wall."""
    w, h = rng.uniform(0.6, 0.95), rng.uniform(0.5, 0.75)
    wood = partial(textures.wood, colour=pick(rng, WOODS))
    canvas = Box(np.array([0.0, 0.012, centre_z]), np.array([0.5 * w, 0.012, 0.5 * h]), wood, _picture(rng))
    bars = [block(s * 0.5 * w, 0.02, centre_z - 0.5 * h - 0.03, 0.04, 0.04, h + 0.06, wood) for s in (-1, 1)]
    bars += [block(0.0, 0.02, centre_z + s * 0.5 * h - 0.02, w - 0.04, 0.04, 0.04, wood) for s in (-1, 1)]
    return Piece((canvas, *bars), w + 0.08, 0.04, 0.0)


FURNITURE: tuple[Callable[[Random], Piece], ...] = (
    bookcase,
    bookcase,
    sofa,
    dining_table,
    desk,
    sideboard,
    wardrobe,
    media_unit,
    armchair,
    cartons,
    plant,
    plant,
    floor_lamp,
    hung_picture,
    hung_picture,
)
"""Furniture of a furnished room, without doors and windows."""
