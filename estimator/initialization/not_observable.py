"""Initializations that are not possible yet: what is missing, what would help, and the cause where data disagree."""

import math
from dataclasses import dataclass

import numpy as np

from dronevio.estimator.monitoring.causes import Cause
from dronevio.models.arrays import Array

MAX_GRAVITY_RATIO = 2.5
"""Largest plausible ratio, in either direction, of the median specific force during an initialization to gravity."""
MAX_GRAVITY_SPREAD = 0.3
"""Largest interquartile range of the magnitude of the specific force, relative to its median, by which gravity is
recognized among the readings of a gyroscope: the magnitude of an angular velocity is not as constant."""


@dataclass(frozen=True)
class NotObservable:
    """The result of an initialization whose state is not observable yet."""

    reason: str
    """The reason, as a text for people."""
    cause: Cause | None = None
    """The probable cause, where measurements disagree with each other; None where they agree."""

    def __str__(self) -> str:
        return f"not observable yet: {self.reason}" + ("" if self.cause is None else f"; {self.cause}")


def too_short(span_s: float, static_s: float, dynamic_s: float) -> NotObservable:
    """Return that the images so far span too short a time.

    Args:
        span_s: Time between the first and the last image [s].
        static_s: Time that a start at rest needs [s].
        dynamic_s: Time that a start in motion needs [s].
    """
    return NotObservable(
        f"{rounded_down(span_s)} s of images so far; for a start at rest {static_s:g} s are needed, in motion"
        f" {dynamic_s:g} s"
    )


def uncertain_velocity(speed_m_s: float, sigma_m_s: float, allowed_m_s: float) -> NotObservable:
    """Return that a velocity is too uncertain; all arguments in m/s."""
    return NotObservable(
        f"a velocity of {speed_m_s:.2f} ± {sigma_m_s:.2f} m/s, ± {allowed_m_s:.2f} m/s is needed: acceleration, and"
        " motion sideways past near objects, help"
    )


def rounded_down(value: float) -> str:
    """Return a positive number with two decimals that does not exceed it, so that it reads as less than a limit."""
    return f"{math.floor(100.0 * value + 1e-6) / 100.0:.2f}"


def implausible_imu(gyro_rad_s: Array, accel_m_s2: Array, gravity_m_s2: float) -> NotObservable | None:
    """Return why the readings of an IMU cannot be used, or None where they can.

    Args:
        gyro_rad_s: (N, 3) Angular velocities during an initialization [rad/s].
        accel_m_s2: (N, 3) Specific forces [m/s²].
        gravity_m_s2: Magnitude of gravity [m/s²].
    """
    if len(accel_m_s2) == 0:
        return NotObservable("no samples of the IMU at the times of the images: check its time stamps")
    force_m_s2 = float(np.median(np.linalg.norm(accel_m_s2, axis=1)))
    if _is_about(force_m_s2, gravity_m_s2):
        return None
    expected = f"where about {gravity_m_s2:.2f} is expected"
    low, rate, high = np.quantile(np.linalg.norm(gyro_rad_s, axis=1), [0.25, 0.5, 0.75]).tolist()
    if force_m_s2 < gravity_m_s2 and _is_about(rate, gravity_m_s2) and high - low < MAX_GRAVITY_SPREAD * rate:
        reason = f"a median specific force of {force_m_s2:.2f} m/s², {expected}, at a constant {rate:.2f} rad/s"
        return NotObservable(reason, Cause.SENSORS_SWAPPED)
    return NotObservable(f"a median specific force of {force_m_s2:.2f} m/s², {expected}", Cause.FORCE_IS_NOT_GRAVITY)


def _is_about(value: float, gravity_m_s2: float) -> bool:
    """Return whether a magnitude may be that of gravity."""
    return 1.0 / MAX_GRAVITY_RATIO < value / gravity_m_s2 < MAX_GRAVITY_RATIO
