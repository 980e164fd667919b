"""Zero-velocity detection: the vehicle is stationary while the image does not move and the IMU agrees."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from dronevio.estimator.imu.buffer import Increments
from dronevio.estimator.types import Observations, common_rows
from dronevio.models.arrays import median
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.ranges import Range, Settings

MOTION_DETECTION_DELAY_S = 0.2
"""Longest time between the start of a motion and its detection in the image [s]: it takes half a pixel of flow."""
AVERAGING_S = 0.05
"""Time over which the IMU is averaged at any frame rate, so that noise and vibration are not taken for motion [s]."""
TIME_TOLERANCE_S = 0.001
"""Tolerance of that time, because time stamps are rounded and jitter [s]."""


@dataclass(frozen=True)
class ZeroVelocityConfig(Settings):
    """Settings of the zero-velocity detection."""

    max_flow_px: Annotated[float, Range(low=0.0)] = 0.6
    """Largest median displacement of the features since the start of the stationary interval [px]."""
    min_features: Annotated[int, Range(1, 10_000)] = 10
    """Smallest number of features common to both ends of the interval; a dark image does not prove zero velocity."""
    max_gyro_rad_s: Annotated[float, Range(low=0.0)] = 0.2
    """Largest mean angular velocity over a twentieth of a second, including the bias [rad/s]."""
    max_accel_error_m_s2: Annotated[float, Range(low=0.0)] = 1.0
    """Largest difference between the mean specific force and gravity, including the bias [m/s²]."""


class ZeroVelocityDetector:
    """Measures the time since the last motion, relative to a reference frame that is replaced whenever one occurs."""

    def __init__(self, config: ZeroVelocityConfig, gravity_m_s2: float = GRAVITY_M_S2) -> None:
        """Begin before the first frame.

        Args:
            config: Settings.
            gravity_m_s2: Magnitude of gravity [m/s²].
        """
        self._config, self._gravity_m_s2 = config, gravity_m_s2
        self._recent: tuple[Increments, ...] = ()  # of the last frames, over which the IMU is averaged
        self._reference: Observations | None = None
        self._reference_ns = 0
        self._now_ns = 0

    @property
    def stationary_s(self) -> float:
        """Time without motion up to the newest frame [s]."""
        return (self._now_ns - self._reference_ns) * 1e-9

    def update(self, t_ns: int, observations: Observations | None, increments: Increments) -> None:
        """Add the features of a frame and the IMU increments since the previous frame.

        Args:
            t_ns: Time of the frame [ns].
            observations: The features; None if the frame has no image. The IMU alone is tested then, and the features
                of the next image are compared with the same reference.
            increments: The IMU increments since the previous frame.
        """
        self._now_ns = t_ns
        self._recent = _newest((*self._recent, increments)) if len(increments.dt_s) else ()
        if self._reference is None or self._has_moved(self._reference, observations, increments):
            self._reference, self._reference_ns = observations, t_ns

    def _has_moved(self, reference: Observations, now: Observations | None, increments: Increments) -> bool:
        if len(increments.dt_s) == 0 or self._imu_moves():
            return True
        if now is None:
            return False
        i, j = common_rows(reference.ids, now.ids)
        if len(i) < self._config.min_features:
            return True
        flow_px = float(median(np.linalg.norm(now.pixels[j] - reference.pixels[i], axis=1)))
        return flow_px > self._config.max_flow_px

    def _imu_moves(self) -> bool:
        """Return whether the mean readings over the newest increments are not those of a stationary IMU."""
        c = self._config
        gyro, accel = (
            float(np.linalg.norm(np.concatenate(readings).mean(axis=0)))
            for readings in zip(*((part.gyro_rad_s, part.accel_m_s2) for part in self._recent), strict=True)
        )
        return gyro > c.max_gyro_rad_s or abs(accel - self._gravity_m_s2) > c.max_accel_error_m_s2


def _newest(parts: tuple[Increments, ...]) -> tuple[Increments, ...]:
    """Return the fewest of some increments, the newest ones, that last for `AVERAGING_S`, or all of them."""
    duration_s = sum(part.duration_s for part in parts)
    while parts and duration_s - parts[0].duration_s >= AVERAGING_S - TIME_TOLERANCE_S:
        duration_s -= parts[0].duration_s
        parts = parts[1:]
    return parts
