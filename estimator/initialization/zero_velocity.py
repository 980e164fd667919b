"""Says whether the drone stands still: the image does not move, and the IMU agrees."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.estimator.imu.buffer import Increments
from dronevio.estimator.types import Observations
from dronevio.models.imu import GRAVITY_M_S2

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class ZeroVelocityConfig:
    """What counts as standing still."""

    max_flow_px: float = 0.6
    """Largest median displacement of the features since the rest began [px]."""
    min_features: int = 10
    """Features that both ends of the rest must share: a dark image does not prove rest."""
    max_gyro_rad_s: float = 0.2
    """Largest mean turn rate between frames [rad/s], bias included."""
    max_accel_error_m_s2: float = 1.0
    """Largest difference of the mean specific force from gravity's magnitude [m/s²], bias included."""


class ZeroVelocityDetector:
    """Measures for how long nothing has moved, against an anchor frame that is renewed as soon as something does."""

    def __init__(self, config: ZeroVelocityConfig) -> None:
        self._config = config
        self._anchor: Observations | None = None
        self._anchor_ns = 0
        self._now_ns = 0

    @property
    def stationary_s(self) -> float:
        """Time since the anchor frame [s], during which nothing moved."""
        return (self._now_ns - self._anchor_ns) * 1e-9

    def update(self, t_ns: int, observations: Observations, increments: Increments) -> None:
        """Take a frame's observations and the IMU increments since the previous frame."""
        self._now_ns = t_ns
        if self._anchor is None or self._moved(self._anchor, observations, increments):
            self._anchor, self._anchor_ns = observations, t_ns

    def _moved(self, anchor: Observations, now: Observations, increments: Increments) -> bool:
        c = self._config
        _, i, j = np.intersect1d(anchor.ids, now.ids, assume_unique=True, return_indices=True)
        if len(i) < c.min_features or len(increments.dt_s) == 0:
            return True
        flow_px = float(np.median(np.linalg.norm(now.pixels[j] - anchor.pixels[i], axis=1)))
        gyro = float(np.linalg.norm(increments.gyro_rad_s.mean(axis=0)))
        accel = float(np.linalg.norm(increments.accel_m_s2.mean(axis=0)))
        return flow_px > c.max_flow_px or gyro > c.max_gyro_rad_s or abs(accel - GRAVITY_M_S2) > c.max_accel_error_m_s2
