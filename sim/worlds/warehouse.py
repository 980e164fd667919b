"""World warehouse: three aisles between high racks of pallets, and a loading area."""

from dataclasses import replace
from functools import partial

import cv2
import numpy as np

from dronevio.models.arrays import Array, Image
from dronevio.models.rotation import rotation_z
from dronevio.sim.appearance import textures, textures_building, textures_storage
from dronevio.sim.appearance.instances import single_instance
from dronevio.sim.appearance.lightmap import AreaLight
from dronevio.sim.appearance.solids import Box, Surface
from dronevio.sim.props.building import ceiling_lamp, coarse, hall_faces, landing_mat, room_walls
from dronevio.sim.props.furniture import METAL, Piece, block
from dronevio.sim.props.furniture_public import board, hose_cabinet, posters
from dronevio.sim.props.storage import PALLET_M, Stock, forklift, loaded_pallet, packing_table, rack, truss
from dronevio.sim.worlds.layout import Layout, WorldBuilder

Random = np.random.Generator

LOW_M, HIGH_M = np.array([-12.0, -8.0, 0.0]), np.array([12.0, 8.0, 7.0])
"""Corners of the hall [m]."""
_BAYS, _BAY_M, _DEPTH_M, _HEIGHT_M = 6, 2.4, 1.1, 5.4
_LEVELS_M = (0.0, 1.55, 3.1, 4.65)
_RACK_X_M = 3.0  # centre of the racks
_RACKS = ((-8.0, 0.0), (-2.8, np.pi), (-2.8, 0.0), (2.8, np.pi), (2.8, 0.0), (8.0, np.pi))  # y of the back, heading
_TOP_M = 6.1  # height of the highest loads
_AISLES_M = (-5.35, 0.0, 5.35)
_EMPTY = 0.12  # fraction of empty places
_PAD_M = np.array([-8.0, 0.0, 0.0])
_FLOOR_PX_PER_M, _WALL_PX_PER_M, _CEILING_PX_PER_M, _THING_PX_PER_M = 84.0, 72.0, 48.0, 96.0
_CLOSE_PX_PER_M = 144.0
_TRUSS_M = 0.55


def layout(rng: Random) -> Layout:
    """Draw a warehouse."""
    stock = Stock.painted(rng)
    shell: list[Surface] = [*_hall(rng)]
    pieces: list[Piece] = []
    shading: list[Box] = []
    filling: list[Box] = []
    for y, turn in _RACKS:
        place = np.array([_RACK_X_M, y, 0.0])
        pieces.append(rack(_BAYS, _BAY_M, _DEPTH_M, _LEVELS_M, _HEIGHT_M).moved(rotation_z(turn), place))
        faces, loads = _goods(rng, stock, rotation_z(turn), place)
        shell, filling = [*shell, *faces], [*filling, *loads]
        shading += _shelves(rotation_z(turn), place)
    obstacles = _rack_hulls()
    filling += _loading_area(rng, stock, pieces, obstacles, shell)
    _roof(pieces, obstacles)
    boxes = coarse([box for piece in pieces for box in piece.boxes], _THING_PX_PER_M)
    shading += [box for box in boxes if box.glow == 0.0 and box.half.min() > 0.08]
    return Layout(
        low=LOW_M.copy(),
        high=HIGH_M.copy(),
        shell=tuple(shell),
        boxes=(*boxes, landing_mat(_PAD_M)),
        obstacles=tuple(obstacles),
        lights=(*(light for piece in pieces for light in piece.lights), *_skylight()),
        pad=_PAD_M.copy(),
        free_box=np.array([[-10.0, -5.0, 0.0], [-6.0, 5.0, 5.0]]),
        route=_route(),
        shading=tuple(shading),
        filling=tuple(filling),
    )


def _route() -> Array:
    """Return a tour through all the aisles, the middle one twice."""
    x = 0.5 * (_RACK_X_M + 0.5 * _BAYS * _BAY_M + HIGH_M[0])
    south, middle, north = _AISLES_M
    tour = [(_PAD_M[0], middle, 1.5), (x, middle, 2.2), (x, south, 3.0), (_PAD_M[0], south, 1.6)]
    tour += [(_PAD_M[0] - 1.0, middle, 3.0), (_PAD_M[0], north, 2.4), (x, north, 3.6), (x, middle, 4.2)]
    return np.array(tour)


def _hall(rng: Random) -> tuple[Surface, ...]:
    """Return floor, ceiling and walls."""
    walls = [partial(_wall, colour=textures.vary(rng, (158, 166, 170), 0.03)) for _ in range(4)]
    roof = partial(textures_building.sheet_metal, colour=(168, 172, 174), px_per_m=_CEILING_PX_PER_M, rib_m=0.5)
    density = (_FLOOR_PX_PER_M, _WALL_PX_PER_M, _CEILING_PX_PER_M)
    faces = list(hall_faces(LOW_M, HIGH_M, _floor, roof, walls, density))
    faces[3] = replace(  # the east wall is seen from a short distance
        faces[3], paint=partial(walls[1], px_per_m=_CLOSE_PX_PER_M), pixels_per_m=_CLOSE_PX_PER_M
    )
    return tuple(faces)


def _floor(rng: Random, height: int, width: int) -> Image:
    """Return the concrete floor with lanes, numbers and hatched areas painted on it."""
    image = textures_building.concrete(rng, height, width, (150, 148, 142), _FLOOR_PX_PER_M)
    paint = image.copy()
    yellow, stroke = (222.0, 184.0, 48.0), round(0.1 * _FLOOR_PX_PER_M)

    def px(x: float, y: float) -> tuple[int, int]:
        return int((x - LOW_M[0]) * _FLOOR_PX_PER_M), int((HIGH_M[1] - y) * _FLOOR_PX_PER_M)

    first = _RACK_X_M - 0.5 * _BAYS * _BAY_M
    for number, y in enumerate(_AISLES_M):
        for side in (-1.3, 1.3):
            cv2.line(paint, px(first - 0.6, y + side), px(HIGH_M[0] - 1.4, y + side), yellow, stroke)
        for k in range(_BAYS):
            x = first + (k + 0.5) * _BAY_M
            words = f"{'ABC'[number]}{k + 1}"
            textures_building.text(paint, words, px(x, y), 0.3 * _FLOOR_PX_PER_M, (226.0, 224.0, 214.0))
    for y in (-5.0, 0.0, 5.0):  # before the doors
        for k in range(9):
            x = LOW_M[0] + 0.3 + 0.16 * k
            cv2.line(paint, px(x, y - 1.3), px(x + 0.16, y + 1.3), yellow, max(stroke // 2, 2), cv2.LINE_AA)
        cv2.rectangle(paint, px(LOW_M[0] + 0.2, y + 1.4), px(LOW_M[0] + 1.8, y - 1.4), yellow, stroke)
    for x in (-10.0, -5.6):
        cv2.line(paint, px(x, -6.2), px(x, 6.2), (214.0, 212.0, 204.0), stroke)
    cv2.addWeighted(paint, 0.8, image, 0.2, 0.0, dst=image)
    return textures.speckle(rng, image, 0.03)


def _wall(rng: Random, height: int, width: int, colour: textures.Colour, px_per_m: float = _WALL_PX_PER_M) -> Image:
    """Return metal sheets above a plinth of concrete blocks."""
    image = textures_building.sheet_metal(rng, height, width, colour, px_per_m)
    top = height - int(2.3 * px_per_m)
    blocks = textures.bricks(rng, height - top, width, (156, 152, 146)).astype(np.float32)
    image[top:] = textures.to_image(0.3 * blocks + 0.7 * blocks.mean(axis=2, keepdims=True))
    image[top - 4 : top + 3] = image[top - 4 : top + 3] // 2
    return image


def _goods(rng: Random, stock: Stock, R: Array, back: Array) -> tuple[list[Surface], list[Box]]:
    """Return faces and boxes of the goods of a rack with its back at ``back`` (3,) and orientation R (3, 3)."""
    faces: list[Surface] = []
    loads: list[Box] = []
    tops = (*np.diff(_LEVELS_M) - 0.2, _TOP_M - _LEVELS_M[-1])
    for level, room in zip(_LEVELS_M, tops, strict=True):
        for x in (np.arange(2 * _BAYS) + 0.5) * 0.5 * _BAY_M - 0.5 * _BAYS * _BAY_M:
            if rng.random() > _EMPTY:
                inside = np.array([x + rng.uniform(-0.02, 0.02), 0.54 + rng.uniform(-0.03, 0.03), level])
                turned = R @ rotation_z(rng.uniform(-0.02, 0.02))
                seen, boxes, _ = loaded_pallet(rng, stock, turned, R @ inside + back, float(room))
                faces, loads = [*faces, *seen], [*loads, *boxes]
    return faces, loads


def _shelves(R: Array, back: Array) -> list[Box]:
    """Return a plate within the pallets of each level of a rack but the lowest, which casts the shadow of the goods."""
    grey = partial(textures.plain, colour=METAL)
    half = np.array([0.5 * _BAYS * _BAY_M, 0.45, 0.01])
    within_m = 0.5 * PALLET_M[2]
    return [Box(np.array([0.0, 0.54, level + within_m]), half, grey).moved(R, back) for level in _LEVELS_M[1:]]


def _rack_hulls() -> list[Box]:
    """Return a box around each row of racks, goods and guards included."""
    grey = partial(textures.plain, colour=METAL)
    half_x = 0.5 * _BAYS * _BAY_M + 0.1
    spans = (
        (-8.0, -8.0 + _DEPTH_M),
        (-2.8 - _DEPTH_M, -2.8 + _DEPTH_M),
        (2.8 - _DEPTH_M, 2.8 + _DEPTH_M),
        (8.0 - _DEPTH_M, 8.0),
    )
    hulls = []
    for low, high in spans:
        reach = 0.5 * (high - low) + 0.09
        middle = np.array([_RACK_X_M, 0.5 * (low + high), 0.5 * _TOP_M])
        hulls.append(Box(middle, np.array([half_x, reach, 0.5 * _TOP_M]), grey))
    return hulls


def _loading_area(
    rng: Random, stock: Stock, pieces: list[Piece], obstacles: list[Box], shell: list[Surface]
) -> list[Box]:
    """Fill the loading area: doors in the west wall, tables and cabinets between them, pallets and a forklift.

    Returns:
        The boxes of the pallets and their loads.
    """
    filling: list[Box] = []
    south, east, north, west = room_walls(LOW_M, HIGH_M)
    for number, x in enumerate((-5.0, 0.0, 5.0)):
        door = partial(textures_storage.roller_door, colour=(176, 178, 176), number=f"{number + 1}")
        steel = partial(textures.plain, colour=METAL)
        frame = [block(0.0, 0.03, 0.0, 2.9, 0.06, 3.4, steel, door)]
        frame += [block(s * 1.52, 0.07, 0.0, 0.14, 0.14, 3.5, textures_storage.hazard) for s in (-1, 1)]
        frame.append(block(0.0, 0.12, 3.4, 3.2, 0.24, 0.4, steel))
        pieces.append(west.put(Piece(tuple(frame), 3.2, 0.24, 3.8).as_instance("roller_door"), x))
        obstacles.append(west.hull(pieces[-1], x))
    standing = [(west, packing_table(rng), -2.5), (west, packing_table(rng), 2.5)]
    standing += [(west, hose_cabinet(rng), 7.2), (south, forklift(rng), -9.6), (west, hose_cabinet(rng), -7.2)]
    for wall, piece, x in standing:
        pieces.append(wall.put(piece, x))
        obstacles.append(wall.hull(piece, x))
    pieces += [south.put(board(rng), -6.6), north.put(board(rng), 10.6)]
    for x in (-5.35, -2.7, 0.0, 2.7, 5.35):
        pieces += [east.put(board(rng) if x in _AISLES_M else posters(rng), x), east.put(_louvre(), x + 0.6)]
    for x, y in ((-11.2, 7.2), (-9.9, 7.25), (-7.0, 7.2), (-5.4, 7.3), (-7.6, -7.3), (-5.6, -7.2)):
        tall = 0.0
        R = rotation_z((0.0 if y < 0.0 else np.pi) + rng.uniform(-0.08, 0.08))
        for _ in range(int(rng.integers(1, 3))):
            faces, loads, height = loaded_pallet(rng, stock, R, np.array([x, y, tall]), 1.25)
            shell += faces
            filling += loads
            tall += height
        half = np.array([0.6, 0.58, 0.5 * tall])
        obstacles.append(Box(np.array([x, y, half[2]]), half, partial(textures.plain, colour=METAL), R=R))
    return filling


@single_instance
def _louvre() -> Piece:
    """Return a ventilation louvre high on a wall, with the switches of its fan below."""
    fins, steel = partial(textures.radiator, colour=(150, 154, 158)), partial(textures.plain, colour=METAL)
    boxes = [block(0.0, 0.03, 3.1, 1.0, 0.06, 1.0, steel, fins), block(0.3, 0.05, 2.5, 0.3, 0.1, 0.4, steel)]
    boxes.append(block(0.3, 0.02, 2.9, 0.04, 0.04, 0.2, steel))
    return Piece(tuple(boxes), 1.0, 0.1, 0.0)


def _roof(pieces: list[Piece], obstacles: list[Box]) -> None:
    """Add girders, lamps and the signs of the aisles."""
    sign = np.array([_RACK_X_M - 0.5 * _BAYS * _BAY_M - 0.3, 0.0, 5.2])
    grey = partial(textures.plain, colour=METAL)
    for x in (-9.6, -4.8, 0.0, 4.8, 9.6):
        place = np.array([x, 0.0, HIGH_M[2] - _TRUSS_M])
        pieces.append(truss(float(HIGH_M[1] - LOW_M[1]), _TRUSS_M).moved(rotation_z(0.5 * np.pi), place))
        obstacles.append(Box(place + [0.0, 0.0, 0.5 * _TRUSS_M], np.array([0.06, 8.0, 0.5 * _TRUSS_M]), grey))
    for x in (-10.4, -7.2, -2.4, 2.4, 7.2):
        for y in _AISLES_M:
            lamp = ceiling_lamp(np.array([x, y, HIGH_M[2]]), (1.2, 0.4), 1.0, drop_m=0.6)
            pieces.append(lamp)
            glass = lamp.boxes[0]
            obstacles.append(Box(glass.centre + [0.0, 0.0, 0.3], glass.half + [0.0, 0.0, 0.3], grey))
    for letter, y in zip("ABC", _AISLES_M, strict=True):
        shown = partial(textures_storage.aisle_sign, letter=letter)
        turn = rotation_z(0.5 * np.pi)
        plate = Box(np.zeros(3), np.array([0.5, 0.02, 0.35]), shown).moved(turn, sign + [0.0, y, 0.0])
        rods = [
            Box(
                sign + [0.0, y + s * 0.4, 0.5 * (HIGH_M[2] - sign[2])],
                np.array([0.01, 0.01, 0.5 * (HIGH_M[2] - sign[2])]),
                grey,
            )
            for s in (-1, 1)
        ]
        pieces.append(Piece((plate, *rods), 1.0, 0.04, 0.0).as_instance("sign"))
        obstacles.append(Box(sign + [0.0, y, 0.7], np.array([0.03, 0.5, 1.05]), grey))


def _skylight() -> list[AreaLight]:
    """Return area lights that approximate the many lamps of the roof."""
    points = np.array([[x, y, 6.2] for x in (-9.0, -3.0, 3.0, 9.0) for y in (-5.35, 5.35)])
    return [AreaLight(points, 4.0, np.array([0.0, 0.0, -1.0]))]


WAREHOUSE = WorldBuilder("a warehouse: aisles between high racks full of pallets, a loading area", layout)
"""The warehouse."""
