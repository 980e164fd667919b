"""Where an inertial sensor has reached the end of its range, and what it reads is only the least of what there is.

The range is often not known, or wrong: so many sensors can be set to so many. It shows: a triad at its limit repeats
its own largest reading, to the last digit, while noise lets a sensor within its range do that for no longer than by
chance. What was taken for the limit was none as soon as it is exceeded.
"""

import numpy as np
import numpy.typing as npt

from dronevio.models.imu import STANDARD_GRAVITY_M_S2

Array = npt.NDArray[np.float64]

MIN_GYRO_RANGE_RAD_S = 0.5
"""No gyroscope's range is smaller [rad/s]: the smallest that are sold have 2. At rest, a coarse one repeats itself."""
MIN_ACCEL_RANGE_M_S2 = 1.5 * STANDARD_GRAVITY_M_S2
"""No accelerometer's range is smaller [m/s²]: the smallest that are sold have 2 g. At rest, it repeats gravity."""
REPEATED = 4
"""So many equal readings at the largest one so far are no chance: noise of three steps lets one in 10⁴ be so."""
CLOSE = 1e-3
"""Readings so near to the limit, relative to it, have reached it: two's complement reaches one step further down."""


class SaturationDetector:
    """Learns where the readings of three axes end."""

    def __init__(self, stated: float, least: float) -> None:
        """Begin with what is known of a triad.

        Args:
            stated: Its range, either way; infinite if it is not known.
            least: A range that it has at least.
        """
        self._limit, self._largest = stated, least
        self._last = np.zeros((0, 3))

    @property
    def limit(self) -> float:
        """Where its readings end, either way, as far as that is known; else infinite."""
        return self._limit

    def update(self, values: Array) -> None:
        """Take readings (N, 3), later than those before."""
        values = np.concatenate([self._last, values])
        self._last = values[len(values) - REPEATED + 1 :] if len(values) >= REPEATED else values
        largest = float(np.abs(values).max(initial=0.0))
        if largest > self._limit * (1.0 + CLOSE):
            self._limit = np.inf
        self._largest = max(self._largest, largest)
        if len(values) < REPEATED or largest < self._largest:
            return
        repeated = np.ptp(np.lib.stride_tricks.sliding_window_view(values, REPEATED, axis=0), axis=2) == 0.0
        if np.any(repeated & (np.abs(values[REPEATED - 1 :]) == largest)):
            self._limit = largest

    def saturation_limits(self, values: Array) -> Array:
        """Return the limit where readings (N, 3) have reached it, and zero elsewhere."""
        return np.where(np.abs(values) >= (1.0 - CLOSE) * self._limit, self._limit, 0.0)
