"""World mirror: the hall of a hotel with a polished, reflecting floor."""

from collections.abc import Callable
from functools import partial
from itertools import pairwise

import cv2
import numpy as np

from dronevio.models.arrays import Array, Image
from dronevio.sim.appearance import textures, textures_building
from dronevio.sim.appearance.instances import single_instance
from dronevio.sim.appearance.solids import Box
from dronevio.sim.appearance.textures import Colour, scaled
from dronevio.sim.props.building import ceiling_lamp, hall_faces, landing_mat, room_walls, shading, stand_along
from dronevio.sim.props.furniture import (
    WOODS,
    Piece,
    armchair,
    bookcase,
    hung_picture,
    pick,
    plant,
    room_door,
    sideboard,
    sofa,
    window,
)
from dronevio.sim.worlds.layout import Layout, Mirror, WorldBuilder

Random = np.random.Generator

LOW_M, HIGH_M = np.array([-6.0, -4.5, 0.0]), np.array([6.0, 4.5, 4.2])
"""Corners of the hall [m]."""
_REFLECTANCE = 0.45
_WALL_PX_PER_M, _FLOOR_PX_PER_M, _CEILING_PX_PER_M = 160.0, 160.0, 96.0
_STONES: tuple[Colour, ...] = ((96, 92, 88), (84, 94, 98), (104, 88, 80))
_PLASTERS: tuple[Colour, ...] = ((196, 178, 146), (170, 182, 172), (188, 166, 156))
_ROUTE_M = np.array(
    [[0.0, 0.0, 1.2], [3.4, -2.0, 1.0], [3.4, 2.0, 1.8], [0.0, 0.3, 0.9], [-3.4, -2.0, 1.6], [-3.4, 2.0, 1.1]]
)


def layout(rng: Random) -> Layout:
    """Draw the hall."""
    wood = pick(rng, WOODS)
    walls = [partial(_panelled, wood=wood, colour=pick(rng, _PLASTERS)) for _ in range(4)]
    ceiling = partial(_coffers, colour=(190, 178, 152))
    marble = partial(textures_building.marble, colour=pick(rng, _STONES), px_per_m=_FLOOR_PX_PER_M)
    floor, roof, *sides = hall_faces(
        LOW_M, HIGH_M, marble, ceiling, walls, (_FLOOR_PX_PER_M, _WALL_PX_PER_M, _CEILING_PX_PER_M)
    )
    pieces: list[Piece] = []
    obstacles: list[Box] = []
    bright = int(rng.integers(4))
    for number, wall in enumerate(room_walls(LOW_M, HIGH_M)):
        things, hulls = stand_along(rng, wall, _furniture(rng, bright == number), margin_m=1.05, gaps_m=(0.3, 0.9))
        pieces, obstacles = pieces + things, obstacles + hulls
    for x in (-3.6, 0.0, 3.6):
        for y in (-1.8, 1.8):
            lamp = _chandelier(np.array([x, y, HIGH_M[2]]))
            pieces.append(lamp)
            obstacles.append(_around(lamp))
    boxes = [box for piece in pieces for box in piece.boxes]
    return Layout(
        low=LOW_M.copy(),
        high=HIGH_M.copy(),
        shell=(roof, *sides),
        boxes=(*boxes, landing_mat(np.zeros(3))),
        obstacles=tuple(obstacles),
        lights=tuple(light for piece in pieces for light in piece.lights),
        pad=np.zeros(3),
        free_box=np.array([[-4.2, -2.8, 0.0], [4.2, 2.8, 2.8]]),
        route=_ROUTE_M.copy(),
        shading=shading(boxes),
        mirror=Mirror(floor, _REFLECTANCE),
    )


def _furniture(rng: Random, windows: bool) -> list[Callable[[Random], Piece]]:
    """Return the shuffled furniture along a wall."""
    makers = [sofa, plant, hung_picture, sideboard, armchair, room_door, bookcase, hung_picture]
    chosen = [makers[int(i)] for i in rng.permutation(len(makers))]
    return [window if windows and k % 2 == 0 else make for k, make in enumerate(chosen)]


def _panelled(rng: Random, height: int, width: int, wood: Colour, colour: Colour) -> Image:
    """Return a wall with wooden panels to the height of a chair, wallpaper above, a cornice at its top."""
    image = np.empty((height, width, 3), np.uint8)
    top, cornice = height - int(1.0 * _WALL_PX_PER_M), int(0.22 * _WALL_PX_PER_M)
    image[:top] = textures.stripes(rng, top, width, colour)
    panels = max(round(width / (0.9 * _WALL_PX_PER_M)), 1)
    edges = np.linspace(0, width, panels + 1).astype(int)
    for left, right in pairwise(edges):
        image[top:, left:right] = _panel(rng, height - top, right - left, wood)
    image[:cornice] = textures.plaster(rng, cornice, width, (206.0, 198.0, 182.0))
    for line, thick in ((cornice, 4), (top, 8)):
        image[line - thick : line] = image[line - thick : line] // 2
    return image


def _panel(rng: Random, height: int, width: int, wood: Colour) -> Image:
    """Return one panel of the wainscot: a frame around a raised field."""
    image = textures.wood(rng, height, width, wood)
    for inset, factor, thick in ((0.1, 0.45, 4), (0.13, 1.35, 2), (0.18, 0.6, 2)):
        a, b = (int(inset * width), int(inset * height)), (int((1 - inset) * width), int((1 - inset) * height))
        cv2.rectangle(image, a, b, scaled(wood, factor), thick, cv2.LINE_AA)
    image[:, :2] = image[:, :2] // 2
    return image


def _coffers(rng: Random, height: int, width: int, colour: Colour) -> Image:
    """Return a coffered ceiling."""
    image = textures.plaster(rng, height, width, colour)
    size = 1.0 * _CEILING_PX_PER_M
    for row in range(int(height / size)):
        for column in range(int(width / size)):
            for inset, factor in ((0.1, 0.55), (0.14, 0.85), (0.3, 0.7), (0.34, 0.95)):
                part = tuple(slice(int((k + inset) * size), int((k + 1 - inset) * size)) for k in (row, column))
                image[part] = textures.shade(
                    scaled(colour, factor),
                    textures.grain(rng, image[part].shape[0], image[part].shape[1], (1, 4, 12)),
                    0.05,
                )
    return image


@single_instance
def _chandelier(place: Array) -> Piece:
    """Return a lamp of three tiers on a rod, from a place (3,) on the ceiling."""
    brass = partial(textures.plain, colour=(176, 140, 70))
    shade = partial(textures.lampshade, colour=(246, 228, 190))
    lamp = ceiling_lamp(place, (0.4, 0.4), 1.2, drop_m=0.7)
    foot = place - [0.0, 0.0, 0.7]
    tiers = [Box(foot + [0.0, 0.0, z], np.array([w, w, 0.07]), shade, glow=0.95) for w, z in ((0.3, 0.12), (0.18, 0.3))]
    rings = [Box(foot + [0.0, 0.0, z], np.array([w, w, 0.02]), brass) for w, z in ((0.33, 0.03), (0.21, 0.21))]
    return Piece((*lamp.boxes, *tiers, *rings), 0.7, 0.7, 0.0, lights=lamp.lights)


def _around(lamp: Piece) -> Box:
    """Return the collision box from a lamp up to the ceiling."""
    widest = max(lamp.boxes, key=lambda box: float(box.half[0]))
    bottom = min(float(box.centre[2] - box.half[2]) for box in lamp.boxes)
    half = np.array([widest.half[0], widest.half[1], 0.5 * (HIGH_M[2] - bottom)])
    return Box(np.array([*widest.centre[:2], HIGH_M[2] - half[2]]), half, widest.paint)


MIRROR = WorldBuilder("the hall of a hotel with a polished, reflecting floor", layout, "hard")
"""World with a reflecting floor."""
