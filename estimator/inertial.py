"""The inertial side: a buffer of IMU increments, and their preintegration between keyframes.

Preintegration after Forster et al., "On-manifold preintegration for real-time visual-inertial odometry", T-RO 2017,
with GTSAM's combined factor, which lets the biases walk.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
import numpy.typing as npt

from dronevio.models.imu import GRAVITY_M_S2, ImuModel, ImuSamples
from dronevio.models.rotation import exp_so3

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class InertialConfig:
    """How far the IMU is trusted."""

    noise_inflation: float = 5.0
    """Factor on the data sheet's white-noise densities: vibration, sampling and scale errors are not in them."""
    walk_inflation: float = 1.0
    """Factor on the data sheet's bias random walks."""
    least_gyro_random_walk: float = 1e-5
    """The gyroscope's bias is believed to walk at least so much [rad/s²/√Hz]: errors of scale and misalignment look
    like a bias that changes with the motion, and GTSAM cannot solve for biases that hardly may move."""
    least_accel_random_walk: float = 1e-3
    """The same of the accelerometer's bias [m/s³/√Hz]: half a percent of scale error is 0.05 m/s² that turns with the
    drone."""
    integration_sigma: float = 1e-4
    """Position error that integration itself makes [m/√s]."""


@dataclass(frozen=True, eq=False)
class Increments:
    """Mean rates over consecutive intervals that add up to a stretch of time."""

    dt_s: Array
    """(N,) Lengths of the intervals [s]."""
    gyro_rad_s: Array
    """(N, 3) Mean angular velocity [rad/s]."""
    accel_m_s2: Array
    """(N, 3) Mean specific force in the frame at the interval's start [m/s²]."""

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
    )


class ImuBuffer:
    """Holds the samples that came in, and hands them out up to the time of a frame."""

    def __init__(self) -> None:
        self._samples: ImuSamples | None = None
        self._start_ns: int | None = None  # everything up to here has been handed out

    def add(self, samples: ImuSamples) -> None:
        """Append later samples."""
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
        if held and last == len(increments) and (last == 0 or ends[-1] < t_ns):
            ends = np.append(ends, t_ns)
            gyro = np.vstack([gyro, samples.gyro_rad_s[-1:]])
            accel = np.vstack([accel, samples.accel_m_s2[-1:]])
        dt_s = np.diff(ends, prepend=start) * 1e-9
        kept = dt_s > 0.0
        return Increments(dt_s[kept], gyro[kept], accel[kept])

    def _forget_before(self, t_ns: int) -> None:
        assert self._samples is not None
        self._start_ns = t_ns
        # Keep the sample at or before t: points are averaged with their predecessor.
        first = int(np.searchsorted(self._samples.t_ns, t_ns, side="right")) - 1
        self._samples = self._samples[max(first, 0) :]


def preintegration_params(imu: ImuModel, config: InertialConfig) -> gtsam.PreintegrationCombinedParams:
    """Return GTSAM's parameters for an IMU in a world whose z axis points up."""
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(GRAVITY_M_S2)
    eye = np.eye(3)
    params.setGyroscopeCovariance(eye * (config.noise_inflation * imu.gyro_noise_density) ** 2)
    params.setAccelerometerCovariance(eye * (config.noise_inflation * imu.accel_noise_density) ** 2)
    params.setIntegrationCovariance(eye * config.integration_sigma**2)
    gyro_walk = max(config.walk_inflation * imu.gyro_random_walk, config.least_gyro_random_walk)
    accel_walk = max(config.walk_inflation * imu.accel_random_walk, config.least_accel_random_walk)
    params.setBiasOmegaCovariance(eye * gyro_walk**2)
    params.setBiasAccCovariance(eye * accel_walk**2)
    return params


def integrate(preintegrated: gtsam.PreintegratedCombinedMeasurements, increments: Increments) -> None:
    """Add increments to a preintegration."""
    for dt, gyro, accel in zip(increments.dt_s.tolist(), increments.gyro_rad_s, increments.accel_m_s2, strict=True):
        preintegrated.integrateMeasurement(accel, gyro, dt)
