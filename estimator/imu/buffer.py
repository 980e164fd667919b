"""A buffer of IMU samples that returns the increments up to the time of a frame.

Samples are at the limit of a sensor's range, or missing, more often than data sheets suggest. The buffer detects both
and attaches to each increment the standard deviation of the error that this may cause. Outliers are removed before.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from dronevio.estimator.imu.outliers import OutlierFilter
from dronevio.estimator.imu.saturation import MIN_ACCEL_RANGE_M_S2, MIN_GYRO_RANGE_RAD_S, SaturationDetector
from dronevio.models.arrays import Array
from dronevio.models.imu import IMU_GAP_INTERVALS, ImuModel, ImuSamples
from dronevio.models.rotation import integrated_rotations

GAP_SIGMA = np.repeat([0.5, 2.0], 3)
"""Standard deviations of angular velocity [rad/s] and specific force [m/s²] within a gap, about the mean of the samples
at its ends: those of a drone in fast flight."""
SATURATION_SIGMA = 0.5
"""Standard deviation of the error of a saturated reading, relative to the sensor's range."""
EXCESS_CORRELATION_S = 0.2
"""Correlation time of the errors within a gap and of saturated readings [s]."""


@dataclass(frozen=True, eq=False)
class Increments:
    """Mean angular velocities and specific forces over N consecutive intervals."""

    dt_s: Array
    """(N,) Lengths of the intervals [s]."""
    gyro_rad_s: Array
    """(N, 3) Mean angular velocity [rad/s]."""
    accel_m_s2: Array
    """(N, 3) Mean specific force in the IMU frame at the start of the interval [m/s²]."""
    excess_sigma: Array = field(default_factory=lambda: np.zeros((1, 6)))
    """(N, 6) or (1, 6) Standard deviations of errors of the angular velocity [rad/s] and specific force [m/s²] beyond
    the sensor's noise, due to saturation or gaps; one row holds for all intervals."""

    def __getitem__(self, rows: slice) -> "Increments":
        """Return some of the intervals."""
        excess = self.excess_sigma if len(self.excess_sigma) == 1 else self.excess_sigma[rows]
        return Increments(self.dt_s[rows], self.gyro_rad_s[rows], self.accel_m_s2[rows], excess)

    @property
    def is_degraded(self) -> bool:
        """Whether any increment has an error beyond the sensor's noise."""
        return bool(self.excess_sigma.any())

    @property
    def rotation_excess_sigma_rad(self) -> float:
        """Standard deviation of the excess error of the rotation, about the worst axis [rad]."""
        return float((self.dt_s[:, None] * self.excess_sigma[:, :3]).sum(axis=0).max()) if self.is_degraded else 0.0

    @property
    def excess_density(self) -> Array:
        """(N, 6) Squared densities of white noise with the same effect as `excess_sigma` over its correlation time."""
        correlation_s = np.maximum(self.dt_s, EXCESS_CORRELATION_S)[:, None]
        return np.asarray(correlation_s * np.broadcast_to(self.excess_sigma, (len(correlation_s), 6)) ** 2)

    @property
    def duration_s(self) -> float:
        """Sum of the intervals [s]."""
        return float(self.dt_s.sum())

    @property
    def longest_s(self) -> float:
        """Longest of the intervals [s]."""
        return float(self.dt_s.max(initial=0.0))

    def rotation(self, gyro_bias_rad_s: Array) -> Array:
        """Return R_start_end (3, 3) for a gyroscope bias (3,) [rad/s]."""
        return np.asarray(integrated_rotations((self.gyro_rad_s - gyro_bias_rad_s) * self.dt_s[:, None])[-1])

    def angular_velocity(self, gyro_bias_rad_s: Array) -> Array:
        """Return the last angular velocity (3,), zero without any, for a gyroscope bias (3,) [rad/s]."""
        return self.gyro_rad_s[-1] - gyro_bias_rad_s if len(self.dt_s) else np.zeros(3)


NO_INCREMENTS = Increments(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))
"""The increments of an empty interval."""


def joined(parts: Sequence[Increments]) -> Increments:
    """Return consecutive increments, at least one part, as one object."""
    return Increments(
        np.concatenate([part.dt_s for part in parts]),
        np.concatenate([part.gyro_rad_s for part in parts]),
        np.concatenate([part.accel_m_s2 for part in parts]),
        np.concatenate([np.broadcast_to(part.excess_sigma, (len(part.dt_s), 6)) for part in parts]),
    )


class ImuBuffer:
    """Stores incoming samples until the frames that follow them are processed."""

    def __init__(self, imu: ImuModel | None = None) -> None:
        """Begin without samples.

        Args:
            imu: The sensor model; without it, neither gaps nor saturation are detected by nominal values.
        """
        self._longest_s = np.inf if imu is None else IMU_GAP_INTERVALS / imu.rate_hz
        self._gyro_limit = SaturationDetector(np.inf if imu is None else imu.gyro_range_rad_s, MIN_GYRO_RANGE_RAD_S)
        self._accel_limit = SaturationDetector(np.inf if imu is None else imu.accel_range_m_s2, MIN_ACCEL_RANGE_M_S2)
        self._outliers = OutlierFilter(imu)
        self._received: list[ImuSamples] = []  # not joined before they are used, since no frame may come for hours
        self._start_ns: int | None = None  # the samples up to here have been returned

    @property
    def outliers(self) -> int:
        """Number of samples that have been removed as outliers so far."""
        return self._outliers.rejected

    def add(self, samples: ImuSamples) -> ImuSamples:
        """Append later samples without outliers, and return what has been appended; see `OutlierFilter.add`."""
        samples = self._outliers.add(samples)
        self._gyro_limit.update(samples.gyro_rad_s)
        self._accel_limit.update(samples.accel_m_s2)
        if len(samples):
            if self._received:
                self._received[-1].check_order(samples)
            self._received.append(samples)
        return samples

    def take_until(self, t_ns: int) -> Increments:
        """Remove and return the increments from the end of the last call (or the first sample) to ``t_ns``.

        An interval that contains ``t_ns`` is divided in proportion. Where samples are missing, the last one is held.
        """
        if not self._received:
            return NO_INCREMENTS
        samples = self._joined()
        # Later samples than the first after t make no difference, and there may be those of a whole flight.
        after = int(np.searchsorted(samples.t_ns, t_ns, side="right"))
        taken = self._increments(samples[: after + 1], t_ns, held=True)
        self._start_ns = t_ns
        # The sample at or before t stays: the midpoint rule averages a sample with its predecessor.
        self._received = [samples[max(after - 1, 0) :]]
        return taken

    def ahead(self, span_s: float, *, held: bool = False) -> Increments:
        """Return the increments of the next ``span_s`` seconds after the end of the last `take_until`, if available.

        They stay in the buffer. Where samples are missing, the last one is held if ``held`` is true.
        """
        if not self._received or self._start_ns is None or span_s <= 0.0:
            return NO_INCREMENTS
        return self._increments(self._joined(), self._start_ns + round(span_s * 1e9), held)

    def _joined(self) -> ImuSamples:
        """Return the samples in the buffer, of which there is one at least."""
        self._received = [ImuSamples.concatenated(self._received)]
        return self._received[0]

    def _increments(self, samples: ImuSamples, t_ns: int, held: bool) -> Increments:
        increments = samples.increments()
        start = self._start_ns if self._start_ns is not None else int(samples.t_ns[0])
        last = min(int(np.searchsorted(increments.t_ns, t_ns, side="left")) + 1, len(increments))
        ends = np.minimum(np.maximum(increments.t_ns[:last], start), t_ns)
        gyro, accel = increments.gyro_rad_s[:last], increments.accel_m_s2[:last]
        excess = self._interval_excess(samples)[:last]
        if held and last == len(increments) and (last == 0 or ends[-1] < t_ns):
            ends = np.concatenate([ends, [t_ns]])
            gyro = np.concatenate([gyro, samples.gyro_rad_s[-1:]])
            accel = np.concatenate([accel, samples.accel_m_s2[-1:]])
            excess = np.concatenate([excess, self._saturation_sigma(samples[-1:])])
        dt_s = (ends - np.concatenate([[start], ends[:-1]])) * 1e-9
        kept, is_gap = dt_s > 0.0, dt_s > self._longest_s
        if is_gap.any():
            excess[is_gap] = np.maximum(excess[is_gap], GAP_SIGMA)
        return Increments(dt_s[kept], gyro[kept], accel[kept], excess[kept])

    def _interval_excess(self, samples: ImuSamples) -> Array:
        """Return the excess standard deviations (M, 6) of the intervals of samples, due to saturation."""
        excess = self._saturation_sigma(samples)
        return excess if samples.sampling == "increment" else np.maximum(excess[1:], excess[:-1])

    def _saturation_sigma(self, samples: ImuSamples) -> Array:
        """Return the excess standard deviations (N, 6) of samples; zero where they are within the range."""
        gyro = self._gyro_limit.saturation_limits(samples.gyro_rad_s)
        accel = self._accel_limit.saturation_limits(samples.accel_m_s2)
        return SATURATION_SIGMA * np.concatenate([gyro, accel], axis=1)
