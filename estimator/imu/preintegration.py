"""Preintegration of the IMU between keyframes.

After Forster et al., "On-manifold preintegration for real-time visual-inertial odometry", T-RO 2017, with GTSAM's
combined factor, which models the biases as random walks.
"""

from dataclasses import dataclass, replace
from typing import Annotated, Self

import gtsam
import numpy as np

from dronevio.estimator.imu.buffer import Increments
from dronevio.models.imu import GRAVITY_M_S2, ImuModel
from dronevio.models.ranges import Range, Settings


@dataclass(frozen=True)
class PreintegrationConfig(Settings):
    """Settings of the IMU preintegration."""

    gyro_noise_inflation: Annotated[float, Range(0.01, 1e3)] = 2.0
    """Factor on the data sheet's white noise of the gyroscope, until the noise is estimated in flight."""
    accel_noise_inflation: Annotated[float, Range(0.01, 1e3)] = 5.0
    """Factor on the data sheet's white noise of the accelerometer, until the noise is estimated in flight. It is larger
    than the gyroscope's because the accelerometer senses the vibration of the airframe."""
    min_gyro_noise_density: Annotated[float, Range(0.0, 1.0)] = 3e-4
    """Smallest white noise of the gyroscope until it is estimated in flight [rad/s/√Hz]: that of the airframe, which is
    in no data sheet."""
    min_accel_noise_density: Annotated[float, Range(0.0, 10.0)] = 1e-2
    """Smallest white noise of the accelerometer until it is estimated in flight [m/s²/√Hz], for the same reason."""
    walk_inflation: Annotated[float, Range(0.0, 1e3)] = 1.0
    """Factor on the data sheet's random walks of both biases."""
    min_gyro_random_walk: Annotated[float, Range(0.0, 1.0)] = 1e-5
    """Smallest random walk of the gyroscope bias [rad/s²/√Hz]. It covers scale errors and misalignments, which act like
    a bias that varies with the motion, and keeps the linear system regular."""
    min_accel_random_walk: Annotated[float, Range(0.0, 10.0)] = 1e-3
    """Smallest random walk of the accelerometer bias [m/s³/√Hz], for the same reasons. A scale error of half a percent
    is an error of 0.05 m/s² that rotates with the vehicle."""
    integration_sigma: Annotated[float, Range(1e-9, 1.0)] = 1e-4
    """Standard deviation of the position error of the integration itself [m/√s]."""


@dataclass(frozen=True)
class PreintegrationParams:
    """The noise of an IMU as preintegration uses it, squared densities of white noise and random walks; and gravity."""

    gyro_variance: float
    """White noise of the gyroscope [rad²/s]."""
    accel_variance: float
    """White noise of the accelerometer [m²/s³]."""
    gyro_walk_variance: float
    """Random walk of the gyroscope bias [rad²/s³]."""
    accel_walk_variance: float
    """Random walk of the accelerometer bias [m²/s⁵]."""
    integration_variance: float
    """Error of the integrated position [m²/s]."""
    gravity_m_s2: float = GRAVITY_M_S2
    """Magnitude of gravity [m/s²]."""

    @classmethod
    def of(cls, imu: ImuModel, config: PreintegrationConfig, gravity_m_s2: float = GRAVITY_M_S2) -> Self:
        """Return the parameters of an IMU by its data sheet, inflated as configured, for a magnitude of gravity."""
        gyro_walk = max(config.walk_inflation * imu.gyro_random_walk, config.min_gyro_random_walk)
        accel_walk = max(config.walk_inflation * imu.accel_random_walk, config.min_accel_random_walk)
        return cls(
            gyro_variance=(config.gyro_noise_inflation * imu.gyro_noise_density) ** 2,
            accel_variance=(config.accel_noise_inflation * imu.accel_noise_density) ** 2,
            gyro_walk_variance=gyro_walk**2,
            accel_walk_variance=accel_walk**2,
            integration_variance=config.integration_sigma**2,
            gravity_m_s2=gravity_m_s2,
        )

    def with_noise(self, gyro_density: float, accel_density: float) -> Self:
        """Return the parameters with other densities of white noise [rad/s/√Hz] and [m/s²/√Hz]."""
        return replace(self, gyro_variance=gyro_density**2, accel_variance=accel_density**2)

    def with_walks(self, gyro_density: float, accel_density: float) -> Self:
        """Return the parameters with other random walks of the biases [rad/s²/√Hz] and [m/s³/√Hz]."""
        return replace(self, gyro_walk_variance=gyro_density**2, accel_walk_variance=accel_density**2)

    def to_gtsam(self) -> gtsam.PreintegrationCombinedParams:
        """Return a new parameter object for GTSAM, in a world whose z axis points up."""
        params, eye = gtsam.PreintegrationCombinedParams.MakeSharedU(self.gravity_m_s2), np.eye(3)
        params.setGyroscopeCovariance(eye * self.gyro_variance)
        params.setAccelerometerCovariance(eye * self.accel_variance)
        params.setIntegrationCovariance(eye * self.integration_variance)
        params.setBiasOmegaCovariance(eye * self.gyro_walk_variance)
        params.setBiasAccCovariance(eye * self.accel_walk_variance)
        return params


class Preintegration:
    """Preintegrates IMU increments at fixed biases.

    It owns GTSAM's parameter object, which nothing else refers to. GTSAM takes the noise of a measurement from there
    and from nowhere else, so a measurement with an excess error is integrated with a covariance of its own, and the
    parameters are as before when `integrate` returns.
    """

    def __init__(self, params: PreintegrationParams, bias: gtsam.imuBias.ConstantBias) -> None:
        """Begin an interval.

        Args:
            params: The noise of the IMU.
            bias: The biases at which the measurements are linearized.
        """
        self._noise, self._params = params, params.to_gtsam()
        self._measurements = gtsam.PreintegratedCombinedMeasurements(self._params, bias)

    @property
    def measurements(self) -> gtsam.PreintegratedCombinedMeasurements:
        """GTSAM's preintegrated measurements, for factors and predictions."""
        return self._measurements

    @property
    def duration_s(self) -> float:
        """Length of the interval so far [s]."""
        return float(self._measurements.deltaTij())

    def integrate(self, increments: Increments) -> None:
        """Append increments to the interval."""
        if increments.is_degraded:
            self._integrate_degraded(increments)
            return
        for dt, gyro, accel in zip(increments.dt_s.tolist(), increments.gyro_rad_s, increments.accel_m_s2, strict=True):
            self._measurements.integrateMeasurement(accel, gyro, dt)

    def _integrate_degraded(self, increments: Increments) -> None:
        """Append increments, each with a covariance of its own."""
        gyro_noise = np.eye(3) * self._noise.gyro_variance
        accel_noise = np.eye(3) * self._noise.accel_variance
        rates = increments.gyro_rad_s, increments.accel_m_s2
        for dt, gyro, accel, excess in zip(increments.dt_s.tolist(), *rates, increments.excess_density, strict=True):
            self._params.setGyroscopeCovariance(gyro_noise + np.diag(excess[:3]))
            self._params.setAccelerometerCovariance(accel_noise + np.diag(excess[3:]))
            self._measurements.integrateMeasurement(accel, gyro, dt)
        self._params.setGyroscopeCovariance(gyro_noise)
        self._params.setAccelerometerCovariance(accel_noise)
