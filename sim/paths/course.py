"""Courses: what a controller tracks, known in advance or decided during the flight."""

from typing import NamedTuple, Protocol

from dronevio.models.arrays import Array


class ReferencePoint(NamedTuple):
    """Motion that a controller tracks at one time."""

    position_m: Array
    """(3,) Position of the centre of mass in the world [m]."""
    velocity_m_s: Array
    """(3,) Velocity of the centre of mass in the world [m/s]."""
    acceleration_m_s2: Array
    """(3,) Acceleration of the centre of mass in the world [m/s²]."""
    yaw_rad: float
    """Heading, the yaw angle [rad]."""
    rate_rad_s: Array
    """(3,) Angular velocity in the vehicle frame [rad/s]."""
    angular_acceleration_rad_s2: Array
    """(3,) Angular acceleration in the vehicle frame [rad/s²]."""
    flying: bool
    """Whether the rotors turn."""


class Course(Protocol):
    """Interface of what a controller tracks; `Reference` is one that is known from the beginning."""

    @property
    def interval_ns(self) -> int:
        """Time between two commands [ns]."""

    @property
    def end_ns(self) -> int:
        """Time at which a flight along the course ends at the latest [ns]."""

    def point(self, t_ns: int) -> ReferencePoint:
        """Return what is tracked at a time, from 0 to the end [ns]. A flight asks for times that do not decrease."""
