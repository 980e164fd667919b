"""Shapes to fly: each a few waypoints, fitted into the space that a world leaves, and where to look on the way."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from dronevio.models.errors import ConfigError
from dronevio.sim.paths.heading import HeadingProfile, across, along, fixed, spinning
from dronevio.sim.paths.limits import Limits
from dronevio.sim.paths.space import FlightArea

Array = npt.NDArray[np.float64]

_FILL = 0.88  # share of the free space that waypoints use up; the curve between them swings out a little
_HOVER_S = 10.0  # of a lap on the spot
_PAUSE_S = 3.0  # after turning on the spot, for the heading to catch up with the wish
_SPIN_SHARE = 0.95  # of the greatest yaw rate, so that the heading keeps up with the wish
_ZIGZAG_M = 1.7  # between the turning points of the aggressive zigzag


@dataclass(frozen=True, eq=False)
class Arena:
    """What a shape has to fit into."""

    area: FlightArea
    """The world."""
    low: Array
    """(3,) Least corner of its free space, less the margin [m]."""
    high: Array
    """(3,) Greatest corner [m]."""
    limits: Limits
    """How quickly one may move and turn."""
    waypoints: Array
    """(M, 3) What the plan gives of its own, in the world [m]."""

    @property
    def middle(self) -> Array:
        """(3,) Middle of the free space [m]."""
        return 0.5 * (self.low + self.high)

    @property
    def half(self) -> Array:
        """(3,) How far waypoints may be from it [m]."""
        return 0.5 * _FILL * (self.high - self.low)

    def at(self, fractions: Array) -> Array:
        """Return the points (M, 3) at fractions of the free space: 0 its middle, ±1 as far as waypoints may be."""
        return np.asarray(self.middle + self.half * fractions)


@dataclass(frozen=True, eq=False)
class Course:
    """A shape in a place."""

    lap: Array
    """(M, 3) Waypoints of one lap, which leads back to the first [m]; none to stay where the drone is."""
    heading: HeadingProfile = along
    """Where to look."""
    lap_s: float = 0.0
    """How long a lap takes on the spot [s]."""
    closed: bool = True
    """Whether the last lap leads back to the first waypoint, before the drone goes home."""


Shape = Callable[[Arena], Course]


def hover(arena: Arena) -> Course:
    """Stay above the pad."""
    return Course(np.zeros((0, 3)), fixed(0.0), _HOVER_S)


def rotation(arena: Arena) -> Course:
    """Turn on the spot, once around and back."""
    rate = _SPIN_SHARE * arena.limits.yaw_rate_rad_s
    turn_s = 4.0 * np.pi / rate
    return Course(np.zeros((0, 3)), spinning(rate, turn_s, turn_s + _PAUSE_S), turn_s + _PAUSE_S)


def via(arena: Arena) -> Course:
    """Fly through the plan's own waypoints, given in metres, looking ahead.

    Raises:
        ConfigError: It gives none.
    """
    if not len(arena.waypoints):
        raise ConfigError("the shape 'via' without waypoints; expected one at least, (x, y, z) in the world [m]")
    return Course(arena.waypoints, closed=False)


def tour(arena: Arena) -> Course:
    """See the whole world, looking ahead."""
    return Course(arena.area.route)


def race(arena: Arena) -> Course:
    """Cut through the whole world lap after lap, looking ahead; only its limits tell it from a tour."""
    return Course(arena.area.route)


def figure_eight(arena: Arena) -> Course:
    """Fly figures of eight, the long way of the free space, rising and sinking a little, looking ahead."""
    phase = _phases(16)
    return Course(arena.at(_long_way(arena, np.sin(phase), np.sin(2.0 * phase), 0.4 * np.cos(phase))))


def sideways(arena: Arena) -> Course:
    """Fly the same figures of eight with one side first: what is seen moves across the image."""
    return Course(figure_eight(arena).lap, across)


def helix(arena: Arena) -> Course:
    """Climb three turns around the middle and sink by three more, looking ahead."""
    turns = 3
    phase = 2.0 * np.pi * np.arange(2 * turns * 8) / 8.0
    height = 1.0 - np.abs(np.linspace(-2.0, 2.0, len(phase) + 1)[:-1])
    radius = arena.half[:2].min() / arena.half[:2]
    return Course(arena.at(np.stack([radius[0] * np.cos(phase), radius[1] * np.sin(phase), -height], axis=1)))


def square(arena: Arena) -> Course:
    """Fly along the edges of a square at one height, past the same places in every lap, looking ahead."""
    side = 0.95 * arena.half[:2].min() / arena.half[:2]
    corners = np.array(
        [[1.0, -1.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [-1.0, 1.0], [-1.0, 0.0], [-1.0, -1.0], [0.0, -1.0]]
    )
    return Course(arena.at(np.column_stack([side * corners, np.zeros(len(corners))])))


def inspection(arena: Arena) -> Course:
    """Scan the nearest side of the free space from edge to edge at three heights, facing it."""
    middles = arena.at(np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
    side = int(arena.area.space.clearance(middles).argmin())
    axis, sign = side % 2, 1.0 if side < 2 else -1.0
    stroke = np.linspace(-1.0, 1.0, 4)
    scan = np.concatenate([np.stack([s * stroke, np.full(4, z)], axis=1) for s, z in ((1, -0.9), (-1, 0.0), (1, 0.9))])
    fractions = np.empty((len(scan), 3))
    fractions[:, axis], fractions[:, 1 - axis], fractions[:, 2] = sign, scan[:, 0], scan[:, 1]
    return Course(arena.at(fractions), fixed(0.5 * np.pi * side if side < 3 else -0.5 * np.pi))


def aggressive(arena: Arena) -> Course:
    """Zigzag from end to end and back, rolling and pitching as fast as the limits allow, without turning."""
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
"""What can be flown in any world, by name; the first line of each one's docstring describes it."""


def _phases(count: int) -> Array:
    """Return angles (count,) once around [rad]."""
    return np.asarray(2.0 * np.pi * np.arange(count) / count)


def _long_way(arena: Arena, along_it: Array, across_it: Array, up: Array) -> Array:
    """Return fractions (M, 3) with the first coordinate along the longer side of the free space."""
    sides = (along_it, across_it) if arena.half[0] >= arena.half[1] else (across_it, along_it)
    return np.stack([*sides, up], axis=1)
