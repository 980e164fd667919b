"""Furniture of public buildings: office doors, notice boards, lockers, benches, machines.

Each piece stands in the frame that `dronevio.sim.props.furniture` describes: its back against the wall y = 0.
"""

from collections.abc import Callable
from functools import partial

import numpy as np

from dronevio.sim.appearance import pictures, textures, textures_building
from dronevio.sim.appearance.instances import single_instance
from dronevio.sim.appearance.solids import Box
from dronevio.sim.appearance.textures import Colour
from dronevio.sim.props.furniture import CLOTHS, METAL, WHITE, WOODS, Piece, block, hung_picture, pick, plant

Random = np.random.Generator

DOORS: tuple[Colour, ...] = ((168, 128, 84), (120, 140, 156), (150, 92, 70), (104, 128, 108))
LOCKERS: tuple[Colour, ...] = ((108, 134, 158), (150, 110, 84), (126, 146, 118), (168, 160, 140))


@single_instance
def office_door(rng: Random) -> Piece:
    """Return a door with its frame, a number beside it and a stop on the floor."""
    colour, steel = pick(rng, DOORS), partial(textures.plain, colour=(92, 96, 102))
    leaf = partial(textures_building.office_door, colour=colour, number=f"{int(rng.integers(100, 400))}")
    boxes = [block(0.0, 0.012, 0.0, 0.96, 0.024, 2.08, steel, leaf)]
    boxes += [block(s * 0.52, 0.03, 0.0, 0.09, 0.06, 2.17, steel) for s in (-1, 1)]
    boxes.append(block(0.0, 0.03, 2.08, 0.96, 0.06, 0.09, steel))
    paper = partial(textures_building.notice_board)
    boxes.append(block(-0.78, 0.008, 1.45, 0.26, 0.016, 0.34, steel, paper))
    return Piece(tuple(boxes), 1.85, 0.06, 0.0)


@single_instance
def board(rng: Random) -> Piece:
    """Return a notice board."""
    w, h = rng.uniform(1.3, 1.9), rng.uniform(0.85, 1.05)
    edge = partial(textures.plain, colour=(120, 122, 126))
    return Piece((block(0.0, 0.02, 1.15, w, 0.04, h, edge, textures_building.notice_board),), w, 0.05, 0.0)


@single_instance
def posters(rng: Random) -> Piece:
    """Return two or three framed pictures side by side."""
    boxes: list[Box] = []
    count = int(rng.integers(2, 4))
    frame = partial(textures.plain, colour=(46, 46, 50))
    for k in range(count):
        shown = pictures.PICTURES[int(rng.integers(len(pictures.PICTURES)))]
        z = rng.uniform(1.2, 1.35)
        boxes.append(block((k - 0.5 * (count - 1)) * 0.72, 0.0125, z, 0.56, 0.025, 0.78, frame, shown))
    return Piece(tuple(boxes), 0.72 * count, 0.03, 0.0)


@single_instance
def locker_row(rng: Random) -> Piece:
    """Return a row of lockers with a box or two on top."""
    w, d, h = 0.32 * int(rng.integers(4, 8)), 0.42, 1.75
    colour = pick(rng, LOCKERS)
    body = partial(textures.plain, colour=colour)
    front = partial(textures_building.lockers, colour=colour, px_per_m=textures.PIXELS_PER_M)
    boxes = [block(0.0, 0.5 * d, 0.08, w, d, h - 0.08, body, front)]
    boxes.append(block(0.0, 0.5 * d - 0.02, 0.0, w - 0.04, d - 0.06, 0.08, partial(textures.plain, colour=METAL)))
    for x in np.arange(-0.5 * w + 0.25, 0.5 * w - 0.2, 0.5):
        if rng.random() < 0.5:
            carton = partial(textures.cardboard, colour=textures.vary(rng, (176, 136, 92), 0.1))
            boxes.append(block(x, 0.2, h, 0.38, 0.3, rng.uniform(0.18, 0.3), carton))
    return Piece(tuple(boxes), w, d, h + 0.3)


@single_instance
def bench(rng: Random) -> Piece:
    """Return a bench of slats with a bag on it."""
    w = rng.uniform(1.3, 1.7)
    wood, iron = partial(textures.wood, colour=pick(rng, WOODS)), partial(textures.plain, colour=METAL)
    boxes = [block(0.0, 0.1 + 0.11 * k, 0.42, w, 0.09, 0.035, wood) for k in range(4)]
    boxes += [block(s * 0.42 * w, 0.26, 0.0, 0.05, 0.4, 0.42, iron) for s in (-1, 1)]
    boxes += [block(0.0, 0.03, 0.62 + 0.14 * k, w, 0.03, 0.1, wood) for k in range(2)]
    boxes += [block(s * 0.42 * w, 0.025, 0.42, 0.04, 0.05, 0.46, iron) for s in (-1, 1)]
    bag = partial(textures.fabric, colour=pick(rng, CLOTHS))
    boxes.append(block(rng.uniform(-0.4, 0.4) * w, 0.26, 0.455, 0.36, 0.2, 0.3, bag))
    return Piece(tuple(boxes), w, 0.5, 0.88, picture_above=True)


@single_instance
def hose_cabinet(rng: Random) -> Piece:
    """Return the red cabinet of a fire hose, an extinguisher below it."""
    red = partial(textures.plain, colour=(184, 36, 30))
    boxes = [block(0.0, 0.08, 1.0, 0.62, 0.16, 0.66, red, textures_building.hydrant_box)]
    boxes.append(block(0.0, 0.1, 0.12, 0.15, 0.15, 0.5, red))
    boxes.append(block(0.0, 0.1, 0.62, 0.05, 0.05, 0.08, partial(textures.plain, colour=(30, 30, 32))))
    return Piece(tuple(boxes), 0.66, 0.2, 1.66)


@single_instance
def vending_machine(rng: Random) -> Piece:
    """Return a vending machine."""
    colour = pick(rng, ((160, 44, 40), (40, 70, 120), (60, 64, 70)))
    front = partial(textures_building.vending_machine, colour=colour)
    body = partial(textures.plain, colour=colour)
    return Piece((block(0.0, 0.4, 0.03, 0.95, 0.76, 1.8, body, front),), 1.0, 0.8, 1.83)


@single_instance
def water_cooler(rng: Random) -> Piece:
    """Return a water cooler with its bottle and a bin."""
    white, blue = partial(textures.plain, colour=WHITE), partial(textures.plain, colour=(126, 168, 200))
    dark = partial(textures.plain, colour=(58, 60, 66))
    boxes = (
        block(-0.2, 0.2, 0.0, 0.32, 0.32, 0.98, white),
        block(-0.2, 0.365, 0.62, 0.22, 0.012, 0.18, dark),
        block(-0.2, 0.2, 0.98, 0.26, 0.26, 0.36, blue),
        block(0.26, 0.18, 0.0, 0.28, 0.28, 0.5 + rng.uniform(0.0, 0.2), dark),
    )
    return Piece(boxes, 0.84, 0.38, 1.36, picture_above=True)


@single_instance
def copier(rng: Random) -> Piece:
    """Return a copying machine, paper beside it."""
    grey, pale = partial(textures.drawers, colour=(122, 124, 130)), partial(textures.plain, colour=(196, 196, 192))
    shown = partial(textures.screen, colour=(60, 90, 130))
    boxes = [
        block(0.0, 0.3, 0.05, 0.6, 0.56, 0.6, pale, grey),
        block(0.0, 0.3, 0.65, 0.66, 0.58, 0.26, pale),
        block(0.05, 0.3, 0.91, 0.52, 0.46, 0.09, partial(textures.plain, colour=(74, 76, 82))),
        block(-0.22, 0.545, 0.93, 0.2, 0.05, 0.14, pale, shown),
    ]
    for k in range(int(rng.integers(1, 4))):
        ream = partial(textures.cardboard, colour=(208, 206, 198))
        boxes.append(block(0.5, 0.2, 0.16 * k, 0.26, 0.34, 0.155, ream))
    return Piece(tuple(boxes), 1.3, 0.6, 1.07, picture_above=True)


PUBLIC_FURNITURE: tuple[Callable[[Random], Piece], ...] = (
    office_door,
    board,
    locker_row,
    office_door,
    posters,
    bench,
    office_door,
    board,
    hose_cabinet,
    water_cooler,
    plant,
    office_door,
    hung_picture,
    copier,
)
"""What stands and hangs along the walls of a public building, doors being the most frequent."""
