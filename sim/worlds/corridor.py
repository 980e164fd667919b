"""World corridor: one floor of an office building, a closed loop around a core, for loop closures.

Its four wings are built alike, and differ in their colours and in what stands along their walls.
"""

from collections.abc import Callable
from functools import partial
from itertools import pairwise

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.rotation import rotation_z
from dronevio.sim.appearance import textures, textures_building
from dronevio.sim.appearance.instances import Instance
from dronevio.sim.appearance.solids import Box, Face, Paint, parts_of
from dronevio.sim.appearance.textures import Colour
from dronevio.sim.props.building import (
    Wall,
    ceiling_lamp,
    coarse,
    landing_mat,
    level_face,
    room_walls,
    shading,
    stand_along,
)
from dronevio.sim.props.furniture import METAL, WOODS, Piece, block, pick, plant, window
from dronevio.sim.props.furniture_public import PUBLIC_FURNITURE, bench, vending_machine
from dronevio.sim.worlds.layout import Layout, WorldBuilder

Random = np.random.Generator

LOW_M, HIGH_M = np.array([-12.0, -7.0, 0.0]), np.array([12.0, 7.0, 2.9])
"""Corners of the floor [m]."""
CORE_M = np.array([9.2, 4.2])
"""(2,) Half the extent of the core that the corridor runs around [m]: it is 2.8 m wide."""
_NICHE_WIDTH_M, _NICHE_DEPTH_M = 2.2, 1.0
_MIDDLE_M = 0.5 * (HIGH_M[:2] + CORE_M)  # of the corridor, from the middle of the building
_PAD_M = np.array([0.0, -_MIDDLE_M[1], 0.0])
_LONGEST_M = 12.2  # longest wall in one texture; longer ones have two, with a pilaster between them
_WALL_PX_PER_M, _FLOOR_PX_PER_M, _CEILING_PX_PER_M, _THING_PX_PER_M = 172.0, 128.0, 96.0, 144.0

_PAINT: Colour = (206, 202, 188)
_DADOS: tuple[Colour, ...] = ((92, 122, 140), (150, 104, 76), (104, 132, 96), (146, 128, 84))
_STONES: tuple[Colour, ...] = ((166, 160, 148), (150, 152, 150), (170, 154, 134))


def layout(rng: Random) -> Layout:
    """Draw a corridor."""
    dados = [_DADOS[int(i)] for i in rng.permutation(4)]
    outer = room_walls(LOW_M, HIGH_M)
    core_low, core_high = np.array([*-CORE_M, 0.0]), np.array([*CORE_M, HIGH_M[2]])
    inner = tuple(  # the walls of the core face outward
        Wall(wall.middle, wall.turn_rad + np.pi, wall.length_m) for wall in room_walls(core_low, core_high)
    )
    painted = partial(textures_building.painted_wall, colour=_PAINT, px_per_m=_WALL_PX_PER_M)
    paints = [partial(painted, dado=dado) for dado in dados]
    shell: list[Face] = [*_floors(rng), *_ceilings()]
    pieces: list[Piece] = []
    obstacles: list[Box] = _core()
    niches = {0: _niche_places(rng), 2: _niche_places(rng)}
    for number, wall in enumerate(outer):
        shell += _wall_faces(wall, [], paints[number])
        pieces += _pilasters(wall)
        things, hulls = stand_along(rng, wall, _furniture(rng, windows=number == 2), _blocked(wall, []))
        pieces, obstacles = pieces + things, obstacles + hulls
    for number, wall in enumerate(inner):
        places = niches.get(number, [])
        shell += _wall_faces(wall, places, paints[number])
        shell += [face for x in places for face in _niche(wall, x, paints[number])]
        things, hulls = stand_along(rng, wall, _furniture(rng), _blocked(wall, places))
        pieces, obstacles = pieces + things, obstacles + hulls
        for x in places:
            _fill_niche(rng, wall, x, pieces, obstacles)
    fronts = [box for number, wall in enumerate(inner) for box in _core_front(wall, niches.get(number, []))]
    obstacles += fronts
    lamps = [ceiling_lamp(np.array([x, y, HIGH_M[2]]), size, 1.0) for x, y, size in _lamp_places()]
    pieces += lamps
    portals = _portals(rng)
    pieces += portals
    obstacles += [box for portal in portals for box in portal.boxes[:3]] + [*_trays()]
    boxes = coarse([box for piece in pieces for box in piece.boxes], _THING_PX_PER_M)
    return Layout(
        low=LOW_M.copy(),
        high=HIGH_M.copy(),
        shell=tuple(shell),
        boxes=(*boxes, *coarse(_trays(), 128.0), landing_mat(_PAD_M)),
        obstacles=tuple(obstacles),
        lights=tuple(light for piece in pieces for light in piece.lights),
        pad=_PAD_M.copy(),
        free_box=np.array([[-8.5, -_MIDDLE_M[1] - 0.5, 0.0], [8.5, -_MIDDLE_M[1] + 0.5, 2.2]]),
        route=_route(),
        shading=(*_core(), *fronts, *shading(boxes)),
        filling=(*_core(), *fronts),
    )


def _route() -> Array:
    """Return a lap through the middle of the corridor, at changing height."""
    x, y = _MIDDLE_M
    lap = [(0, -1, 1.2), (0.5, -1, 1.0), (1, -1, 1.4), (1, 0, 1.7), (1, 1, 1.3), (0, 1, 1.0)]
    lap += [(-1, 1, 1.5), (-1, 0, 1.2), (-1, -1, 1.5), (-0.5, -1, 1.1)]
    return np.array([(u * x, v * y, z) for u, v, z in lap])


def _strips() -> list[tuple[Array, Array]]:
    """Return the corners (x, y) of the four stretches of floor: south, north, east, west [m]."""
    (x, y), (cx, cy) = HIGH_M[:2], CORE_M
    ends = (((-x, -y), (x, -cy)), ((-x, cy), (x, y)), ((cx, -cy), (x, cy)), ((-x, -cy), (-cx, cy)))
    return [(np.array(low), np.array(high)) for low, high in ends]


def _floors(rng: Random) -> tuple[Face, ...]:
    """Return the floor of the corridor, all of one stone."""
    stone = partial(textures_building.terrazzo, colour=pick(rng, _STONES), px_per_m=_FLOOR_PX_PER_M)
    faces = [level_face(low, high, 0.0, True, stone, _FLOOR_PX_PER_M) for low, high in _strips()]
    return parts_of(Instance("floor"), faces)


def _ceilings() -> tuple[Face, ...]:
    """Return the ceiling of the corridor."""
    panels = partial(textures_building.ceiling_panels, colour=(206, 206, 200), px_per_m=_CEILING_PX_PER_M)
    faces = [level_face(low, high, HIGH_M[2], False, panels, _CEILING_PX_PER_M) for low, high in _strips()]
    return parts_of(Instance("ceiling"), faces)


def _niche_places(rng: Random) -> list[float]:
    """Return where the two niches of a long wall of the core are, along it [m]."""
    return [float(rng.uniform(-6.5, -2.5)), float(rng.uniform(2.5, 6.5))]


def _wall_faces(wall: Wall, niches: list[float], paint: Paint) -> tuple[Face, ...]:
    """Return the faces of a wall between its niches."""
    half = 0.5 * wall.length_m
    edges = [-half, *(x + s * 0.5 * _NICHE_WIDTH_M for x in sorted(niches) for s in (-1, 1)), half]
    faces = []
    for a, b in zip(edges[::2], edges[1::2], strict=True):
        cuts = [a, b] if b - a < _LONGEST_M else [a, 0.5 * (a + b), b]
        faces += [_panel(wall, (q, 0.0), (p, 0.0), paint) for p, q in pairwise(cuts)]
    return parts_of(Instance("wall"), faces)


def _panel(wall: Wall, left: tuple[float, float], right: tuple[float, float], paint: Paint) -> Face:
    """Return a painted face of a wall from floor to ceiling."""
    return wall.face(left, right, float(HIGH_M[2]), paint, _WALL_PX_PER_M)


def _niche(wall: Wall, x: float, paint: Paint) -> tuple[Face, ...]:
    """Return the inside of a niche: its back, its sides, its floor and its ceiling."""
    a, b, d = x - 0.5 * _NICHE_WIDTH_M, x + 0.5 * _NICHE_WIDTH_M, -_NICHE_DEPTH_M
    corners = np.stack([wall.at(a, d, 0.0), wall.at(b, 0.0, 0.0)])[:, :2]
    low, high = corners.min(axis=0), corners.max(axis=0)
    wood = partial(textures.planks, colour=(150, 112, 74))
    white = partial(textures.plain, colour=(206, 206, 200))
    faces = [
        _panel(wall, (b, d), (a, d), paint),
        _panel(wall, (a, d), (a, 0.0), paint),
        _panel(wall, (b, 0.0), (b, d), paint),
        level_face(low, high, 0.0, True, wood, _FLOOR_PX_PER_M),
        level_face(low, high, HIGH_M[2], False, white, _CEILING_PX_PER_M),
    ]
    return parts_of(Instance("niche"), faces)


def _solid(centre: Array, size: Array) -> Box:
    """Return a collision box."""
    return Box(centre, 0.5 * size, partial(textures.plain, colour=METAL))


def _core() -> list[Box]:
    """Return the core without the layer that the niches are cut into."""
    size = np.array([2.0 * CORE_M[0], 2.0 * (CORE_M[1] - _NICHE_DEPTH_M), HIGH_M[2]])
    return [_solid(np.array([0.0, 0.0, 0.5 * HIGH_M[2]]), size)]


def _core_front(wall: Wall, niches: list[float]) -> list[Box]:
    """Return the collision boxes between the niches of a wall."""
    if not niches:
        return []
    half = 0.5 * wall.length_m
    edges = [-half, *(x + s * 0.5 * _NICHE_WIDTH_M for x in sorted(niches) for s in (-1, 1)), half]
    return [
        _solid(
            wall.at(0.5 * (a + b), -0.5 * _NICHE_DEPTH_M, 0.5 * HIGH_M[2]), np.array([b - a, _NICHE_DEPTH_M, HIGH_M[2]])
        )
        for a, b in zip(edges[::2], edges[1::2], strict=True)
    ]


def _furniture(rng: Random, windows: bool = False) -> list[Callable[[Random], Piece]]:
    """Return shuffled furniture of a wall; every third piece is a window if the wall has windows."""
    makers = [PUBLIC_FURNITURE[int(i)] for i in rng.permutation(len(PUBLIC_FURNITURE))]
    return [window if windows and k % 3 == 1 else make for k, make in enumerate(makers)]


def _blocked(wall: Wall, niches: list[float]) -> list[tuple[float, float]]:
    """Return the positions along a wall and half widths where nothing can stand: niches and the pilaster [m]."""
    pilaster = [(0.0, 0.3)] if wall.length_m > _LONGEST_M else []
    return [(x, 0.5 * _NICHE_WIDTH_M + 0.1) for x in niches] + pilaster


def _fill_niche(rng: Random, wall: Wall, x: float, pieces: list[Piece], obstacles: list[Box]) -> None:
    """Add a machine and a plant, or a bench, in a niche."""
    machine = rng.random() < 0.6
    things = [(vending_machine(rng), -0.5), (plant(rng), 0.6)] if machine else [(bench(rng), 0.0)]
    for piece, aside in things:
        pieces.append(wall.put(piece, x + aside, -_NICHE_DEPTH_M + 0.02))
        obstacles.append(wall.hull(piece, x + aside, -_NICHE_DEPTH_M + 0.02))
    pieces.append(ceiling_lamp(wall.at(x, -0.5 * _NICHE_DEPTH_M, HIGH_M[2]), (0.5, 0.5), 0.6))


def _pilasters(wall: Wall) -> list[Piece]:
    """Return the pilaster over the joint in the middle of a long wall."""
    white = partial(textures.plaster, colour=(196, 190, 176))
    cover = Piece((block(0.0, 0.06, 0.0, 0.36, 0.12, HIGH_M[2], white),), 0.36, 0.12, HIGH_M[2])
    return [wall.put(cover.as_instance("pilaster"), 0.0)]


def _lamp_places() -> list[tuple[float, float, tuple[float, float]]]:
    """Return where lamps hang: x, y and size along both [m]."""
    x, y = _MIDDLE_M
    along_x = [(float(u), s * y, (1.2, 0.3)) for u in np.linspace(-9.0, 9.0, 7) for s in (-1, 1)]
    along_y = [(s * x, float(v), (0.3, 1.2)) for v in (-3.0, 0.0, 3.0) for s in (-1, 1)]
    return along_x + along_y


def _portals(rng: Random) -> list[Piece]:
    """Return the frames that the fire doors of the four wings hang in, with lit signs above."""
    steel = partial(textures.wood, colour=pick(rng, WOODS))
    sign = textures_building.exit_sign
    dark = partial(textures.plain, colour=(40, 44, 42))
    portals = []
    (mx, my), width = _MIDDLE_M, float(HIGH_M[1] - CORE_M[1])
    for x, y, turn in (
        (5.6, -my, 0.5),
        (-5.6, -my, 0.5),
        (6.4, my, 0.5),
        (-6.4, my, 0.5),
        (mx, 1.4, 0.0),
        (-mx, -1.4, 0.0),
    ):
        wall = Wall(np.array([x, y, 0.0]), turn * np.pi, width)
        boxes = [block(0.0, 0.0, 2.52, width, 0.22, HIGH_M[2] - 2.52, steel)]
        boxes += [block(s * (0.5 * width - 0.06), 0.0, 0.0, 0.12, 0.22, 2.52, steel) for s in (-1, 1)]
        lit = Box(np.array([0.0, 0.13, 2.7]), np.array([0.24, 0.02, 0.1]), dark, sign, glow=0.9)
        boxes += [lit, lit.moved(rotation_z(np.pi), np.zeros(3))]
        portals.append(wall.put(Piece(tuple(boxes), width, 0.22, HIGH_M[2]).as_instance("portal"), 0.0))
    return portals


def _trays() -> tuple[Box, ...]:
    """Return the tray of cables that runs along the outer walls under the ceiling."""
    steel = partial(textures_building.sheet_metal, colour=(150, 150, 148), px_per_m=128.0, rib_m=0.12)
    (x, y, z) = HIGH_M
    boxes = [Box(np.array([0.0, s * (y - 0.16), z - 0.2]), np.array([x - 0.02, 0.11, 0.05]), steel) for s in (-1, 1)]
    boxes += [Box(np.array([s * (x - 0.16), 0.0, z - 0.2]), np.array([0.11, y - 0.3, 0.05]), steel) for s in (-1, 1)]
    return parts_of(Instance("cable_tray"), boxes)


CORRIDOR = WorldBuilder("a closed office corridor of 65 m around a core: made for closing loops", layout)
"""The corridor."""
