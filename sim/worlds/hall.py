"""World hall: machines, tanks, pipes and crates under a crane, lanes painted on the floor, high windows."""

from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import cv2
import numpy as np

from dronevio.models.arrays import Image
from dronevio.models.rotation import rotation_z
from dronevio.sim.appearance import pictures
from dronevio.sim.appearance import textures_building as building
from dronevio.sim.appearance import textures_industrial as works
from dronevio.sim.appearance import textures_nature as nature
from dronevio.sim.appearance.instances import Instance
from dronevio.sim.appearance.lightmap import AreaLight
from dronevio.sim.appearance.solids import Box, Face, Surface, enclosure, parts_of
from dronevio.sim.appearance.textures import Colour, scaled, vary
from dronevio.sim.props import machinery
from dronevio.sim.props.machinery import Kit, block, pipe_run, steel
from dronevio.sim.worlds import outdoors
from dronevio.sim.worlds.layout import Layout, WorldBuilder

Random = np.random.Generator

_SIZE_M = np.array([28.0, 16.0, 9.5])
_HALF_M = 0.5 * _SIZE_M[:2]
_FREE_BOX_M = np.array([[-5.6, -2.3, 0.0], [5.6, 2.3, 4.8]])
_ROUTE_M = np.array(
    [
        [0.0, 0.0, 1.5],
        [5.2, -1.2, 1.2],
        [7.2, -2.9, 1.5],
        [12.5, -3.0, 2.0],
        [12.5, 2.9, 3.2],
        [7.0, 2.8, 4.0],
        [4.5, 5.1, 4.7],
        [-6.0, 5.0, 4.8],
        [-8.6, 2.6, 2.4],
        [-9.0, -0.2, 1.2],
        [-8.6, -2.9, 2.0],
        [-6.4, -4.4, 5.3],
        [4.6, -4.5, 5.4],
        [6.2, -1.6, 3.4],
    ]
)
_JITTER_M = np.array([0.25, 0.2, 0.2])
_FLOOR_PX_PER_M, _WALL_PX_PER_M, _ROOF_PX_PER_M = 147.0, 80.0, 56.0
_PAD_M = 1.0
_BAY_M = 4.6  # distance between pillars
_LAMP_Z_M = 8.2
_CRANE_Z_M = 7.3


@dataclass(frozen=True)
class _Palette:
    """Colours of a hall."""

    brick: Colour
    dado: Colour
    floor: Colour
    iron: Colour


_PALETTES: tuple[_Palette, ...] = (
    _Palette((150, 98, 78), (104, 140, 126), (136, 134, 128), (92, 112, 106)),
    _Palette((176, 168, 152), (96, 124, 150), (118, 134, 122), (150, 104, 68)),
    _Palette((168, 136, 106), (150, 140, 110), (142, 132, 124), (86, 100, 120)),
    _Palette((132, 120, 112), (150, 96, 72), (126, 128, 132), (110, 116, 118)),
)


def layout(rng: Random) -> Layout:
    """Draw a machine hall."""
    palette = _PALETTES[int(rng.integers(len(_PALETTES)))]
    route = _ROUTE_M + np.vstack([np.zeros(3), rng.uniform(-1.0, 1.0, (len(_ROUTE_M) - 1, 3)) * _JITTER_M])
    kits = [*_machines(rng), *_tanks(rng), *_stores(rng), *_overhead(rng)]
    walls, glass, lights = _windows(rng)
    lamps, shining = _lamps()
    frame, trusses = _structure(palette)
    boxes = [box for kit in kits for box in kit.boxes]
    sheets = tuple(sheet for kit in kits for sheet in kit.sheets)
    obstacles = [box for kit in kits for box in kit.obstacles]
    obstacles += [*frame, *(machinery.around(truss) for truss in trusses), *lamps]
    shading = tuple(box for box in obstacles if np.sort(box.half)[1] > 0.15 and box.centre[2] < _LAMP_Z_M - 0.2)
    structure = (*frame, *(box for truss in trusses for box in truss))
    return Layout(
        low=np.array([-_HALF_M[0], -_HALF_M[1], 0.0]),
        high=np.array([_HALF_M[0], _HALF_M[1], _SIZE_M[2]]),
        shell=(*_shell(palette), *sheets),
        boxes=(*boxes, *structure, *walls, *glass, *lamps),
        obstacles=tuple(obstacles),
        lights=(*lights, *shining),
        pad=np.zeros(3),
        free_box=_FREE_BOX_M.copy(),
        route=route,
        shading=shading,
        filling=tuple(box for kit in kits for box in kit.filling),
    )


def _shell(palette: _Palette) -> tuple[Surface, ...]:
    """Return floor, roof and walls, seen from inside."""
    x, y, z = np.diag(_SIZE_M)
    corner = -0.5 * (x + y)
    wall = partial(works.masonry, colour=palette.brick, dado=palette.dado, ppm=_WALL_PX_PER_M)
    roof = partial(works.profiled_roof, colour=(128, 130, 128), ppm=_ROOF_PX_PER_M)
    faces = (
        Face(corner + y, x, -y, partial(_floor, palette=palette), pixels_per_m=_FLOOR_PX_PER_M),
        Face(corner + z, x, y, roof, pixels_per_m=_ROOF_PX_PER_M),
        Face(corner + x + z, -x, -z, wall, pixels_per_m=_WALL_PX_PER_M),
        Face(corner + x + y + z, -y, -z, wall, pixels_per_m=_WALL_PX_PER_M),
        Face(corner + y + z, x, -z, wall, pixels_per_m=_WALL_PX_PER_M),
        Face(corner + z, y, -z, wall, pixels_per_m=_WALL_PX_PER_M),
    )
    return enclosure(faces)


def _floor(rng: Random, height: int, width: int, palette: _Palette) -> Image:
    """Return the floor: concrete, lanes and stands painted on it, worn; the pad."""
    ppm = _FLOOR_PX_PER_M
    bare = works.concrete_floor(rng, height, width, palette.floor, ppm)
    image = bare.copy()
    yellow, white = scaled(works.YELLOW, 0.92), (206, 204, 196)

    def at(x: float, y: float) -> tuple[int, int]:
        u, v = outdoors.on_ground(image, ppm, np.array([x, y, 0.0])).astype(int).tolist()
        return u, v

    for low, high, ink in (
        ((-7.2, -2.9), (7.2, 2.9), yellow),
        ((-6.6, 3.7), (6.4, 7.2), white),
        ((-7.0, -6.0), (6.6, -3.3), white),
        ((-13.4, -5.6), (-10.6, 4.4), yellow),
        ((8.0, -1.9), (12.0, 1.9), yellow),
    ):
        cv2.rectangle(image, at(*low), at(*high), ink, round(0.1 * ppm))
    for k in range(9):
        x = -7.1 + 0.55 * k
        cv2.rectangle(image, at(x - 3.2, -2.0), at(x - 2.92, 2.0), white, -1)
    for x, way in ((-3.4, 1.0), (3.4, -1.0)):
        for y in (-2.4, 2.4):
            cv2.arrowedLine(image, at(x - way, y), at(x + way, y), white, round(0.09 * ppm), cv2.LINE_AA, tipLength=0.3)
    for number, (x, y) in enumerate(((-6.2, 3.2), (-2.0, 3.2), (2.4, 3.2), (-6.2, -3.2), (5.4, -3.2))):
        size = 0.5 * ppm / 22.0
        cv2.putText(image, f"{number + 1:02d}", at(x, y - 0.2), cv2.FONT_HERSHEY_DUPLEX, size, yellow, 5, cv2.LINE_AA)
    worn = np.clip(nature.periodic_noise(rng, height // 12, width // 12, (1, 3, 8)) - 0.7, 0.0, 0.85)
    image = nature.mixed(image, bare, worn)
    outdoors.lay(image, pictures.landing_pad(round(_PAD_M * ppm)))
    return image


def _machines(rng: Random) -> list[Kit]:
    """Return the machines along the north side, which face south, and the turbine in the east."""
    machines = []
    widths = rng.dirichlet(np.full(4, 12.0)) * (12.6 - 3 * 0.8)
    left = -6.3
    for w in widths:
        made = machinery.machine(rng, float(w), rng.uniform(1.7, 2.2), rng.uniform(1.9, 2.9))
        machines.append(made.moved(rotation_z(np.pi), np.array([left + 0.5 * w, 5.4 + rng.uniform(-0.15, 0.15), 0.0])))
        left += w + 0.8
    machines.append(
        machinery.turbine(rng).moved(rotation_z(float(rng.choice([0.0, np.pi]))), np.array([10.0, 0.0, 0.0]))
    )
    machines += [machinery.cabinet(rng).moved(rotation_z(np.pi), np.array([x, 7.6, 0.0])) for x in (8.6, 9.8, -9.4)]
    machines.append(machinery.cabinet(rng).moved(rotation_z(0.5 * np.pi), np.array([13.6, -5.4, 0.0])))
    return machines


def _tanks(rng: Random) -> list[Kit]:
    """Return the tanks along the south side, and the pipes between them."""
    tanks = []
    tops = []
    places = np.array([-5.6, -2.6, 0.6, 4.2]) + rng.uniform(-0.25, 0.25, 4)
    for number, x in enumerate(places):
        r, h = rng.uniform(0.7, 0.98), rng.uniform(2.7, 3.9)
        tanks.append(machinery.tank(rng, r, h, number + 1).moved(np.eye(3), np.array([x, -4.7, 0.0])))
        tops.append((float(x), h))
    colour = machinery.PIPE_COLOURS[int(rng.integers(5))]
    for (x0, _), (x1, _) in pairwise(tops):
        tanks.append(pipe_run([(x0 + 0.5, -4.7, 0.24), (x1 - 0.5, -4.7, 0.24)], 0.11, colour))
    return tanks


def _stores(rng: Random) -> list[Kit]:
    """Return the stored goods in the west and in the corners."""
    stores = []
    for y in (-5.6, -3.8, -2.6, 2.8, 4.6):
        make = machinery.crates if rng.random() < 0.62 else machinery.drums
        where = np.array([-12.4 + rng.uniform(-0.2, 0.3), y + rng.uniform(-0.1, 0.1), 0.0])
        stores.append(make(rng).moved(rotation_z(rng.uniform(-0.15, 0.15)), where))
    for x, y in ((-12.6, 6.6), (12.7, 6.8), (11.0, 6.8), (12.8, -6.9)):
        make = machinery.crates if rng.random() < 0.5 else machinery.drums
        stores.append(make(rng).moved(rotation_z(rng.uniform(-0.2, 0.2)), np.array([x, y, 0.0])))
    return stores


def _overhead(rng: Random) -> list[Kit]:
    """Return the overhead structures: catwalk, crane, pipes and ducts along the walls."""
    inks = [machinery.PIPE_COLOURS[int(i)] for i in rng.permutation(5)]
    span = 2.0 * _HALF_M[1] - 0.7
    walk = machinery.catwalk(24.0, 3.6).moved(np.eye(3), np.array([0.0, -7.35, 0.0]))
    bridge = machinery.crane(rng, span, _CRANE_Z_M).moved(np.eye(3), np.array([rng.uniform(-6.0, 6.0), 0.0, 0.0]))
    x, y = 13.0, 7.75
    pipes = [
        pipe_run([(-x, y, z), (x, y, z)], r, ink)
        for z, r, ink in zip((4.1, 4.5, 4.85), (0.15, 0.1, 0.13), inks, strict=False)
    ]
    pipes.append(pipe_run([(-13.8, -7.0, 4.4), (-13.8, 7.0, 4.4)], 0.12, inks[3]))
    pipes.append(
        pipe_run([(13.75, 6.0, 0.0), (13.75, 6.0, 5.2), (13.75, -6.5, 5.2), (13.75, -6.5, 0.0)], 0.14, inks[4])
    )
    return [walk, bridge, *pipes]


def _structure(palette: _Palette) -> tuple[list[Box], list[tuple[Box, ...]]]:
    """Return pillars and crane rails, and the bars of each truss under the roof."""
    iron = steel(palette.iron)
    boxes: list[Box] = []
    trusses = []
    pillars = np.arange(-2.5, 2.6) * _BAY_M
    for s in (-1.0, 1.0):
        for x in pillars:
            pillar = block((x, s * (_HALF_M[1] - 0.16), 0.0), (0.34, 0.32, _SIZE_M[2]), iron, ppm=56.0)
            guard = block((x, s * (_HALF_M[1] - 0.34), 0.0), (0.36, 0.04, 1.6), works.hazard, ppm=72.0)
            boxes += parts_of(Instance("pillar"), (pillar, guard))
        rail = (0.0, s * (_HALF_M[1] - 0.5), _CRANE_Z_M - 0.34)
        boxes += parts_of(Instance("crane_rail"), [block(rail, (_SIZE_M[0] - 0.02, 0.24, 0.3), iron, ppm=56.0)])
    for x in pillars:
        bars = [block((x, 0.0, z), (0.14, _SIZE_M[1] - 0.7, 0.14), iron, ppm=40.0) for z in (8.55, 9.33)]
        for k in range(12):
            c, s = np.cos(0.53), np.sin(0.53) * (1.0 if k % 2 else -1.0)
            R = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
            middle = np.array([x, -6.6 + 1.2 * k, 9.01])
            bars.append(Box(middle, np.array([0.035, 0.64, 0.035]), iron, R=R, pixels_per_m=40.0))
        trusses.append(parts_of(Instance("truss"), bars))
    return boxes, trusses


def _windows(rng: Random) -> tuple[list[Box], list[Box], list[AreaLight]]:
    """Return wall-mounted objects, windows with emission, and the area lights of the windows."""
    glass, lights = [], []
    frame = steel((70, 78, 76))
    bays = np.arange(-2.0, 2.1) * _BAY_M
    bright = float(rng.choice([-1.0, 1.0]))
    for s in (-1.0, 1.0):
        for x in bays:
            middle = np.array([x, s * (_HALF_M[1] - 0.03), 6.1])
            R = rotation_z(0.0 if s < 0.0 else np.pi)
            half = np.array([1.75, 0.03, 0.85])
            glow = 0.97 if s == bright else 0.86
            glass.append(Box(middle, half, frame, works.panes, R, glow, 72.0, Instance("window")))
            grid = np.array([[x + dx, s * (_HALF_M[1] - 0.15), 6.1] for dx in (-0.9, 0.9)])
            lights.append(AreaLight(grid, 16.0 if s == bright else 4.0, np.array([0.0, -s, 0.0])))
    return _on_walls(rng), glass, lights


def _on_walls(rng: Random) -> list[Box]:
    """Return the objects on the end walls: a large door, signs, boards, fans."""
    frame = steel((70, 78, 76))
    number, ink = int(rng.integers(1, 10)), ((38, 74, 122), (140, 40, 36), (40, 92, 66))[int(rng.integers(3))]
    gate = partial(works.roller_door, colour=vary(rng, (96, 116, 136), 0.15), ppm=_WALL_PX_PER_M)
    name = partial(works.sign, colour=ink, words=f"HALL {number}")
    rule = partial(works.sign, colour=(206, 120, 30), words="KEEP LANES CLEAR")
    fan = partial(works.fan, colour=(118, 124, 126))
    boxes = []
    for kind, east, (y, z), (wide, high), paint in (
        ("roller_door", False, (0.0, 2.1), (4.4, 4.2), gate),
        ("sign", False, (0.0, 6.2), (4.6, 1.2), name),
        ("board", False, (5.2, 2.6), (2.2, 1.3), building.notice_board),
        ("sign", True, (0.0, 6.9), (4.6, 1.2), name),
        ("board", True, (2.3, 2.5), (2.4, 1.4), building.notice_board),
        ("sign", True, (-2.3, 2.7), (2.6, 0.6), rule),
        ("fan", True, (4.6, 7.0), (1.7, 1.7), fan),
        ("fan", True, (-4.6, 7.0), (1.7, 1.7), fan),
        ("fan", False, (5.2, 6.6), (1.7, 1.7), fan),
        ("fan", False, (-5.2, 6.6), (1.7, 1.7), fan),
    ):
        side = 1.0 if east else -1.0
        middle = np.array([side * (_HALF_M[0] - 0.03), y, z])
        half = np.array([0.5 * wide, 0.03, 0.5 * high])
        R = rotation_z(side * 0.5 * np.pi)
        boxes.append(Box(middle, half, frame, paint, R, pixels_per_m=96.0, instance=Instance(kind)))
    return boxes


def _lamps() -> tuple[list[Box], list[AreaLight]]:
    """Return the lamps under the roof and their area lights."""
    boxes, lights = [], []
    paint = partial(works.casing_plain, colour=(244, 240, 226))
    for x in np.arange(-2.0, 2.1) * _BAY_M:
        for y in (-3.6, 3.6):
            place, half = np.array([x, y, _LAMP_Z_M]), np.array([0.6, 0.16, 0.05])
            boxes.append(Box(place, half, paint, glow=1.0, pixels_per_m=64.0, instance=Instance("lamp")))
            lights.append(AreaLight(np.array([[x, y, _LAMP_Z_M - 0.1]]), 3.0, np.array([0.0, 0.0, -1.0])))
    return boxes, lights


HALL = WorldBuilder("machines, tanks, pipes and crates under a crane", layout)
"""The machine hall."""
