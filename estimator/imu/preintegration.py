"""Preintegration of the IMU between keyframes.

After Forster et al., "On-manifold preintegration for real-time visual-inertial odometry", T-RO 2017, with GTSAM's
combined factor, which models the biases as random walks.
"""

from dataclasses import dataclass

import gtsam
import numpy as np

from dronevio.estimator.imu.buffer import Increments
from dronevio.models.imu import GRAVITY_M_S2, ImuModel


@dataclass(frozen=True)
class PreintegrationConfig:
    """How far the IMU is trusted."""

    gyro_noise_inflation: float = 2.0
    """Factor on the data sheet's white noise of the gyroscope, until it is learnt in flight (`imu_noise`) ..."""
    accel_noise_inflation: float = 5.0
    """... and on that of the accelerometer, which feels vibration more."""
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


def preintegration_params(imu: ImuModel, config: PreintegrationConfig) -> gtsam.PreintegrationCombinedParams:
    """Return GTSAM's parameters for an IMU in a world whose z axis points up."""
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(GRAVITY_M_S2)
    eye = np.eye(3)
    params.setGyroscopeCovariance(eye * (config.gyro_noise_inflation * imu.gyro_noise_density) ** 2)
    params.setAccelerometerCovariance(eye * (config.accel_noise_inflation * imu.accel_noise_density) ** 2)
    params.setIntegrationCovariance(eye * config.integration_sigma**2)
    gyro_walk = max(config.walk_inflation * imu.gyro_random_walk, config.least_gyro_random_walk)
    accel_walk = max(config.walk_inflation * imu.accel_random_walk, config.least_accel_random_walk)
    params.setBiasOmegaCovariance(eye * gyro_walk**2)
    params.setBiasAccCovariance(eye * accel_walk**2)
    return params


def integrate(
    preintegrated: gtsam.PreintegratedCombinedMeasurements,
    increments: Increments,
    params: gtsam.PreintegrationCombinedParams | None = None,
) -> None:
    """Add increments to a preintegration.

    Args:
        preintegrated: To what is added.
        increments: What is added.
        params: Those with which it was made; without them, readings in doubt count as any others.
    """
    if params is not None and increments.is_degraded:
        _integrate_degraded(preintegrated, increments, params)
        return
    for dt, gyro, accel in zip(increments.dt_s.tolist(), increments.gyro_rad_s, increments.accel_m_s2, strict=True):
        preintegrated.integrateMeasurement(accel, gyro, dt)


def _integrate_degraded(
    preintegrated: gtsam.PreintegratedCombinedMeasurements,
    increments: Increments,
    params: gtsam.PreintegrationCombinedParams,
) -> None:
    """Add increments, each with a covariance of its own: GTSAM looks up the parameters for each of them."""
    gyro_noise = np.array(params.getGyroscopeCovariance())  # what GTSAM returns is a view of what changes below
    accel_noise = np.array(params.getAccelerometerCovariance())
    rates = increments.gyro_rad_s, increments.accel_m_s2
    steps = zip(increments.dt_s.tolist(), *rates, increments.excess_density, strict=True)
    for dt, gyro, accel, wrong in steps:
        params.setGyroscopeCovariance(gyro_noise + np.diag(wrong[:3]))
        params.setAccelerometerCovariance(accel_noise + np.diag(wrong[3:]))
        preintegrated.integrateMeasurement(accel, gyro, dt)
    params.setGyroscopeCovariance(gyro_noise)
    params.setAccelerometerCovariance(accel_noise)
