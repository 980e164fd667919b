"""The motion of section 7.4.1: constant velocity and constant angular velocity in the body frame, a vertical circle.

With v forward along x and the nose rising at ω, the drone is on a circle of radius v/ω in the x-z plane, whose centre
is above the start, and points along the tangent. Position, velocity and orientation follow in closed form.

Source: Dellaert and Hutchinson, *Introduction to Robotics*, sections 7.2 and 7.4.1.
"""

from dataclasses import dataclass
from typing import Literal

import gtsam
import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.rotation import exp_so3

Counting = Literal["book", "equal"]


@dataclass(frozen=True, eq=False)
class LoopStates:
    """Navigation states at N times, in the world frame."""

    R_world_imu: Array
    """(N, 3, 3) Orientations of the IMU, whose frame is the body frame."""
    p_world_imu: Array
    """(N, 3) Positions of the IMU [m]."""
    velocity_m_s: Array
    """(N, 3) Velocities of the IMU [m/s]."""


@dataclass(frozen=True)
class LoopFlight:
    """Motion of the drone, rate of its IMU, and distribution of the samples over the IMU factors."""

    speed_m_s: float = 2.0
    """Forward speed along the x axis of the body frame [m/s]."""
    pitch_rate_rad_s: float = float(np.radians(30.0))
    """Rate at which the nose rises [rad/s]."""
    duration_s: float = 3.5
    """Duration of the flight [s]."""
    imu_rate_hz: float = 10.0
    """Sampling rate of the IMU [Hz]."""
    samples_per_factor: int = 5
    """Number of IMU samples in each IMU factor."""
    counting: Counting = "book"
    """Distribution of the samples over the factors. ``equal``: every factor has the same number. ``book``: as the loop
    of the chapter counts; its first factor has one sample more, and the samples after the last factor are unused."""

    def __post_init__(self) -> None:
        """Check the values of the fields.

        Raises:
            ConfigError: There is no sample for a factor, the drone does not turn, or the counting is unknown.
        """
        if self.counting not in ("book", "equal"):
            raise ConfigError(f"counting {self.counting!r}; expected book or equal")
        if self.samples_per_factor < 1 or not self.factor_samples:
            raise ConfigError(
                f"{self.samples} samples and {self.samples_per_factor} per factor; expected enough for one factor"
            )
        if not self.pitch_rate_rad_s > 0.0:
            raise ConfigError(f"pitch rate {self.pitch_rate_rad_s}; expected a positive number")

    @property
    def radius_m(self) -> float:
        """Radius of the circle, v/ω [m]."""
        return self.speed_m_s / self.pitch_rate_rad_s

    @property
    def arc_rad(self) -> float:
        """Angle of the arc over the whole duration, ω t [rad]."""
        return self.pitch_rate_rad_s * self.duration_s

    @property
    def dt_s(self) -> float:
        """Sampling interval of the IMU [s]."""
        return 1.0 / self.imu_rate_hz

    @property
    def samples(self) -> int:
        """Number of IMU samples in the whole duration."""
        return round(self.duration_s * self.imu_rate_hz)

    @property
    def factor_samples(self) -> tuple[int, ...]:
        """Number of IMU samples in each factor."""
        n = self.samples_per_factor
        if self.counting == "equal":
            return (n,) * (self.samples // n)
        # The chapter ends a factor after sample j if j > 0 and j is a multiple of n: the first contains 0, 1, …, n.
        factors = (self.samples - 1) // n
        return (n + 1, *((n,) * (factors - 1))) if factors else ()

    @property
    def t_s(self) -> Array:
        """(K+1,) Times of the states: the start, and the end of the samples of each factor [s]."""
        return np.asarray(np.cumsum([0, *self.factor_samples]) * self.dt_s, dtype=np.float64)

    @property
    def nominal_t_s(self) -> Array:
        """(K+1,) Times for which the chapter computes the initial values, multiples of ``samples_per_factor`` [s]."""
        states = np.arange(len(self.factor_samples) + 1, dtype=np.float64)
        return states * self.samples_per_factor * self.dt_s

    @property
    def scenario(self) -> gtsam.ConstantTwistScenario:
        """The motion as a GTSAM scenario; with y to the left, the nose rises with a negative rotation about y."""
        return gtsam.ConstantTwistScenario([0.0, -self.pitch_rate_rad_s, 0.0], [self.speed_m_s, 0.0, 0.0])

    def states(self, t_s: Array) -> LoopStates:
        """Return the true states at times (N,) [s]."""
        angle, zero = self.pitch_rate_rad_s * np.asarray(t_s), np.zeros(len(t_s))
        sine, cosine = np.sin(angle), np.cos(angle)
        return LoopStates(
            exp_so3(np.stack([zero, -angle, zero], axis=1)),
            self.radius_m * np.stack([sine, zero, 1.0 - cosine], axis=1),
            self.speed_m_s * np.stack([cosine, zero, sine], axis=1),
        )
