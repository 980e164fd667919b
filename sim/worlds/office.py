"""World office: a floor of rooms on both sides of a ring of corridors, and in its core, drawn from the seed.

Doors stand open, without leaves; two corridors end at a window. What stands and hangs in a room depends on its use.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from dronevio.models.arrays import Image
from dronevio.sim.appearance import textures, textures_building
from dronevio.sim.appearance.instances import Instance
from dronevio.sim.appearance.solids import Box, Face, Paint, parts_of
from dronevio.sim.appearance.textures import Colour
from dronevio.sim.props import furniture, furniture_public
from dronevio.sim.props.building import (
    Wall,
    ceiling_lamp,
    coarse,
    landing_mat,
    level_face,
    shading,
    stand_along,
)
from dronevio.sim.props.furniture import WOODS, Piece, block, pick
from dronevio.sim.props.glazing import glazing_frame, glazing_pane
from dronevio.sim.worlds.layout import Layout, WorldBuilder
from dronevio.sim.worlds.office_plan import (
    EAST,
    HIGH_M,
    LOW_M,
    WALL_M,
    WEST,
    WIDTH_M,
    Hallway,
    Plan,
    Room,
    along,
    drawn_plan,
)

Random = np.random.Generator
Makers = tuple[Callable[[Random], Piece], ...]
Stretch = tuple[float, float]
"""Begin and end along a wall [m]."""
Glazing = dict[tuple[int, int], bool]
"""The walls of glass by number of the room and side, and whether they are marked by stripes."""

_WALL_PX_PER_M, _FLOOR_PX_PER_M, _CEILING_PX_PER_M, _THING_PX_PER_M = 128.0, 96.0, 80.0, 112.0
_JAMB_M, _CASING_M, _HEAD_M = 0.06, 0.02, 2.1  # door frames: thickness, protrusion from the wall, clear height
_PLAY_M = 2e-3  # by which doors are wider than stated, so that their middle keeps half their width of clearance
_ASIDE_M = 0.16  # from the clear width of a door to what stands beside it
_TILE_M = 0.5  # squares of carpet
_PIER_M, _NARROWEST_M = 0.25, 0.6  # masonry at the ends of walls of glass, and the narrowest window
_CORNER_M = 1.0  # of a wall where the things along the next one stand

_WHITE: Colour = (208, 207, 203)
_CORRIDOR: Colour = (204, 200, 188)
_PALE: tuple[Colour, ...] = ((198, 194, 178), (182, 194, 198), (196, 186, 168), (186, 196, 178), (200, 190, 186))
_DADOS: tuple[Colour, ...] = ((92, 122, 140), (150, 104, 76), (104, 132, 96), (146, 128, 84), (118, 104, 130))
_CARPETS: tuple[Colour, ...] = ((92, 104, 122), (122, 96, 84), (98, 110, 92), (112, 108, 112))
_STONES: tuple[Colour, ...] = ((166, 160, 148), (150, 152, 150), (170, 154, 134))

_WORK: Makers = (
    furniture.desk,
    furniture.window,
    furniture.desk,
    furniture.bookcase,
    furniture_public.board,
    furniture.desk,
    furniture.plant,
)
_STORE: Makers = (
    furniture.bookcase,
    furniture.cartons,
    furniture.wardrobe,
    furniture_public.locker_row,
    furniture.cartons,
)
_KITCHEN: Makers = (
    furniture_public.vending_machine,
    furniture.sideboard,
    furniture.window,
    furniture_public.water_cooler,
    furniture.plant,
    furniture_public.posters,
)
_LOUNGE: Makers = (
    furniture.sofa,
    furniture.window,
    furniture.media_unit,
    furniture.armchair,
    furniture.plant,
    furniture.sideboard,
    furniture.floor_lamp,
)
_COPIES: Makers = (
    furniture_public.copier,
    furniture_public.board,
    furniture.desk,
    furniture.window,
    furniture.wardrobe,
    furniture_public.posters,
)
_USES = (_WORK, _LOUNGE, _WORK, _STORE, _WORK, _KITCHEN, _COPIES)
_HALLWAY: Makers = (
    furniture_public.board,
    furniture.hung_picture,
    furniture_public.posters,
    furniture_public.water_cooler,
    furniture_public.hose_cabinet,
    furniture_public.locker_row,
    furniture.hung_picture,
)


@dataclass(frozen=True, eq=False)
class _Paints:
    """What covers the surfaces of the corridors and the rooms."""

    walls: tuple[Paint, ...]
    """Of the walls of each room, in their order, and at last of the corridors."""
    floors: tuple[Paint, ...]
    """Of the floors in the same order."""
    frames: Paint
    """Of the frames of doors."""


def layout(rng: Random, door_m: float = 1.2, white: bool = False, glass: bool = False) -> Layout:
    """Draw an office.

    Args:
        rng: Draws the plan and what stands in it.
        door_m: Clear width of the doors [m]; the route enters rooms if it keeps its clearance in them.
        white: Whether all walls are white, without texture, and nothing hangs on those of the corridors.
        glass: Whether half the walls between corridors and rooms are of glass, which is solid and not seen. Nothing
            stands along them, and every second one has stripes.
    """
    plan = drawn_plan(rng)
    paints = _paints(rng, len(plan.rooms), white)
    glazed = _drawn_glazing(rng, plan) if glass else {}
    pieces: list[Piece] = []
    obstacles: list[Box] = []
    first = int(rng.integers(len(_USES)))
    for number, room in enumerate(plan.rooms):
        things, hulls = _furnished(
            rng, plan, room, _USES[(first + number) % len(_USES)], door_m, [side for k, side in glazed if k == number]
        )
        pieces, obstacles = pieces + things, obstacles + hulls
    for stub in plan.stubs:
        end = stub.wall(stub.facades[0])
        for piece, x in ((furniture.window(rng), -0.15), (furniture.plant(rng), 0.72)):
            pieces.append(end.put(piece, x))
            obstacles.append(end.hull(piece, x))
    for hallway in () if white else plan.hallways:
        things, hulls = _decorated(rng, plan, hallway, door_m, glazed)
        pieces, obstacles = pieces + things, obstacles + hulls
    pieces += [ceiling_lamp(np.array([*place, HIGH_M[2]]), size, 1.0) for place, size in plan.lamps]
    walls, panes = _walls(plan, paints, door_m, glazed)
    boxes = coarse([box for piece in pieces for box in piece.boxes], _THING_PX_PER_M)
    return Layout(
        low=LOW_M.copy(),
        high=HIGH_M.copy(),
        shell=_shell(plan, paints),
        boxes=(*walls, *boxes, landing_mat(plan.pad)),
        obstacles=tuple(obstacles),
        lights=tuple(light for piece in pieces for light in piece.lights),
        pad=plan.pad.copy(),
        free_box=np.stack([plan.pad - [0.5, 2.6, 0.0], plan.pad + [0.5, 2.6, 2.2]]),
        route=plan.route(door_m),
        shading=(*(box for box in walls if box.half.max() > 0.4), *shading(boxes)),
        filling=panes,
    )


def _paints(rng: Random, rooms: int, white: bool) -> _Paints:
    """Draw what covers walls and floors."""
    painted = partial(textures_building.painted_wall, px_per_m=_WALL_PX_PER_M)
    floors: list[Paint] = []
    walls: list[Paint] = []
    for number in range(rooms):
        colour, kind = pick(rng, _PALE), int(rng.integers(3))
        carpet, boards = pick(rng, _CARPETS), pick(rng, WOODS)
        patterns: tuple[Paint, ...] = (
            partial(painted, colour=colour, dado=pick(rng, _DADOS)),
            partial(textures.wallpaper, colour=colour),
            partial(textures.stripes, colour=colour),
        )
        walls.append(patterns[kind])
        floors.append(partial(textures.parquet, colour=boards) if number % 3 == 2 else partial(_carpet, colour=carpet))
    walls.append(partial(painted, colour=_CORRIDOR, dado=pick(rng, _DADOS)))
    floors.append(partial(textures_building.terrazzo, colour=pick(rng, _STONES), px_per_m=_FLOOR_PX_PER_M))
    if white:
        walls = [partial(textures_building.whitewash, colour=_WHITE)] * len(walls)
    return _Paints(tuple(walls), tuple(floors), partial(textures.wood, colour=pick(rng, WOODS)))


def _carpet(rng: Random, height: int, width: int, colour: Colour) -> Image:
    """Return squares of carpet, laid crosswise in turn."""
    side = round(_TILE_M * _FLOOR_PX_PER_M)
    image = textures.fabric(rng, height, width, colour)
    rows, columns = np.arange(height) // side, np.arange(width) // side
    tone = rng.uniform(0.86, 1.08, (rows[-1] + 1, columns[-1] + 1)).astype(np.float32)
    return textures.speckle(rng, textures.to_image(image * tone[rows][:, columns][..., None]), 0.06)


def _shell(plan: Plan, paints: _Paints) -> tuple[Face, ...]:
    """Return floors, ceilings and facades; floors extend below the walls around them."""
    faces: list[Face] = []
    whole_floor, whole_ceiling = Instance("floor"), Instance("ceiling")
    white = partial(textures_building.ceiling_panels, colour=(206, 206, 200), px_per_m=_CEILING_PX_PER_M)
    corridor = len(plan.rooms)
    grounds = [(room, number) for number, room in enumerate(plan.rooms)]
    grounds += [(stub, corridor) for stub in (*plan.stubs, *plan.ring)]
    for area, number in grounds:
        high = area.high + [WALL_M if number < corridor and EAST not in area.facades else 0.0, 0.0]
        floor = level_face(area.low, high, 0.0, True, paints.floors[number], _FLOOR_PX_PER_M)
        ceiling = level_face(area.low, high, float(HIGH_M[2]), False, white, _CEILING_PX_PER_M)
        faces += [replace(floor, instance=whole_floor), replace(ceiling, instance=whole_ceiling)]
    facades = [(area.wall(side), number) for area, number in grounds for side in area.facades]
    facades += [(hallway.wall, corridor) for hallway in plan.hallways if hallway.facade]
    for wall, number in facades:
        half = 0.5 * wall.length_m
        panel = wall.face((half, 0.0), (-half, 0.0), float(HIGH_M[2]), paints.walls[number], _WALL_PX_PER_M)
        faces += parts_of(Instance("wall"), [panel])
    return tuple(faces)


def _drawn_glazing(rng: Random, plan: Plan) -> Glazing:
    """Draw which half of the walls between rooms and corridors are of glass, and mark every second one."""
    walls = [
        (number, part.side) for number, room in enumerate(plan.rooms) for part in room.partitions if part.back is None
    ]
    chosen = rng.permutation(len(walls))[: len(walls) // 2]
    return {walls[which]: count % 2 == 1 for count, which in enumerate(chosen)}


def _walls(plan: Plan, paints: _Paints, door_m: float, glazed: Glazing) -> tuple[tuple[Box, ...], tuple[Box, ...]]:
    """Return the walls between rooms and corridors with the frames of doors and panes, and the panes."""
    boxes: list[Box] = []
    panes: list[Box] = []
    tall, hole_m, y = float(HIGH_M[2]), door_m + _PLAY_M + 2.0 * _JAMB_M, -0.5 * WALL_M
    for number, room in enumerate(plan.rooms):
        for part in room.partitions:
            wall, instance = room.wall(part.side), Instance("wall")
            back = paints.walls[-1 if part.back is None else part.back]

            def panel(x: float, z: float, w: float, h: float, back: Paint = back, number: int = number) -> Box:
                return block(x, y, z, w, WALL_M, h, back, paints.walls[number])

            doors = sorted(plan.openings(wall))
            ends = [-0.5 * wall.length_m - part.beyond_m[0], 0.5 * wall.length_m + part.beyond_m[1]]
            edges = [ends[0], *(x + s * 0.5 * hole_m for x in doors for s in (-1, 1)), ends[1]]
            windows, stretches = _windows(
                list(zip(edges[::2], edges[1::2], strict=True)), (number, part.side) in glazed
            )
            panels = [panel(0.5 * (a + b), 0.0, b - a, tall) for a, b in stretches]
            top = _HEAD_M + _JAMB_M
            back, front = (
                partial(_upper_part, paint=paint, share=1.0 - top / tall) for paint in (back, paints.walls[number])
            )
            holes = [(x, hole_m) for x in doors] + [(0.5 * (a + b), b - a) for a, b in windows]
            panels += [block(x, y, top, width, WALL_M, tall - top, back, front) for x, width in holes]
            frames = [_frame(paints.frames, door_m + _PLAY_M).moved(np.eye(3), np.array([x, y, 0.0])) for x in doors]
            pieces = [Piece(parts_of(instance, coarse(panels, _WALL_PX_PER_M)), 0.0, 0.0, 0.0), *frames]
            for a, b in windows:
                middle, is_marked = np.array([0.5 * (a + b), y, 0.0]), glazed[number, part.side]
                pieces.append(glazing_frame(b - a, top, is_marked).moved(np.eye(3), middle))
                panes += wall.put(glazing_pane(b - a, _HEAD_M).moved(np.eye(3), middle), 0.0).boxes
            boxes += [box for piece in pieces for box in wall.put(piece, 0.0).boxes]
    return tuple(boxes), tuple(panes)


def _windows(stretches: Sequence[Stretch], is_glazed: bool) -> tuple[list[Stretch], list[Stretch]]:
    """Return the stretches of a wall between its doors that are of glass, and those of masonry [m]."""
    windows: list[Stretch] = []
    solid: list[Stretch] = []
    for number, (a, b) in enumerate(stretches):
        left, right = a + (_PIER_M if number == 0 else 0.0), b - (_PIER_M if number == len(stretches) - 1 else 0.0)
        if is_glazed and right - left > _NARROWEST_M:
            windows.append((left, right))
            solid += [(c, d) for c, d in ((a, left), (right, b)) if d > c]
        else:
            solid.append((a, b))
    return windows, solid


def _upper_part(rng: Random, height: int, width: int, paint: Paint, share: float) -> Image:
    """Return the upper part of a wall, a share of its height."""
    return paint(rng, round(height / share), width)[:height]


def _frame(paint: Paint, clear_m: float) -> Piece:
    """Return the frame of a door, which protrudes from both sides of its wall."""
    deep, wide = WALL_M + 2.0 * _CASING_M, clear_m + 2.0 * _JAMB_M
    boxes = [block(s * 0.5 * (clear_m + _JAMB_M), 0.0, 0.0, _JAMB_M, deep, _HEAD_M, paint) for s in (-1, 1)]
    boxes.append(block(0.0, 0.0, _HEAD_M, wide, deep, _JAMB_M, paint))
    return Piece(coarse(boxes, _THING_PX_PER_M), wide, deep, _HEAD_M + _JAMB_M).as_instance("door_frame")


def _furnished(
    rng: Random, plan: Plan, room: Room, use: Makers, door_m: float, glazed: list[int]
) -> tuple[list[Piece], list[Box]]:
    """Return what stands and hangs along the walls of a room, and the boxes around what a drone could hit."""
    pieces: list[Piece] = []
    hulls: list[Box] = []
    for side in (side for side in range(4) if side not in glazed):
        wall = room.wall(side)
        shift = int(rng.integers(len(use)))
        facade = side in room.facades
        makers = [make for make in use[shift:] + use[:shift] if facade or make is not furniture.window]
        margin = _CORNER_M if side in (EAST, WEST) else _PLAY_M
        things, boxes = stand_along(rng, wall, makers, _blocked(plan, wall, door_m), margin, (0.05, 0.4))
        pieces, hulls = pieces + things, hulls + boxes
    return pieces, hulls


def _decorated(
    rng: Random, plan: Plan, hallway: Hallway, door_m: float, glazed: Glazing
) -> tuple[list[Piece], list[Box]]:
    """Return what stands and hangs along the wall of a corridor, which leaves its middle free."""
    wall = hallway.wall
    makers = [_HALLWAY[int(i)] for i in rng.permutation(len(_HALLWAY))]
    if hallway.facade:
        makers = [part for make in makers for part in (furniture.window, make)]
    ends = [(x, 0.5 * WIDTH_M + _ASIDE_M) for x in plan.stubs_along(wall)]
    for number, side in glazed:
        other = plan.rooms[number].wall(side)
        place, reach_m = other.at(0.0, -0.5 * WALL_M, 0.0)[:2], 0.5 * other.length_m + WALL_M
        ends += [(x, reach_m) for x in along(wall, place[None])]
    return stand_along(rng, wall, makers, [*_blocked(plan, wall, door_m), *ends], 0.3, (0.3, 1.2))


def _blocked(plan: Plan, wall: Wall, door_m: float) -> list[tuple[float, float]]:
    """Return the positions of doors along a wall and half the widths where nothing can stand [m]."""
    return [(x, 0.5 * door_m + _ASIDE_M) for x in plan.openings(wall)]


OFFICE = WorldBuilder("an office of seven to twelve rooms with open doors of 1.2 m around a ring of corridors", layout)
"""The office."""
OFFICE_NARROW = WorldBuilder("the office with doors of 0.9 m", partial(layout, door_m=0.9))
"""The office with narrow doors."""
OFFICE_WHITE = WorldBuilder("the office with white walls without texture", partial(layout, white=True), "hard")
"""The office with white walls."""
OFFICE_GLASS = WorldBuilder("the office with panes of glass between corridors and rooms", partial(layout, glass=True))
"""The office with walls of glass."""
