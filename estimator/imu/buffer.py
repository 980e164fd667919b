"""A buffer of IMU samples, handed out as increments up to the time of a frame."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from dronevio.estimator.imu.saturation import MIN_ACCEL_RANGE_M_S2, MIN_GYRO_RANGE_RAD_S, SaturationDetector
from dronevio.models.imu import ImuModel, ImuSamples
from dronevio.models.rotation import exp_so3

Array = npt.NDArray[np.float64]


IMU_GAP = 4.0
"""Intervals of the IMU that have to pass without a sample to be a gap, in which nothing was measured."""
GAP_SIGMA = np.repeat([0.5, 2.0], 3)
"""How far from the mean of its ends a motion may be within a gap: standard deviations of angular velocity [rad/s] and
specific force [m/s²], those of a drone that flies swiftly."""
BEYOND_LIMIT = 0.5
"""How far beyond the sensor's limit a motion may be, relative to it. A flight through a room with 57 °/s for a limit is
beyond it by 20 % at the median, and 60 % at the 90th percentile."""
EXCESS_CORRELATION_S = 0.2
"""What is wrong with a reading in doubt is as wrong with those around it, for so long [s]."""


@dataclass(frozen=True, eq=False)
class Increments:
    """Mean rates over consecutive intervals that add up to a stretch of time."""

    dt_s: Array
    """(N,) Lengths of the intervals [s]."""
    gyro_rad_s: Array
    """(N, 3) Mean angular velocity [rad/s]."""
    accel_m_s2: Array
    """(N, 3) Mean specific force in the frame at the interval's start [m/s²]."""
    excess_sigma: Array = field(default_factory=lambda: np.zeros((1, 6)))
    """(N, 6), or (1, 6) for all: standard deviations of what is wrong with the angular velocity [rad/s] and the
    specific force [m/s²] beside the sensor's noise: a sensor at its limit, or no sample for long."""

    @property
    def is_degraded(self) -> bool:
        """Whether anything is wrong beside the sensor's noise."""
        return bool(self.excess_sigma.any())

    @property
    def rotation_excess_sigma_rad(self) -> float:
        """Standard deviation of what is wrong with the rotation beside noise, about the worst axis [rad]."""
        return float((self.dt_s[:, None] * self.excess_sigma[:, :3]).sum(axis=0).max()) if self.is_degraded else 0.0

    @property
    def excess_density(self) -> Array:
        """`excess_sigma` as the white noise (N, 6) that does as much over as long as it lasts, squared densities."""
        lasts_s = np.maximum(self.dt_s, EXCESS_CORRELATION_S)[:, None]
        return np.asarray(lasts_s * np.broadcast_to(self.excess_sigma, (len(lasts_s), 6)) ** 2)

    @property
    def longest_s(self) -> float:
        """Longest of the intervals [s]."""
        return float(self.dt_s.max(initial=0.0))

    def rotation(self, gyro_bias_rad_s: Array) -> Array:
        """Return R_start_end (3, 3)."""
        R = np.eye(3)
        for step in exp_so3((self.gyro_rad_s - gyro_bias_rad_s) * self.dt_s[:, None]):
            R = R @ step
        return R


NO_INCREMENTS = Increments(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))
"""Of no time at all."""


def joined(parts: Sequence[Increments]) -> Increments:
    """Return consecutive increments, at least one part of them, as one."""
    return Increments(
        np.concatenate([part.dt_s for part in parts]),
        np.concatenate([part.gyro_rad_s for part in parts]),
        np.concatenate([part.accel_m_s2 for part in parts]),
        np.concatenate([np.broadcast_to(part.excess_sigma, (len(part.dt_s), 6)) for part in parts]),
    )


class ImuBuffer:
    """Holds the samples that came in, and hands them out up to the time of a frame."""

    def __init__(self, imu: ImuModel | None = None) -> None:
        """Begin without samples.

        Args:
            imu: What the sensor is; if not given, its gaps are not known.
        """
        self._longest_s = np.inf if imu is None else IMU_GAP / imu.rate_hz
        self._gyro_limit = SaturationDetector(np.inf if imu is None else imu.gyro_range_rad_s, MIN_GYRO_RANGE_RAD_S)
        self._accel_limit = SaturationDetector(np.inf if imu is None else imu.accel_range_m_s2, MIN_ACCEL_RANGE_M_S2)
        self._samples: ImuSamples | None = None
        self._start_ns: int | None = None  # everything up to here has been handed out

    def add(self, samples: ImuSamples) -> None:
        """Append later samples."""
        self._gyro_limit.update(samples.gyro_rad_s)
        self._accel_limit.update(samples.accel_m_s2)
        self._samples = samples if self._samples is None else self._samples.extended(samples)

    def take_until(self, t_ns: int) -> Increments:
        """Return the increments from where the last call ended (or the first sample) to ``t_ns``.

        An interval that ``t_ns`` cuts is shared out in proportion. Where the samples end early, the last one is held.
        """
        if self._samples is None or len(self._samples) == 0:
            return NO_INCREMENTS
        taken = self._increments(self._samples, t_ns, held=True)
        self._forget_before(t_ns)
        return taken

    def ahead(self, span_s: float) -> Increments:
        """Return the increments of the next ``span_s`` seconds after where the last call ended, as far as known.

        They stay in the buffer.
        """
        if self._samples is None or len(self._samples) == 0 or self._start_ns is None:
            return NO_INCREMENTS
        return self._increments(self._samples, self._start_ns + round(span_s * 1e9), held=False)

    def _increments(self, samples: ImuSamples, t_ns: int, held: bool) -> Increments:
        increments = samples.increments()
        start = self._start_ns if self._start_ns is not None else int(samples.t_ns[0])
        last = min(int(np.searchsorted(increments.t_ns, t_ns, side="left")) + 1, len(increments))
        ends = np.clip(increments.t_ns[:last], start, t_ns)
        gyro, accel = increments.gyro_rad_s[:last], increments.accel_m_s2[:last]
        doubt = self._doubt(samples)[:last]
        if held and last == len(increments) and (last == 0 or ends[-1] < t_ns):
            ends = np.append(ends, t_ns)
            gyro = np.vstack([gyro, samples.gyro_rad_s[-1:]])
            accel = np.vstack([accel, samples.accel_m_s2[-1:]])
            doubt = np.vstack([doubt, self._beyond_limit(samples[-1:])])
        dt_s = np.diff(ends, prepend=start) * 1e-9
        kept = dt_s > 0.0
        doubt = np.where((dt_s > self._longest_s)[:, None], np.maximum(doubt, GAP_SIGMA), doubt)
        return Increments(dt_s[kept], gyro[kept], accel[kept], doubt[kept])

    def _doubt(self, samples: ImuSamples) -> Array:
        """Return how far a motion may be beyond the sensors' limits over each of the intervals of samples (N, 6)."""
        beyond = self._beyond_limit(samples)
        return beyond if samples.sampling == "increment" else np.maximum(beyond[1:], beyond[:-1])

    def _beyond_limit(self, samples: ImuSamples) -> Array:
        """Return how far a motion may be beyond the sensors' limits at samples (N, 6)."""
        return BEYOND_LIMIT * np.hstack(
            [
                self._gyro_limit.saturation_limits(samples.gyro_rad_s),
                self._accel_limit.saturation_limits(samples.accel_m_s2),
            ]
        )

    def _forget_before(self, t_ns: int) -> None:
        assert self._samples is not None
        self._start_ns = t_ns
        # Keep the sample at or before t: points are averaged with their predecessor.
        first = int(np.searchsorted(self._samples.t_ns, t_ns, side="right")) - 1
        self._samples = self._samples[max(first, 0) :]
