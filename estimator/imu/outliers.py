"""Outlying samples of an IMU: single readings, or a few in succession, that its neighbours do not allow.

A defective transfer or a bit error shows as a reading far from those before and after it, which agree with each other.
A real jolt is different: it passes the filters of the sensor, and the structure rings, so that it lasts several samples
and does not end where it began. What is far is measured by the differences between successive samples over the last
hundred or so, so that vibration and fast manoeuvres raise the threshold (the robust scale of Hampel, "The influence
curve and its role in robust estimation", JASA 1974, for differences).

Readings at the limit of the range are left to `dronevio.estimator.imu.saturation`.
"""

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array, median
from dronevio.models.imu import ImuModel, ImuSamples

MAX_RUN = 3
"""Largest number of successive outliers. More are a motion, or a fault that nothing can interpolate."""
MIN_DISTANCE = np.array([0.3, 3.0])
"""Smallest distance of an outlier from its neighbours, for gyroscope [rad/s] and accelerometer [m/s²]: above what a
knock on a resting vehicle causes."""
SCALE_RATIO = 6.0
"""Smallest ratio of that distance to the typical difference between successive samples. In flight on real vehicles it
reaches 4."""
RETURN_RATIO = 0.25
"""Largest ratio between the difference of the samples before and after outliers, and the distance of the outliers.
The sample after, or if this is the next outlier the one after that, must be as near: an impact leaves the vehicle
ringing."""
LOOKAHEAD = 3
"""Number of samples after outliers that decide."""
RETURN_SCALES = 2.0
"""Such a difference is always small enough if it is below this multiple of the typical difference."""
BLOCK = 16
"""Number of samples over which the median of the differences is taken."""
UNJUDGED = 8
"""Number of samples at the beginning that are accepted, from which the first typical difference is taken."""
BLOCKS = 8
"""Number of blocks whose largest median is the typical difference. Vibration that begins counts after half a block."""
LIMIT_TOLERANCE = 1e-3
"""Relative distance to the range of a reading that is clipped."""


def outlying_samples(samples: ImuSamples, imu: ImuModel | None = None) -> npt.NDArray[np.bool_]:
    """Return the mask (N,) of the outliers of gyroscope or accelerometer.

    Args:
        samples: Samples of a recording, of either sampling.
        imu: Its `ImuModel.gyro_range_rad_s` and `ImuModel.accel_range_m_s2` tell clipped readings from outliers.
    """
    kept = OutlierFilter(imu).add(samples).t_ns
    decided = samples.t_ns <= kept[-1] if len(kept) else np.zeros(len(samples), dtype=bool)
    return np.asarray(decided & ~np.isin(samples.t_ns, kept))


class OutlierFilter:
    """Removes outliers from a stream of samples.

    A sample that is far from the one before is withheld until those after it decide: at most `MAX_RUN` + `LOOKAHEAD`.
    All others are returned at once. The result does not depend on how the stream is divided.

    Where a point is removed, the midpoint rule interpolates its neighbours; the interval of a removed mean takes the
    mean of the next one.
    """

    def __init__(self, imu: ImuModel | None = None) -> None:
        """Begin before the first sample.

        Args:
            imu: Tells the range of the sensors; without it, the range is unknown.
        """
        self._range = np.array([np.inf, np.inf] if imu is None else [imu.gyro_range_rad_s, imu.accel_range_m_s2])
        self._rejected = 0
        self._withheld: ImuSamples | None = None
        self._last: Array | None = None  # (2, 3) the last accepted readings of gyroscope and accelerometer
        self._differences = np.zeros((0, 2))  # between the last accepted readings, as many as a block has
        self._in_block = BLOCK - UNJUDGED  # number of these in the block that is not complete
        self._medians = np.full((1, 2), np.inf)  # of the last blocks; infinite before the first

    @property
    def rejected(self) -> int:
        """Number of samples that have been removed so far."""
        return self._rejected

    def add(self, samples: ImuSamples) -> ImuSamples:
        """Return the accepted samples among those withheld before and later ones."""
        if self._withheld is not None:
            samples = self._withheld.extended(samples)
        n = len(samples)
        values = np.concatenate([samples.gyro_rad_s, samples.accel_m_s2], axis=1).reshape(n, 2, 3)
        is_kept, row = np.ones(n, dtype=bool), 0
        while row < n:
            near = self._accept_near(values[row:])
            row += near
            if near:
                continue
            run = self._run(values[row : row + MAX_RUN + LOOKAHEAD])
            if run is None:
                break
            is_kept[row : row + run] = False
            self._rejected += run
            row += run
            if run == 0:
                self._accept(values[row : row + 1], self._differences_of(values[row : row + 1]))
                row += 1
        self._withheld = samples[row:] if row < n else None
        if is_kept.all():
            return samples if row == n else samples[:row]
        rows = np.flatnonzero(is_kept[:row])
        return ImuSamples(samples.t_ns[rows], samples.gyro_rad_s[rows], samples.accel_m_s2[rows], samples.sampling)

    def _accept_near(self, values: Array) -> int:
        """Accept the first of the readings (N, 2, 3), as long as each is near the one before; return their number."""
        values = values[: BLOCK - self._in_block]
        differences = self._differences_of(values)
        is_far = (differences > self._threshold(self._medians.max(axis=0))).any(axis=1)
        near = int(is_far.argmax()) if is_far.any() else len(values)
        self._accept(values[:near], differences[:near])
        return near

    def _accept(self, values: Array, differences: Array) -> None:
        """Accept readings (N, 2, 3) of one block with their differences (N, 2) to the one before."""
        if not len(values):
            return
        self._differences = np.concatenate([self._differences, differences])[-BLOCK:]
        self._last, self._in_block = values[-1], (self._in_block + len(values)) % BLOCK
        if self._in_block == 0:
            known = self._medians[np.isfinite(self._medians).all(axis=1)]
            self._medians = np.concatenate([known, median(self._differences)[None]])[-BLOCKS:]

    def _run(self, values: Array) -> int | None:
        """Return the number of outliers at the beginning of readings (N, 2, 3), or None where later ones decide."""
        assert self._last is not None, "the first reading is near itself"
        judged = ~self._is_clipped(values[0])
        for run in range(1, min(MAX_RUN, len(values) - LOOKAHEAD) + 1):
            before, after = self._last, values[run]
            share = (np.arange(1, run + 1) / (run + 1))[:, None, None]
            distance = _length(values[:run] - (before + share * (after - before))).min(axis=0)
            # What follows shows whether the vehicle shakes.
            following = _length(values[run + 1 : run + LOOKAHEAD] - after)
            local = np.median(np.concatenate([self._differences, following[:1]]), axis=0)
            scale = np.maximum(local, self._medians.max(axis=0))
            allowed = np.maximum(RETURN_RATIO * distance, RETURN_SCALES * scale)
            is_calm = (_length(after - before) <= allowed) & (following.min(axis=0) <= allowed)
            if np.any(judged & is_calm & (distance > self._threshold(scale))):
                return run
        return 0 if len(values) == MAX_RUN + LOOKAHEAD else None

    def _differences_of(self, values: Array) -> Array:
        """Return the lengths (N, 2) of the differences of readings (N, 2, 3) to the one before."""
        before = values[:1] if self._last is None else self._last[None]
        return _length(values - np.concatenate([before, values[:-1]]))

    def _is_clipped(self, reading: Array) -> npt.NDArray[np.bool_]:
        """Return whether gyroscope and accelerometer (2,) are at the limit of their range in a reading (2, 3)."""
        excess = np.abs(reading) / self._range[:, None] - 1.0
        return np.asarray((np.abs(excess) <= LIMIT_TOLERANCE).any(axis=1))

    @staticmethod
    def _threshold(scale: Array) -> Array:
        """Return the smallest distances (2,) of outliers for typical differences (2,)."""
        return np.asarray(np.maximum(MIN_DISTANCE, SCALE_RATIO * scale))


def _length(vectors: Array) -> Array:
    """Return the lengths (...) of vectors (..., 3)."""
    return np.asarray(np.sqrt((vectors * vectors).sum(axis=-1)))
