"""Shapes of tours: waypoints fitted into the free space of a world, and the heading along them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.sim.paths.heading import HeadingProfile, across, along, fixed, spinning
from dronevio.sim.paths.limits import Limits
from dronevio.sim.paths.space import FlightArea

_FILL = 0.88  # fraction of the free space that waypoints use; the curve between them exceeds it a little
_HOVER_S = 10.0  # duration of a lap of the hover
_PAUSE_S = 3.0  # after the rotation, until the heading has reached the desired one
_SPIN_SHARE = 0.95  # of the largest yaw rate, so that the heading follows the desired one
_ZIGZAG_M = 1.7  # distance between reversals of the aggressive zigzag


@dataclass(frozen=True, eq=False)
class Arena:
    """Free space, limits and waypoints to which a shape is fitted."""

    area: FlightArea
    """Bounds, obstacles and route of the world."""
    low: Array
    """(3,) Lower corner of the free space, reduced by the margin [m]."""
    high: Array
    """(3,) Upper corner of the free space, reduced by the margin [m]."""
    limits: Limits
    """Limits of the motion."""
    waypoints: Array
    """(M, 3) Waypoints of the plan in the world [m]."""

    @property
    def middle(self) -> Array:
        """(3,) Centre of the free space [m]."""
        return 0.5 * (self.low + self.high)

    @property
    def half(self) -> Array:
        """(3,) Largest distance of waypoints from the centre on each axis [m]."""
        return 0.5 * _FILL * (self.high - self.low)

    def at(self, fractions: Array) -> Array:
        """Return points (M, 3) at relative positions in the free space: 0 is its centre, ±1 the largest distance."""
        return np.asarray(self.middle + self.half * fractions)


@dataclass(frozen=True, eq=False)
class Course:
    """Waypoints and heading of a shape in a world."""

    lap: Array
    """(M, 3) Waypoints of one lap, which returns to the first [m]; empty for a lap on the spot."""
    heading: HeadingProfile = along
    """Desired heading along the lap."""
    lap_s: float = 0.0
    """Duration of a lap on the spot [s]."""
    closed: bool = True
    """Whether the last lap returns to the first waypoint."""


Shape = Callable[[Arena], Course]


def hover(arena: Arena) -> Course:
    """Hover above the landing pad."""
    return Course(np.zeros((0, 3)), fixed(0.0), _HOVER_S)


def rotation(arena: Arena) -> Course:
    """Rotate on the spot, two turns in each direction."""
    rate = _SPIN_SHARE * arena.limits.yaw_rate_rad_s
    turn_s = 4.0 * np.pi / rate
    return Course(np.zeros((0, 3)), spinning(rate, turn_s, turn_s + _PAUSE_S), turn_s + _PAUSE_S)


def via(arena: Arena) -> Course:
    """Fly through the waypoints of the plan, given in metres, with the heading along the path.

    Raises:
        ConfigError: The plan has no waypoints.
    """
    if not len(arena.waypoints):
        raise ConfigError("the shape 'via' without waypoints; expected one at least, (x, y, z) in the world [m]")
    return Course(arena.waypoints, closed=False)


def tour(arena: Arena) -> Course:
    """Fly along the route through the whole world, with the heading along the path."""
    return Course(arena.area.route)


def race(arena: Arena) -> Course:
    """Fly laps of the route through the whole world; it differs from a tour by its limits only."""
    return Course(arena.area.route)


def figure_eight(arena: Arena) -> Course:
    """Fly figures of eight along the longer side of the free space at changing height, looking along the path."""
    phase = _phases(16)
    return Course(arena.at(_long_way(arena, np.sin(phase), np.sin(2.0 * phase), 0.4 * np.cos(phase))))


def sideways(arena: Arena) -> Course:
    """Fly the figures of eight with the right side first, so that the scene moves across the image."""
    return Course(figure_eight(arena).lap, across)


def helix(arena: Arena) -> Course:
    """Climb three turns around the centre and descend three more, with the heading along the path."""
    turns = 3
    phase = 2.0 * np.pi * np.arange(2 * turns * 8) / 8.0
    height = 1.0 - np.abs(np.linspace(-2.0, 2.0, len(phase) + 1)[:-1])
    radius = arena.half[:2].min() / arena.half[:2]
    return Course(arena.at(np.stack([radius[0] * np.cos(phase), radius[1] * np.sin(phase), -height], axis=1)))


def square(arena: Arena) -> Course:
    """Fly along the edges of a square at constant height, past the same places in every lap."""
    side = 0.95 * arena.half[:2].min() / arena.half[:2]
    corners = np.array(
        [[1.0, -1.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [-1.0, 1.0], [-1.0, 0.0], [-1.0, -1.0], [0.0, -1.0]]
    )
    return Course(arena.at(np.column_stack([side * corners, np.zeros(len(corners))])))


def inspection(arena: Arena) -> Course:
    """Scan the nearest side of the free space at three heights, with the camera facing it."""
    middles = arena.at(np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
    side = int(arena.area.space.clearance(middles).argmin())
    axis, sign = side % 2, 1.0 if side < 2 else -1.0
    stroke = np.linspace(-1.0, 1.0, 4)
    scan = np.concatenate([np.stack([s * stroke, np.full(4, z)], axis=1) for s, z in ((1, -0.9), (-1, 0.0), (1, 0.9))])
    fractions = np.empty((len(scan), 3))
    fractions[:, axis], fractions[:, 1 - axis], fractions[:, 2] = sign, scan[:, 0], scan[:, 1]
    return Course(arena.at(fractions), fixed(0.5 * np.pi * side if side < 3 else -0.5 * np.pi))


def aggressive(arena: Arena) -> Course:
    """Fly a zigzag from end to end and back at constant heading, with the largest roll and pitch rates."""
    rows = 4
    reach = np.minimum(1.0, 0.5 * _ZIGZAG_M / arena.half)
    way = np.concatenate([np.linspace(-1.0, 1.0, rows), np.linspace(1.0, -1.0, rows)])
    swing = np.where(np.arange(2 * rows) % 2 == 0, 1.0, -1.0)
    first = np.stack([way, reach[1] * swing, 0.3 * reach[2] * swing], axis=1)
    second = np.stack([reach[0] * swing, way, -0.3 * reach[2] * swing], axis=1)
    return Course(arena.at(np.concatenate([first, second])), fixed(0.0))


SHAPES: Mapping[str, Shape] = MappingProxyType(
    {
        "hover": hover,
        "rotation": rotation,
        "via": via,
        "tour": tour,
        "race": race,
        "figure-8": figure_eight,
        "sideways": sideways,
        "helix": helix,
        "square": square,
        "inspection": inspection,
        "aggressive": aggressive,
    }
)
"""All shapes by name; the first line of each docstring is its description."""


def _phases(count: int) -> Array:
    """Return angles (count,) evenly spaced over a turn [rad]."""
    return np.asarray(2.0 * np.pi * np.arange(count) / count)


def _long_way(arena: Arena, along_it: Array, across_it: Array, up: Array) -> Array:
    """Return relative positions (M, 3) with the first coordinate along the longer side of the free space."""
    sides = (along_it, across_it) if arena.half[0] >= arena.half[1] else (across_it, along_it)
    return np.stack([*sides, up], axis=1)
