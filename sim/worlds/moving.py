"""World moving: a concourse with walking people, rolling carts and swinging banners."""

from functools import partial

import cv2
import numpy as np

from dronevio.models.arrays import Image
from dronevio.models.rotation import rotation_z
from dronevio.sim.appearance import textures, textures_building
from dronevio.sim.appearance.solids import Box
from dronevio.sim.appearance.textures import Colour, scaled
from dronevio.sim.props.building import ceiling_lamp, coarse, hall_faces, landing_mat, room_walls, shading, stand_along
from dronevio.sim.props.furniture import METAL, Piece, pick
from dronevio.sim.props.furniture_public import PUBLIC_FURNITURE
from dronevio.sim.props.traffic import Lap, Swing, banner, cart, person
from dronevio.sim.worlds.layout import Layout, MovingObject, WorldBuilder

Random = np.random.Generator

LOW_M, HIGH_M = np.array([-8.0, -6.3, 0.0]), np.array([8.0, 6.3, 4.8])
"""Corners of the concourse [m]."""
_INNER_M, _OUTER_M = np.array([4.2, 2.6]), np.array([6.3, 4.7])  # half extents of the edges of the lane
_TALLEST_M = 2.1
_FLOOR_PX_PER_M, _WALL_PX_PER_M, _CEILING_PX_PER_M, _THING_PX_PER_M = 120.0, 128.0, 72.0, 128.0
_PEOPLE, _WITH_CARTS = 8, 4  # on the inner and on the outer track
_WALK_M_S, _ROLL_M_S = 1.2, 0.9
_BANNER_M, _BANNER_SWING_RAD, _BANNER_TOP_M = (2.2, 2.0), 0.3, 4.7
_STONES: tuple[Colour, ...] = ((168, 160, 146), (150, 152, 152), (172, 156, 134))
_DADOS: tuple[Colour, ...] = ((92, 122, 140), (150, 104, 76), (104, 132, 96), (146, 128, 84))
_ROUTE_M = np.array(
    [[0.0, 0.0, 1.2], [3.4, -1.8, 1.0], [3.4, 1.8, 1.7], [0.0, 0.3, 1.3], [-3.4, -1.8, 1.5], [-3.4, 1.8, 1.1]]
)


def layout(rng: Random) -> Layout:
    """Draw a busy concourse."""
    floor = partial(_floor, colour=pick(rng, _STONES))
    painted = partial(textures_building.painted_wall, colour=(206, 200, 184), px_per_m=_WALL_PX_PER_M)
    walls = [partial(painted, dado=_DADOS[int(i)]) for i in rng.permutation(4)]
    ceiling = partial(textures_building.ceiling_panels, colour=(204, 204, 198), px_per_m=_CEILING_PX_PER_M)
    density = (_FLOOR_PX_PER_M, _WALL_PX_PER_M, _CEILING_PX_PER_M)
    pieces: list[Piece] = []
    obstacles: list[Box] = []
    for wall in room_walls(LOW_M, HIGH_M):
        makers = [PUBLIC_FURNITURE[int(i)] for i in rng.permutation(len(PUBLIC_FURNITURE))]
        things, hulls = stand_along(rng, wall, makers, margin_m=0.9)
        pieces, obstacles = pieces + things, obstacles + hulls
    for x in (-5.4, -1.8, 1.8, 5.4):
        pieces += [ceiling_lamp(np.array([x, y, HIGH_M[2]]), (1.2, 0.6), 1.0) for y in (-4.2, 0.0, 4.2)]
    boxes = coarse([box for piece in pieces for box in piece.boxes], _THING_PX_PER_M)
    return Layout(
        low=LOW_M.copy(),
        high=HIGH_M.copy(),
        shell=hall_faces(LOW_M, HIGH_M, floor, ceiling, walls, density),
        boxes=(*boxes, landing_mat(np.zeros(3))),
        obstacles=tuple(obstacles),
        lights=tuple(light for piece in pieces for light in piece.lights),
        pad=np.zeros(3),
        free_box=np.array([[-3.5, -1.9, 0.0], [3.5, 1.9, 3.2]]),
        route=_ROUTE_M.copy(),
        shading=shading(boxes),
        moving=_traffic(rng),
        lanes=_lanes(),
    )


def _traffic(rng: Random) -> tuple[MovingObject, ...]:
    """Return people who walk in one direction, carts that roll in the other outside of them, and banners above."""
    things = []
    width = _OUTER_M - _INNER_M
    inner, outer = (tuple((_INNER_M + share * width).tolist()) for share in (0.27, 0.73))
    for k in range(_PEOPLE):
        start = (k + rng.uniform(-0.2, 0.2)) / _PEOPLE
        things.append(MovingObject(f"person_{k}", person(rng), Lap(inner, 0.9, start, _WALK_M_S, bob_m=0.02)))
    for k in range(2 * _WITH_CARTS):
        start, turn = (k + rng.uniform(-0.2, 0.2)) / (2 * _WITH_CARTS), -_ROLL_M_S
        if k % 2:
            things.append(MovingObject(f"cart_{k // 2}", cart(rng), Lap(outer, 0.9, start, turn)))
        else:
            walker = Lap(outer, 0.9, start, turn, bob_m=0.02)
            things.append(MovingObject(f"person_{_PEOPLE + k // 2}", person(rng), walker))
    for k, (x, y, heading) in enumerate(_banner_places()):
        swing = Swing((x, y, _BANNER_TOP_M), heading, _BANNER_SWING_RAD, rng.uniform(2.8, 3.6), rng.uniform(0.0, 6.0))
        things.append(MovingObject(f"banner_{k}", banner(rng, *_BANNER_M), swing))
    return tuple(things)


def _banner_places() -> list[tuple[float, float, float]]:
    """Return the positions of the banners above the lane: x, y and the heading of their long side."""
    x, y = 0.5 * (_INNER_M + _OUTER_M)
    along_x = [(s * 2.4, t * y, 0.0) for s in (-1.0, 1.0) for t in (-1.0, 1.0)]
    return along_x + [(s * x, 0.0, 0.5 * np.pi) for s in (-1.0, 1.0)]


def _lanes() -> tuple[Box, ...]:
    """Return the four sections of the lane of people and carts, and the volumes of the banners above it."""
    grey = partial(textures.plain, colour=METAL)
    middle, half = 0.5 * (_INNER_M + _OUTER_M), 0.5 * (_OUTER_M - _INNER_M)
    boxes = []
    for s in (-1.0, 1.0):
        size = np.array([_OUTER_M[0], half[1], 0.5 * _TALLEST_M])
        boxes.append(Box(np.array([0.0, s * middle[1], size[2]]), size, grey))
        size = np.array([half[0], _OUTER_M[1], 0.5 * _TALLEST_M])
        boxes.append(Box(np.array([s * middle[0], 0.0, size[2]]), size, grey))
    drop = _BANNER_M[1] + 0.4
    for x, y, heading in _banner_places():
        size = np.array([0.5 * _BANNER_M[0] + 0.1, drop * np.sin(_BANNER_SWING_RAD) + 0.1, 0.5 * drop])
        turned = Box(np.zeros(3), size, grey).moved(rotation_z(heading), np.array([x, y, _BANNER_TOP_M - size[2]]))
        boxes.append(turned)
    return tuple(boxes)


def _floor(rng: Random, height: int, width: int, colour: Colour) -> Image:
    """Return terrazzo with the edges of the lane laid in brass and dark stone."""
    image = textures_building.terrazzo(rng, height, width, colour, _FLOOR_PX_PER_M)
    for edge in (_INNER_M, _OUTER_M):
        a, b = (tuple(((HIGH_M[:2] + s * edge) * _FLOOR_PX_PER_M).astype(int).tolist()) for s in (-1.0, 1.0))
        cv2.rectangle(image, a, b, scaled(colour, 0.45), round(0.16 * _FLOOR_PX_PER_M))
        cv2.rectangle(image, a, b, (182, 150, 84), round(0.03 * _FLOOR_PX_PER_M))
    return image


MOVING = WorldBuilder("a concourse with walking people, rolling carts and swinging banners", layout, "hard")
"""The concourse."""
