"""Covariances of the navigation state: conversion from and to GTSAM's order, and propagation by dead reckoning.

The order of `NavState` is δθ (right perturbation, IMU frame), δp and δv (world frame), δb_gyro, δb_accel. GTSAM's is
the pose (δθ, then δp in the IMU frame), the velocity (world frame), the accelerometer bias, the gyroscope bias.
"""

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.imu import ImuModel
from dronevio.models.rotation import skew

_BIASES_SWAPPED = np.r_[0:9, 12:15, 9:12]


def covariance_from_gtsam(P: Array, R_world_imu: Array) -> Array:
    """Return the covariance (15, 15) in the order of `NavState`.

    Args:
        P: (15, 15) Covariance in GTSAM's order.
        R_world_imu: (3, 3) Orientation of the state.
    """
    S = np.eye(15)
    S[3:6, 3:6] = R_world_imu
    return np.asarray((S @ P @ S.T)[np.ix_(_BIASES_SWAPPED, _BIASES_SWAPPED)])


def covariance_to_gtsam(P: Array, R_world_imu: Array) -> Array:
    """Return the covariance (15, 15) in GTSAM's order.

    Args:
        P: (15, 15) Covariance in the order of `NavState`.
        R_world_imu: (3, 3) Orientation of the state.
    """
    S = np.eye(15)
    S[3:6, 3:6] = R_world_imu.T
    return np.asarray(S @ P[np.ix_(_BIASES_SWAPPED, _BIASES_SWAPPED)] @ S.T)


def propagate_covariance(
    P: Array,
    R_world_imu: Array,
    *,
    dR: Array,
    dp: Array,
    dv: Array,
    dt_s: float,
    imu: ImuModel,
    noise: Array | None = None,
) -> Array:
    """Return the covariance (15, 15) after an interval of dead reckoning.

    The transition matrix is exact for orientation, position and velocity, and of first order in the rotation for the
    biases, which suffices for some tenths of a second (Forster et al., "On-manifold preintegration for real-time
    visual-inertial odometry", T-RO 2017, eq. 44, in the world frame).

    Args:
        P: (15, 15) Covariance at the start, in the order of `NavState`.
        R_world_imu: (3, 3) Orientation at the start.
        dR: (3, 3) Preintegrated rotation.
        dp: (3,) Preintegrated position, in the IMU frame at the start [m].
        dv: (3,) Preintegrated velocity, in the IMU frame at the start [m/s].
        dt_s: Length of the interval [s].
        imu: Noise densities.
        noise: (9, 9) Covariance of the preintegrated rotation, position and velocity, the latter two in the IMU frame
            at the start; by default it follows from the noise densities.
    """
    eye, t = np.eye(3), dt_s
    F = np.eye(15)
    F[0:3, 0:3], F[0:3, 9:12] = dR.T, -t * eye
    F[3:6, 0:3], F[3:6, 6:9], F[3:6, 12:15] = -R_world_imu @ skew(dp), t * eye, -0.5 * t * t * R_world_imu
    F[6:9, 0:3], F[6:9, 12:15] = -R_world_imu @ skew(dv), -t * R_world_imu
    # A bias b of the gyroscope turns the specific force at time s by −s b: ∫ s a ds = t Δv − Δp, and its integral is
    # t² Δv / 6 where the specific force changes linearly with time.
    F[3:6, 9:12], F[6:9, 9:12] = R_world_imu @ skew(t * t * dv / 6.0), R_world_imu @ skew(t * dv - dp)
    gyro, accel = imu.gyro_noise_density**2, imu.accel_noise_density**2
    variances = [gyro * t, accel * t**3 / 3.0, accel * t, imu.gyro_random_walk**2 * t, imu.accel_random_walk**2 * t]
    Q = np.diag(np.repeat(variances, 3))
    if noise is not None:
        S = np.eye(9)
        S[3:6, 3:6] = S[6:, 6:] = R_world_imu
        Q[:9, :9] = S @ noise @ S.T
    return np.asarray(F @ P @ F.T + Q)
