"""Detection of saturated readings of an inertial sensor whose range is unknown or configured otherwise.

A saturated axis repeats the largest reading so far exactly, while noise keeps a sensor within its range from doing so.
A limit that is detected by chance is discarded as soon as a reading exceeds it.
"""

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.imu import STANDARD_GRAVITY_M_S2

MIN_GYRO_RANGE_RAD_S = 0.5
"""Lower bound of a gyroscope's range [rad/s], below the smallest on the market (2 rad/s). A coarse gyroscope at rest
repeats readings below this bound."""
MIN_ACCEL_RANGE_M_S2 = 1.5 * STANDARD_GRAVITY_M_S2
"""Lower bound of an accelerometer's range [m/s²], below the smallest on the market (2 g). An accelerometer at rest
repeats gravity."""
MIN_REPETITIONS = 4
"""Number of equal consecutive readings of a saturated axis. With noise of three quantization steps, one reading in 10⁴
repeats so often."""
RELATIVE_TOLERANCE = 1e-3
"""Relative distance to the limit of a saturated reading; the two limits of two's complement differ by one step."""


class SaturationDetector:
    """Estimates the range of a triad of sensors from its readings."""

    def __init__(self, nominal_range: float, min_range: float) -> None:
        """Create a detector.

        Args:
            nominal_range: Range by the data sheet, in both directions; infinite if unknown.
            min_range: Lower bound of the range; smaller readings are never taken for saturated.
        """
        self._limit, self._largest = nominal_range, min_range
        self._last = np.zeros((0, 3))

    @property
    def limit(self) -> float:
        """Magnitude at which readings saturate; infinite if unknown."""
        return self._limit

    def update(self, values: Array) -> None:
        """Add consecutive readings (N, 3)."""
        values = np.concatenate([self._last, values])
        self._last = values[len(values) - MIN_REPETITIONS + 1 :] if len(values) >= MIN_REPETITIONS else values
        largest = float(np.abs(values).max(initial=0.0))
        if largest > self._limit * (1.0 + RELATIVE_TOLERANCE):
            self._limit = np.inf
        self._largest = max(self._largest, largest)
        if len(values) < MIN_REPETITIONS or largest < self._largest:
            return
        windows = np.lib.stride_tricks.sliding_window_view(values, MIN_REPETITIONS, axis=0)
        is_constant = np.ptp(windows, axis=2) == 0.0
        if np.any(is_constant & (np.abs(values[MIN_REPETITIONS - 1 :]) == largest)):
            self._limit = largest

    def saturation_limits(self, values: Array) -> Array:
        """Return the limit (N, 3) where readings (N, 3) are saturated, and zero elsewhere."""
        return np.where(np.abs(values) >= (1.0 - RELATIVE_TOLERANCE) * self._limit, self._limit, 0.0)
