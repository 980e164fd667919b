"""Limits of planned trajectories: speed, acceleration, thrust, tilt and angular rates."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.ranges import Range, Settings
from dronevio.models.rotation import cross

_RESERVE = 0.99  # fraction of a limit used in planning, since values between samples may be higher
_GREATEST_TILT_RAD = 1.4  # 80°
_LEAST_THRUST = 0.3  # relative to the weight: slow rotors have no control authority


@dataclass(frozen=True)
class Limits(Settings):
    """Upper bounds on the motion of a planned trajectory; those on the rotors follow by differential flatness."""

    speed_m_s: Annotated[float, Range(0.01, 100.0)] = 2.0
    """Speed of the centre of mass [m/s]."""
    accel_m_s2: Annotated[float, Range(0.01, 1e3)] = 3.0
    """Acceleration of the centre of mass [m/s²]."""
    yaw_rate_rad_s: Annotated[float, Range(0.01, 100.0)] = 1.6
    """Rate of the heading [rad/s]."""
    tilt_rate_rad_s: Annotated[float, Range(0.01, 1e3)] = 4.0
    """Rate of the direction of the thrust, that is roll and pitch rate combined [rad/s]."""
    thrust_to_weight: Annotated[float, Range(above=1.0, high=100.0)] = 1.8
    """Ratio of thrust to weight; the research quadrotor reaches 2.3 and requires the difference for control."""
    tilt_rad: Annotated[float, Range(0.01, _GREATEST_TILT_RAD)] = 1.0
    """Angle between the thrust and the vertical [rad]; well below π/2, where the heading becomes undefined."""

    def limit_ratio(self, velocity_m_s: Array, acceleration_m_s2: Array, jerk_m_s3: Array) -> Array:
        """Return the largest ratio (…) of a motion (…, 3) to the limits; above 1 a limit is exceeded.

        The ratio of accelerations is their square root and that of tilt rates their cube root, so that the result is
        the factor by which time must be scaled.
        """
        thrust = acceleration_m_s2 + [0.0, 0.0, GRAVITY_M_S2]
        lift = np.maximum(_norm(thrust), 1e-9)
        accel = _norm(acceleration_m_s2)
        # The direction of the thrust changes at |thrust × jerk| / thrust² (Mellinger and Kumar 2011, h_ω).
        tilt_rate = _norm(cross(thrust, jerk_m_s3)) / np.maximum(lift, 0.1 * GRAVITY_M_S2) ** 2
        spare = (self.thrust_to_weight - 1.0) * GRAVITY_M_S2
        heavy = np.maximum(lift - GRAVITY_M_S2, 0.0) / spare
        light = np.maximum(GRAVITY_M_S2 - lift, 0.0) / ((1.0 - _LEAST_THRUST) * GRAVITY_M_S2)
        # At the tilt limit, the horizontal component of the thrust is tan(limit) times the vertical one.
        sideways = np.hypot(acceleration_m_s2[..., 0], acceleration_m_s2[..., 1]) / np.tan(self.tilt_rad)
        tilted = np.maximum(sideways - acceleration_m_s2[..., 2], 0.0) / GRAVITY_M_S2
        shares = (
            _norm(velocity_m_s) / (_RESERVE * self.speed_m_s),
            np.sqrt(np.maximum.reduce([accel / self.accel_m_s2, heavy, light, tilted]) / _RESERVE),
            np.cbrt(tilt_rate / (_RESERVE * self.tilt_rate_rad_s)),
        )
        return np.asarray(np.maximum.reduce(shares))


LIMITS: Mapping[str, Limits] = MappingProxyType(
    {
        "easy": Limits(speed_m_s=1.0, accel_m_s2=1.0, yaw_rate_rad_s=0.6),
        "medium": Limits(speed_m_s=2.4, accel_m_s2=2.5, yaw_rate_rad_s=1.8),
        "difficult": Limits(speed_m_s=4.0, accel_m_s2=7.0, yaw_rate_rad_s=3.6, tilt_rate_rad_s=6.0),
        "race": Limits(speed_m_s=9.0, accel_m_s2=13.0, yaw_rate_rad_s=3.6, tilt_rate_rad_s=8.0, thrust_to_weight=2.0),
    }
)
"""Limits by level: easy, medium and difficult similar to EuRoC (Burri et al., "The EuRoC micro aerial vehicle
datasets", 2016), race similar to UZH-FPV (Delmerico et al., "Are we ready for autonomous drone racing?", 2019)."""


def _norm(vectors: Array) -> Array:
    """Return the lengths (…) of vectors (…, 3)."""
    return np.asarray(np.sqrt(np.einsum("...i,...i->...", vectors, vectors)))
