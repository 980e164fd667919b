"""World low-texture: an empty white gallery, whose walls, floor and ceiling have almost no texture."""

from functools import partial

import numpy as np

from dronevio.sim.appearance import pictures, textures, textures_building
from dronevio.sim.appearance.instances import single_instance
from dronevio.sim.appearance.lightmap import AreaLight
from dronevio.sim.appearance.solids import Box
from dronevio.sim.appearance.textures import Colour
from dronevio.sim.props.building import Wall, ceiling_lamp, hall_faces, landing_mat, room_walls, shading
from dronevio.sim.props.furniture import Piece, block
from dronevio.sim.worlds.layout import Layout, WorldBuilder

Random = np.random.Generator

LOW_M, HIGH_M = np.array([-5.0, -4.0, 0.0]), np.array([5.0, 4.0, 3.6])
"""Corners of the gallery [m]."""
_WHITE: Colour = (208, 207, 203)
_FLOOR: Colour = (186, 184, 178)
_PX_PER_M, _CEILING_PX_PER_M = 224.0, 128.0  # fine light maps, since soft shadows are the only structure
_ROUTE_M = np.array(
    [[0.0, 0.0, 1.2], [2.6, -1.6, 1.0], [2.6, 1.6, 1.8], [0.0, 0.3, 1.4], [-2.6, -1.6, 1.6], [-2.6, 1.6, 1.1]]
)


def layout(rng: Random) -> Layout:
    """Draw a white gallery."""
    white, pale = (partial(textures_building.whitewash, colour=colour) for colour in (_WHITE, _FLOOR))
    walls = room_walls(LOW_M, HIGH_M)
    pieces = [_skirting(wall) for wall in walls]
    obstacles: list[Box] = []
    order = [walls[int(i)] for i in rng.permutation(4)]
    pieces.append(order[0].put(_door(), float(rng.uniform(-1.5, 1.5))))
    pieces.append(order[1].put(_painting(rng), float(rng.uniform(-1.0, 1.0))))
    pieces.append(order[2].put(_high_window(), 0.0))
    for wall in order[1:]:
        for x in (-1.0, 1.0):
            piece = _plinth(rng)
            place = x * float(rng.uniform(0.22, 0.36)) * wall.length_m
            pieces.append(wall.put(piece, place, 0.12))
            obstacles.append(wall.hull(piece, place, 0.12))
    pieces += [ceiling_lamp(np.array([x, 0.0, HIGH_M[2]]), (0.3, 3.0), 1.0) for x in (-2.6, 0.0, 2.6)]
    boxes = [box for piece in pieces for box in piece.boxes]
    return Layout(
        low=LOW_M.copy(),
        high=HIGH_M.copy(),
        shell=hall_faces(LOW_M, HIGH_M, pale, white, [white] * 4, (_PX_PER_M, _PX_PER_M, _CEILING_PX_PER_M)),
        boxes=(*boxes, landing_mat(np.zeros(3))),
        obstacles=tuple(obstacles),
        lights=tuple(light for piece in pieces for light in piece.lights),
        pad=np.zeros(3),
        free_box=np.array([[-3.2, -2.2, 0.0], [3.2, 2.2, 2.8]]),
        route=_ROUTE_M.copy(),
        shading=shading(boxes),
    )


@single_instance
def _skirting(wall: Wall) -> Piece:
    """Return the shadow gap at the foot of a wall."""
    grey = partial(textures_building.whitewash, colour=(150, 149, 146))
    return wall.put(Piece((block(0.0, 0.006, 0.0, wall.length_m, 0.012, 0.06, grey),), wall.length_m, 0.012, 0.0), 0.0)


@single_instance
def _door() -> Piece:
    """Return a flush white door."""
    white = partial(textures_building.whitewash, colour=(196, 195, 191))
    dark = partial(textures.plain, colour=(70, 70, 72))
    boxes = [block(0.0, 0.012, 0.0, 1.0, 0.024, 2.2, white), block(0.4, 0.04, 1.02, 0.13, 0.03, 0.025, dark)]
    return Piece(tuple(boxes), 1.0, 0.06, 0.0)


@single_instance
def _painting(rng: Random) -> Piece:
    """Return the only picture in the gallery."""
    w, h = rng.uniform(0.9, 1.2), rng.uniform(0.7, 0.9)
    white = partial(textures_building.whitewash, colour=_WHITE)
    shown = pictures.PICTURES[int(rng.integers(len(pictures.PICTURES)))]
    return Piece((block(0.0, 0.02, 1.25, w, 0.04, h, white, shown),), w, 0.04, 0.0)


@single_instance
def _high_window() -> Piece:
    """Return a long window high up in the wall, of frosted glass."""
    glass = partial(textures_building.whitewash, colour=(236, 240, 244))
    w, z = 4.4, 2.7
    grid = np.array([[x, 0.06, z] for x in (-1.6, 0.0, 1.6)])
    light = AreaLight(grid, 1.6, np.array([0.0, 1.0, 0.0]))
    return Piece(
        (Box(np.array([0.0, 0.015, z]), np.array([0.5 * w, 0.015, 0.28]), glass, glow=1.0),),
        w,
        0.03,
        0.0,
        lights=(light,),
    )


@single_instance
def _plinth(rng: Random) -> Piece:
    """Return an empty white plinth."""
    side, tall = rng.uniform(0.35, 0.6), rng.uniform(0.45, 1.15)
    white = partial(textures_building.whitewash, colour=(204, 203, 199))
    return Piece((block(0.0, 0.5 * side, 0.0, side, side, tall, white),), side, side, tall)


LOW_TEXTURE = WorldBuilder("a white, nearly empty gallery: walls and floor without texture", layout, "hard")
"""The white gallery."""
