"""Accelerometer and gyroscope that are recorded apart, each with time stamps of its own.

The samples of an IMU have both. As drivers do that unite them, the specific force is interpolated at the time stamps of
the gyroscope, which is the faster one of the two in general.
"""

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.imu import IMU_GAP_INTERVALS, Times


def interpolated_accel(gyro_t_ns: Times, accel_t_ns: Times, accel_m_s2: Array) -> tuple[npt.NDArray[np.int64], Array]:
    """Return the specific force at the time stamps of the gyroscope.

    Args:
        gyro_t_ns: (N,) Time stamps of the gyroscope, in any order [ns].
        accel_t_ns: (M,) Time stamps of the accelerometer, in any order [ns].
        accel_m_s2: (M, 3) Specific force [m/s²].

    Returns:
        The rows (K,) of the gyroscope at whose times the specific force is known, in their order, and the specific
        force (K, 3) [m/s²]. Unknown are the times before the first sample of the accelerometer, after the last one, and
        between two that are more than `IMU_GAP_INTERVALS` intervals apart.
    """
    t_ns, first = np.unique(accel_t_ns, return_index=True)
    if not len(t_ns):
        return np.zeros(0, np.int64), np.zeros((0, 3))
    values = accel_m_s2[first]
    after = np.searchsorted(t_ns, gyro_t_ns, side="left")
    before, after = np.maximum(np.searchsorted(t_ns, gyro_t_ns, side="right") - 1, 0), np.minimum(after, len(t_ns) - 1)
    intervals_ns = np.diff(t_ns)
    longest_ns = IMU_GAP_INTERVALS * float(np.median(intervals_ns)) if len(intervals_ns) else 0.0
    is_known = (gyro_t_ns >= t_ns[0]) & (gyro_t_ns <= t_ns[-1]) & (t_ns[after] - t_ns[before] <= longest_ns)
    rows = np.flatnonzero(is_known)
    elapsed_s, known_s = (gyro_t_ns[rows] - t_ns[0]) * 1e-9, (t_ns - t_ns[0]) * 1e-9
    return rows, np.stack([np.interp(elapsed_s, known_s, axis) for axis in values.T], axis=1)
