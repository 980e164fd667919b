"""Rotors of a multirotor: places and directions of rotation, one by one or as a named arrangement.

Order and directions of the motors in an arrangement are those of PX4's generic airframes (the geometries of its
multirotor mixer, and its airframe of an octorotor).
"""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.ranges import Range, Settings

Direction = Literal["ccw", "cw"]
"""Direction of rotation seen from above: anticlockwise or clockwise."""

FEWEST_ROTORS, MOST_ROTORS = 4, 16
"""Smallest number of rotors, without which thrust and three torques are not independent, and largest number."""


@dataclass(frozen=True)
class Rotor(Settings):
    """Place and direction of rotation of a rotor, whose axis is the z axis of the vehicle."""

    position_m: Annotated[tuple[float, float, float], Range(-10.0, 10.0)]
    """Centre of the disc in the vehicle frame: x forward, y left, z up from the centre of mass [m]."""
    direction: Direction
    """Direction of rotation seen from above: ``ccw`` (anticlockwise) or ``cw`` (clockwise)."""


ARRANGEMENTS: dict[str, tuple[tuple[float, Direction], ...]] = {
    "quad-x": ((45.0, "ccw"), (225.0, "ccw"), (315.0, "cw"), (135.0, "cw")),
    "quad-plus": ((90.0, "ccw"), (270.0, "ccw"), (0.0, "cw"), (180.0, "cw")),
    "hexa-x": ((90.0, "cw"), (270.0, "ccw"), (330.0, "cw"), (150.0, "ccw"), (30.0, "ccw"), (210.0, "cw")),
    "hexa-plus": ((0.0, "cw"), (180.0, "ccw"), (240.0, "cw"), (60.0, "ccw"), (300.0, "ccw"), (120.0, "cw")),
    "octo-x": (
        *((22.5, "cw"), (202.5, "cw"), (67.5, "ccw"), (157.5, "ccw")),
        *((337.5, "ccw"), (247.5, "ccw"), (292.5, "cw"), (112.5, "cw")),
    ),
    "octo-plus": (
        *((0.0, "cw"), (180.0, "cw"), (45.0, "ccw"), (135.0, "ccw")),
        *((315.0, "ccw"), (225.0, "ccw"), (270.0, "cw"), (90.0, "cw")),
    ),
}
"""Arrangements by name: for each motor in order, its bearing clockwise from the front, seen from above [°], and its
direction of rotation."""


def arranged_positions_m(name: str, arm_m: float, height_m: float) -> Array:
    """Return the centres (R, 3) of the rotors of an arrangement in the vehicle frame [m].

    Args:
        name: One of `ARRANGEMENTS`.
        arm_m: Horizontal distance from the centre of mass to the axis of each rotor [m].
        height_m: Height of the discs above the centre of mass [m].
    """
    bearing = np.radians([degrees for degrees, _ in ARRANGEMENTS[name]])
    sides = np.round(np.stack([np.cos(bearing), -np.sin(bearing)], axis=1), 14)  # exact zeros
    sides /= np.abs(sides).max(axis=1, keepdims=True)  # exact ones on the diagonals
    across = sides * arm_m / np.hypot(sides[:, :1], sides[:, 1:])
    return np.hstack([across, np.full((len(across), 1), height_m)])


def arranged_directions(name: str) -> tuple[Direction, ...]:
    """Return the directions of rotation of an arrangement, one of `ARRANGEMENTS`."""
    return tuple(direction for _, direction in ARRANGEMENTS[name])
