"""What a flight may demand of the drone: speed, acceleration, thrust, tilt and turn rates."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from dronevio.models.errors import ConfigError
from dronevio.models.imu import GRAVITY_M_S2

Array = npt.NDArray[np.float64]

_RESERVE = 0.99  # share of a limit that a path is planned to: between the samples that are looked at it may be higher
_GREATEST_TILT_RAD = 1.4  # 80°
_LEAST_THRUST = 0.3  # of the weight: rotors that nearly stand still steer no more


@dataclass(frozen=True)
class Limits:
    """Upper bounds on a planned path; what rotors must do for it follows (differential flatness)."""

    speed_m_s: float = 2.0
    """Speed of the centre of mass [m/s]."""
    accel_m_s2: float = 3.0
    """Its acceleration [m/s²]."""
    yaw_rate_rad_s: float = 1.6
    """Rate at which the heading changes [rad/s]."""
    tilt_rate_rad_s: float = 4.0
    """Rate at which the thrust's direction changes: roll and pitch rate together [rad/s]."""
    thrust_to_weight: float = 1.8
    """Thrust over the weight; the house's quadrotor can give 2.3 and needs the rest to steer."""
    tilt_rad: float = 1.0
    """Angle between the thrust and the vertical [rad]; far below π/2, where a heading means nothing any more."""

    def __post_init__(self) -> None:
        """Check them.

        Raises:
            ConfigError: A limit is no positive number, or the thrust does not carry the drone.
        """
        for limit in fields(self):
            value = getattr(self, limit.name)
            if not (np.isfinite(value) and value > 0.0):
                raise ConfigError(f"limit {limit.name} = {value:g}; expected a positive number")
        if self.tilt_rad > _GREATEST_TILT_RAD:
            raise ConfigError(f"limit tilt_rad = {self.tilt_rad:g}; expected {_GREATEST_TILT_RAD:g} at most")
        if self.thrust_to_weight <= 1.0:
            raise ConfigError(f"limit thrust_to_weight = {self.thrust_to_weight:g}; expected more than 1, to hover")

    def limit_ratio(self, velocity_m_s: Array, acceleration_m_s2: Array, jerk_m_s3: Array) -> Array:
        """Return the share (…) of the limits that a motion (…, 3) uses up; above 1 it breaks one.

        The share of an acceleration is counted as its square root, that of a tilt rate as its cube root, so that
        a strain is the factor by which time must be stretched.
        """
        thrust = acceleration_m_s2 + [0.0, 0.0, GRAVITY_M_S2]
        lift = np.maximum(_norm(thrust), 1e-9)
        accel = _norm(acceleration_m_s2)
        # The thrust turns at |thrust × jerk| / thrust² (Mellinger and Kumar 2011, h_ω).
        tilt_rate = _norm(np.cross(thrust, jerk_m_s3)) / np.maximum(lift, 0.1 * GRAVITY_M_S2) ** 2
        spare = (self.thrust_to_weight - 1.0) * GRAVITY_M_S2
        heavy = np.maximum(lift - GRAVITY_M_S2, 0.0) / spare
        light = np.maximum(GRAVITY_M_S2 - lift, 0.0) / ((1.0 - _LEAST_THRUST) * GRAVITY_M_S2)
        # Tilted by its limit, the thrust's horizontal part is tan(limit) times the vertical one.
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
"""How flights are told apart: easy, medium and difficult like those of EuRoC (Burri et al., "The EuRoC micro aerial
vehicle datasets", 2016), race like those of UZH-FPV (Delmerico et al., "Are we ready for autonomous drone racing?",
2019)."""


def _norm(vectors: Array) -> Array:
    """Return the lengths (…) of vectors (…, 3)."""
    return np.asarray(np.sqrt(np.einsum("...i,...i->...", vectors, vectors)))
