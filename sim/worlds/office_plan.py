"""Floor plan of the world office: rooms, doors and corridors, drawn from a seed.

A ring of corridors separates a core of one to four rooms from a strip of three or four rooms on either long side; each
strip is interrupted by a corridor that ends at the facade. Two neighbours of each strip, and the first room of the
core, have two doorways, which close further loops; all other rooms are dead ends.
"""

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.rotation import rotation_z
from dronevio.sim.props.building import Wall, room_walls
from dronevio.sim.worlds.layout import ROUTE_CLEARANCE_M

Random = np.random.Generator

LOW_M, HIGH_M = np.array([-10.0, -8.2, 0.0]), np.array([10.0, 8.2, 2.8])
"""Corners of the floor [m]."""
WIDTH_M = 2.2
"""Width of the corridors [m]."""
WALL_M = 0.14
"""Thickness of the walls between rooms and corridors [m]."""
CORE_M = np.array([7.8, 2.0])
"""(2,) Half the extent of the core, its walls included [m]."""
OUTER_M = float(CORE_M[1]) + WIDTH_M
"""Distance of the walls between corridors and strips from the middle of the floor [m]."""
SOUTH, EAST, NORTH, WEST = range(4)
"""Sides of a room, in the order of `dronevio.sim.props.building.room_walls`."""

_MIDDLE_M = np.array([HIGH_M[0], OUTER_M]) - 0.5 * WIDTH_M  # of the corridors, from the middle of the floor
_SPREAD = 0.12  # relative spread of the widths of rooms
_ASIDE_M = 0.3  # largest distance of a door from the middle of its wall
_HEIGHTS_M = (1.2, 1.4, 1.0, 1.3, 1.1, 1.45)  # of the route, in turn: clear of the heads of doors


@dataclass(frozen=True, eq=False)
class Partition:
    """A wall of a room towards another room or a corridor; its thickness is outside the room."""

    side: int
    """Side of the room."""
    back: int | None
    """Number of the room behind it; None for a corridor."""
    beyond_m: tuple[float, float] = (0.0, 0.0)
    """By how much it extends beyond the room to the left and right end of the frame of the wall [m]."""


@dataclass(frozen=True, eq=False)
class Room:
    """A rectangular room, or the part of a corridor that leads to the facade."""

    low: Array
    """(2,) Least corner of the floor [m]."""
    high: Array
    """(2,) Greatest corner of the floor [m]."""
    partitions: tuple[Partition, ...] = ()
    """Walls that the room shares with others and draws; a wall to the room before it belongs to that one."""
    facades: tuple[int, ...] = ()
    """Sides that are bounds of the world."""

    @property
    def middle(self) -> Array:
        """(2,) Middle of the floor [m]."""
        return np.asarray(0.5 * (self.low + self.high))

    def wall(self, side: int) -> Wall:
        """Return the inner surface of a wall."""
        return room_walls(np.array([*self.low, 0.0]), np.array([*self.high, HIGH_M[2]]))[side]


@dataclass(frozen=True, eq=False)
class Hallway:
    """The wall of a corridor."""

    wall: Wall
    """Where it is; it faces the corridor."""
    facade: bool = False
    """Whether it is a bound of the world."""


@dataclass(frozen=True, eq=False)
class Plan:
    """Floor plan of an office."""

    rooms: tuple[Room, ...]
    """All rooms."""
    stubs: tuple[Room, ...]
    """Corridors that end at the facade: one to the south, one to the north."""
    doors: Array
    """(D, 2) Middles of the doorways, within the thickness of their walls [m]."""
    tours: tuple[Array, ...]
    """Waypoints (4, 2) through two neighbours in the south strip, eastward, and in the north strip, westward [m]."""
    pad: Array = field(default_factory=lambda: np.array([-_MIDDLE_M[0], 0.0, 0.0]))
    """(3,) Centre of the landing pad, in the west corridor [m]."""

    def route(self, door_m: float) -> Array:
        """Return the lap (R, 3) around the ring of corridors, through rooms if doors of this width let it pass [m]."""
        x, y = _MIDDLE_M
        south, north = self.tours if 0.5 * door_m >= ROUTE_CLEARANCE_M else ([(0.0, -y)], [(0.0, y)])
        lap = [(-x, 0.0), (-x, -y), *south, (x, -y), (x, 0.0), (x, y), *north, (-x, y)]
        return np.array([(*place, _HEIGHTS_M[k % len(_HEIGHTS_M)]) for k, place in enumerate(lap)])

    @property
    def lamps(self) -> list[tuple[Array, tuple[float, float]]]:
        """Where lamps hang (2,), and their size along x and y [m]."""
        x, y = _MIDDLE_M
        places = [(np.array([u, s * y]), (1.2, 0.3)) for u in np.linspace(-7.2, 7.2, 5) for s in (-1, 1)]
        places += [(np.array([s * x, v]), (0.3, 1.2)) for v in (-1.6, 1.6) for s in (-1, 1)]
        places += [(stub.middle, (0.3, 1.2)) for stub in self.stubs]
        for room in self.rooms:
            count = 1 if room.high[0] - room.low[0] < 5.0 else 2
            xs = room.low[0] + (np.arange(count) + 0.5) / count * (room.high[0] - room.low[0])
            places += [(np.array([u, room.middle[1]]), (1.2, 0.6)) for u in xs]
        return places

    @property
    def hallways(self) -> list[Hallway]:
        """The walls of the ring of corridors."""
        x, (cx, cy) = float(HIGH_M[0]), CORE_M
        ring = room_walls(np.array([-x, -OUTER_M, 0.0]), np.array([x, OUTER_M, 0.0]))
        core = room_walls(np.array([-cx, -cy, 0.0]), np.array([cx, cy, 0.0]))
        inward = [Hallway(wall, number in (EAST, WEST)) for number, wall in enumerate(ring)]
        return inward + [Hallway(Wall(wall.middle, wall.turn_rad + np.pi, wall.length_m)) for wall in core]

    @property
    def ring(self) -> list[Room]:
        """The four stretches of the ring of corridors, with the walls beside them: south, north, east and west."""
        x, (cx, cy), far = float(HIGH_M[0]), CORE_M - WALL_M, OUTER_M + WALL_M
        corners = (((-x, -far), (x, -cy)), ((-x, cy), (x, far)), ((cx, -cy), (x, cy)), ((-x, -cy), (-cx, cy)))
        return [Room(np.array(low), np.array(high)) for low, high in corners]

    def stubs_along(self, wall: Wall) -> list[float]:
        """Return where the stubs that leave the corridor through a wall are along it [m]."""
        places = np.array(
            [[stub.middle[0], s * (OUTER_M + 0.5 * WALL_M)] for stub, s in zip(self.stubs, (-1, 1), strict=True)]
        )
        return along(wall, places)

    def openings(self, wall: Wall) -> list[float]:
        """Return where the doorways in a wall, or behind it, are along it [m]."""
        return along(wall, self.doors)


def along(wall: Wall, places: Array) -> list[float]:
    """Return where those of the places (K, 2) are along a wall that are within its thickness [m]."""
    local = (places - wall.middle[:2]) @ rotation_z(wall.turn_rad)[:2, :2]
    near = (np.abs(local[:, 1]) < WALL_M) & (np.abs(local[:, 0]) < 0.5 * wall.length_m)
    return [float(x) for x in local[near, 0]]


def drawn_plan(rng: Random) -> Plan:
    """Draw a plan of seven to twelve rooms."""
    rooms, doors = _core(rng)
    stubs, tours = [], []
    for sign in (-1.0, 1.0):
        strip, stub, doorways, tour = _strip(rng, sign, len(rooms))
        rooms, doors = rooms + strip, doors + doorways
        stubs.append(stub)
        tours.append(tour)
    return Plan(tuple(rooms), tuple(stubs), np.array(doors), tuple(tours))


def _widths(rng: Random, count: int, total_m: float) -> Array:
    """Return the widths (count,) of rooms that fill a length."""
    widths = rng.uniform(1.0 - _SPREAD, 1.0 + _SPREAD, count)
    return np.asarray(widths * total_m / widths.sum())


def _core(rng: Random) -> tuple[list[Room], list[Array]]:
    """Return the rooms of the core from west to east, and their doorways: the first has one to each side."""
    count = int(rng.integers(1, 5))
    y, wall_y = float(CORE_M[1]) - WALL_M, float(CORE_M[1]) - 0.5 * WALL_M
    rooms: list[Room] = []
    doors: list[Array] = []
    x = -float(CORE_M[0]) + WALL_M
    for number, width in enumerate(_widths(rng, count, 2.0 * float(CORE_M[0]) - (count + 1) * WALL_M)):
        first, last = number == 0, number == count - 1
        begin = WALL_M if first else 0.0
        partitions = [Partition(SOUTH, None, (begin, WALL_M)), Partition(NORTH, None, (WALL_M, begin))]
        partitions.append(Partition(EAST, None if last else number + 1))
        partitions += [Partition(WEST, None)] if first else []
        rooms.append(Room(np.array([x, -y]), np.array([x + width, y]), tuple(partitions)))
        place = x + 0.5 * width + rng.uniform(-_ASIDE_M, _ASIDE_M)
        sides = (-1.0, 1.0) if first else (float(rng.choice([-1.0, 1.0])),)
        doors += [np.array([place, side * wall_y]) for side in sides]
        x += width + WALL_M
    return rooms, doors


def _strip(rng: Random, sign: float, number: int) -> tuple[list[Room], Room, list[Array], Array]:
    """Return the rooms of a strip from west to east, its stub, its doorways, and a way (4, 2) through two neighbours.

    Args:
        rng: Draws widths, doorways and where the stub is.
        sign: −1 for the south, 1 for the north.
        number: Of its first room.
    """
    count = int(rng.integers(3, 5))
    stub_at = int(rng.integers(1, count))
    widths = list(_widths(rng, count, float(HIGH_M[0] - LOW_M[0]) - WIDTH_M - count * WALL_M))
    widths.insert(stub_at, WIDTH_M)
    facade, inner = (SOUTH, NORTH) if sign < 0.0 else (NORTH, SOUTH)
    near, far = OUTER_M + WALL_M, float(HIGH_M[1])
    edges = np.cumsum([float(LOW_M[0]), *(width + WALL_M for width in widths)])
    areas = [
        Room(np.array([a, min(sign * near, sign * far)]), np.array([b - WALL_M, max(sign * near, sign * far)]))
        for a, b in pairwise(edges)
    ]
    rooms: list[Room] = []
    for k, area in enumerate(areas):
        if k == stub_at:
            continue
        last, after_stub = k == count, k == stub_at + 1
        ends = (WALL_M if after_stub else 0.0, 0.0 if last else WALL_M)
        partitions = [Partition(inner, None, ends if inner == SOUTH else ends[::-1])]
        if not last:
            partitions.append(Partition(EAST, None if k + 1 == stub_at else number + len(rooms) + 1))
        if after_stub:
            partitions.append(Partition(WEST, None))
        facades = (facade, *([WEST] if k == 0 else []), *([EAST] if last else []))
        rooms.append(replace(area, partitions=tuple(partitions), facades=facades))
    wall_y, y = sign * (OUTER_M + 0.5 * WALL_M), sign * 0.5 * (near + far)
    places = [float(room.middle[0] + rng.uniform(-_ASIDE_M, _ASIDE_M)) for room in rooms]
    doors = [np.array([x, wall_y]) for x in places]
    pair = int(rng.choice([k for k in range(count - 1) if k != stub_at - 1]))
    doors.append(np.array([rooms[pair].high[0] + 0.5 * WALL_M, y]))
    west, east = places[pair], places[pair + 1]
    in_corridor = sign * float(_MIDDLE_M[1])
    tour = np.array([(west, in_corridor), (west, y), (east, y), (east, in_corridor)])
    return rooms, replace(areas[stub_at], facades=(facade,)), doors, tour if sign < 0.0 else tour[::-1]
