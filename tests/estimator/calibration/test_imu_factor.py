"""The IMU factor of the calibration, against an independent integration and numerical derivatives."""

import gtsam
import numpy as np
import numpy.typing as npt
import pytest

from dronevio.estimator.baselines.dead_reckoning import preintegrate
from dronevio.estimator.calibration.imu_factor import CalibrationImuFactor
from dronevio.estimator.imu.buffer import Increments
from dronevio.estimator.imu.preintegration import Preintegration, PreintegrationConfig, PreintegrationParams
from dronevio.models.imu import EUROC_IMU
from dronevio.models.rotation import exp_so3, log_so3

Array = npt.NDArray[np.float64]

DT_S, STEPS = 0.005, 40
GRAVITY_M_S2 = 9.78
GRAVITY = np.array([0.0, 0.0, -GRAVITY_M_S2])


@pytest.fixture
def bias() -> Array:
    """(6,) Biases of gyroscope and accelerometer, about those of a low-cost IMU."""
    return np.array([0.01, -0.02, 0.015, 0.1, -0.05, 0.08])


@pytest.fixture
def increments() -> Increments:
    """0.2 s of changing motion."""
    t = DT_S * np.arange(STEPS)[:, None]
    gyro = np.array([0.6, -0.8, 0.4]) + 0.3 * np.sin(5.0 * t + [0.0, 1.0, 2.0])
    accel = np.array([2.0, -1.0, 9.0]) + 1.5 * np.sin(7.0 * t + [2.0, 0.0, 1.0])
    return Increments(np.full(STEPS, DT_S), gyro, accel)


@pytest.fixture
def factor(increments: Increments, bias: Array) -> CalibrationImuFactor:
    params = PreintegrationParams.of(EUROC_IMU, PreintegrationConfig(), GRAVITY_M_S2)
    pim = Preintegration(params, gtsam.imuBias.ConstantBias(bias[3:], bias[:3]))
    pim.integrate(increments)
    return CalibrationImuFactor.from_preintegrated(pim.measurements, bias, GRAVITY_M_S2)


def test_measurement_agrees_with_direct_integration(
    factor: CalibrationImuFactor, increments: Increments, bias: Array
) -> None:
    """Rotation, position and velocity, and their derivatives by the biases."""

    def integrated(bias: Array) -> tuple[Array, Array]:
        dR, dv, dp = preintegrate(increments, bias[:3], bias[3:])
        return dR, np.concatenate([dp, dv])

    rotation, position_velocity = integrated(bias)
    np.testing.assert_allclose(factor.rotation, rotation, atol=1e-5)  # GTSAM integrates on the tangent space
    np.testing.assert_allclose(factor.position_velocity, position_velocity, atol=1e-3)
    h, J = 1e-5, np.zeros((9, 6))
    for axis, step in enumerate(h * np.eye(6)):
        (R_ahead, pv_ahead), (R_behind, pv_behind) = integrated(bias + step), integrated(bias - step)
        J[:, axis] = np.concatenate([log_so3(R_behind.T @ R_ahead), pv_ahead - pv_behind]) / (2.0 * h)
    for rows in (slice(0, 3), slice(3, 6), slice(6, 9)):
        for columns in (slice(0, 3), slice(3, 6)):
            np.testing.assert_allclose(
                factor.J_bias[rows, columns], J[rows, columns], atol=0.03 * np.abs(J[rows]).max()
            )


@pytest.mark.parametrize("correction_scale", [0.0, 1.0])
def test_jacobian_is_the_derivative_of_the_residual(factor: CalibrationImuFactor, correction_scale: float) -> None:
    """The residual is zero where two keyframes agree with the IMU.

    Its Jacobian by all 25 variables is evaluated at the biases of the preintegration, and at corrected ones.
    """
    t, R_start = STEPS * DT_S, exp_so3(np.array([0.4, -0.7, 1.5]))
    v_start, bias = np.array([1.0, -0.5, 0.3]), correction_scale * np.array([1e-3, -2e-3, 1e-3, 0.02, 0.01, -0.02])
    dp, dv = factor.position_velocity.reshape(2, 3)
    R = np.stack([R_start, R_start @ factor.rotation])
    p = np.stack([np.zeros(3), v_start * t + 0.5 * GRAVITY * t**2 + R_start @ dp])
    v = np.stack([v_start, v_start + GRAVITY * t + R_start @ dv])

    def residual(delta: Array) -> tuple[Array, Array]:
        rotation, position, velocity = np.swapaxes(delta[:18].reshape(2, 3, 3), 0, 1)
        return factor.residual(
            R @ exp_so3(rotation), p + position, v + velocity, bias + delta[18:24], GRAVITY_M_S2 + delta[24]
        )

    r, J = residual(np.zeros(25))
    if correction_scale == 0.0:
        np.testing.assert_allclose(r, 0.0, atol=1e-12)
    h = 1e-6
    expected = np.stack([(residual(h * e)[0] - residual(-h * e)[0]) / (2.0 * h) for e in np.eye(25)], axis=1)
    np.testing.assert_allclose(J, expected, atol=1e-3)
