"""Turns: headings over time with bounded rate and acceleration, from any rate to rest."""

from dataclasses import dataclass
from math import pi, remainder, sqrt

import numpy as np

from dronevio.models.arrays import Array


@dataclass(frozen=True)
class Turn:
    """Fastest turn to a heading, with constant acceleration, then constant rate, then constant deceleration."""

    yaw_rad: float
    """Heading at the start [rad]."""
    rate_rad_s: float
    """Its rate at the start [rad/s]."""
    angle_rad: float
    """Angle of the turn, positive to the left [rad]."""
    max_rate_rad_s: float
    """Largest rate [rad/s]; a faster start is slowed down."""
    accel_rad_s2: float
    """Acceleration of the rate [rad/s²]."""

    @classmethod
    def toward(
        cls, yaw_rad: float, rate_rad_s: float, target_rad: float, max_rate_rad_s: float, accel_rad_s2: float
    ) -> "Turn":
        """Return the shorter turn to a heading, from where the present rate can be stopped."""
        stopped = yaw_rad + rate_rad_s * abs(rate_rad_s) / (2.0 * accel_rad_s2)
        angle = stopped - yaw_rad + remainder(target_rad - stopped, 2.0 * pi)
        return cls(yaw_rad, rate_rad_s, angle, max_rate_rad_s, accel_rad_s2)

    @property
    def duration_s(self) -> float:
        """Time of the end, from which the heading is constant [s]."""
        return self._parts()[-1]

    def at(self, time_s: Array) -> tuple[Array, Array]:
        """Return headings and their rates (N,) at times (N,) from the start [rad, rad/s].

        Before the start, the acceleration is that of its first part.
        """
        peak, begin, cruise, end = self._parts()
        t = np.minimum(time_s, end)
        first, second, third = (
            np.minimum(t, begin),
            np.clip(t - begin, 0.0, cruise),
            np.clip(t - begin - cruise, 0, end),
        )
        accel = (peak - self.rate_rad_s) / begin if begin > 0.0 else 0.0
        slowing = -np.sign(peak) * self.accel_rad_s2
        rate = self.rate_rad_s + accel * first + slowing * third
        yaw = self.yaw_rad + self.rate_rad_s * first + 0.5 * accel * first**2
        yaw = yaw + peak * second + peak * third + 0.5 * slowing * third**2
        return np.asarray(yaw), np.where(t < end, rate, 0.0)

    def _parts(self) -> tuple[float, float, float, float]:
        """Return the peak rate, the time until it is reached, the time for which it is kept, and the end [rad/s, s]."""
        a, r = self.accel_rad_s2, self.rate_rad_s
        sign = 1.0 if self.angle_rad - r * abs(r) / (2.0 * a) >= 0.0 else -1.0
        peak = sign * min(sqrt(max(a * sign * self.angle_rad + 0.5 * r * r, 0.0)), self.max_rate_rad_s)
        begin = abs(peak - r) / a
        rest = self.angle_rad - 0.5 * (r + peak) * begin - 0.5 * peak * abs(peak) / a
        cruise = max(rest / peak, 0.0) if abs(peak) > 1e-9 else 0.0
        return peak, begin, cruise, begin + cruise + abs(peak) / a
