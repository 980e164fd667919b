"""The IMU factors of the calibration, against an independent integration and numerical derivatives."""

from dataclasses import fields

import gtsam
import numpy as np
import pytest

from dronevio.estimator.baselines.dead_reckoning import preintegrate
from dronevio.estimator.calibration.imu_factor import CalibrationImuFactors
from dronevio.estimator.imu.buffer import Increments
from dronevio.estimator.imu.preintegration import Preintegration, PreintegrationConfig, PreintegrationParams
from dronevio.models.arrays import Array
from dronevio.models.imu import EUROC_IMU
from dronevio.models.rotation import exp_so3, log_so3

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
def factors(increments: Increments, bias: Array) -> CalibrationImuFactors:
    """Two factors, of all increments and of their first half."""
    params = PreintegrationParams.of(EUROC_IMU, PreintegrationConfig(), GRAVITY_M_S2)
    measurements = []
    for part in (increments, half(increments)):
        pim = Preintegration(params, gtsam.imuBias.ConstantBias(bias[3:], bias[:3]))
        pim.integrate(part)
        measurements.append(pim.measurements)
    return CalibrationImuFactors.from_preintegrated(measurements, bias, [GRAVITY_M_S2, GRAVITY_M_S2])


def half(increments: Increments) -> Increments:
    """Return the first half of some increments."""
    n = len(increments.dt_s) // 2
    return Increments(increments.dt_s[:n], increments.gyro_rad_s[:n], increments.accel_m_s2[:n])


def test_measurements_agree_with_direct_integration(
    factors: CalibrationImuFactors, increments: Increments, bias: Array
) -> None:
    """Rotation, position and velocity, and their derivatives by the biases."""
    for i, part in enumerate((increments, half(increments))):

        def integrated(bias: Array, part: Increments = part) -> tuple[Array, Array]:
            dR, dv, dp = preintegrate(part, bias[:3], bias[3:])
            return dR, np.concatenate([dp, dv])

        rotation, position_velocity = integrated(bias)
        assert factors.dt_s[i] == pytest.approx(part.duration_s)
        np.testing.assert_allclose(factors.rotation[i], rotation, atol=1e-5)  # GTSAM integrates on the tangent space
        np.testing.assert_allclose(factors.position_velocity[i], position_velocity, atol=1e-3)
        h, J = 1e-5, np.zeros((9, 6))
        for axis, step in enumerate(h * np.eye(6)):
            (R_ahead, pv_ahead), (R_behind, pv_behind) = integrated(bias + step), integrated(bias - step)
            J[:, axis] = np.concatenate([log_so3(R_behind.T @ R_ahead), pv_ahead - pv_behind]) / (2.0 * h)
        for rows in (slice(0, 3), slice(3, 6), slice(6, 9)):
            for columns in (slice(0, 3), slice(3, 6)):
                np.testing.assert_allclose(
                    factors.J_bias[i, rows, columns], J[rows, columns], atol=0.03 * np.abs(J[rows]).max()
                )


@pytest.mark.parametrize("correction_scale", [0.0, 1.0])
def test_jacobian_is_the_derivative_of_the_residual(factors: CalibrationImuFactors, correction_scale: float) -> None:
    """The residuals are zero where three keyframes agree with the IMU.

    Their Jacobians by all 26 variables are evaluated at the biases of the preintegration, and at corrected ones.
    """
    bias = correction_scale * np.array([1e-3, -2e-3, 1e-3, 0.02, 0.01, -0.02])
    R, p, v = [exp_so3(np.array([0.4, -0.7, 1.5]))], [np.array([0.2, 0.1, -0.3])], [np.array([1.0, -0.5, 0.3])]
    for t, rotation, (dp, dv) in zip(
        factors.dt_s, factors.rotation, factors.position_velocity.reshape(-1, 2, 3), strict=True
    ):
        p.append(p[-1] + v[-1] * t + 0.5 * GRAVITY * t**2 + R[-1] @ dp)
        v.append(v[-1] + GRAVITY * t + R[-1] @ dv)
        R.append(R[-1] @ rotation)

    def residual(i: int, delta: Array) -> tuple[Array, Array]:
        """Return residual and Jacobian of a factor after a change of its keyframes, the biases, gravity and scale."""
        R_changed, p_changed, v_changed = np.stack(R), np.stack(p), np.stack(v)
        rotation, position, velocity = np.swapaxes(delta[:18].reshape(2, 3, 3), 0, 1)
        R_changed[i : i + 2] = R_changed[i : i + 2] @ exp_so3(rotation)
        p_changed[i : i + 2] += position
        v_changed[i : i + 2] += velocity
        gravity_m_s2, scale = GRAVITY_M_S2 + delta[24], delta[25]
        r, J = factors.residuals(R_changed, p_changed, v_changed, bias + delta[18:24], gravity_m_s2, scale)
        return r[i], J[i]

    h = 1e-6
    for i in range(len(factors)):
        r, J = residual(i, np.zeros(26))
        if correction_scale == 0.0:
            np.testing.assert_allclose(r, 0.0, atol=1e-12)
        steps = h * np.eye(26)
        expected = np.stack([(residual(i, e)[0] - residual(i, -e)[0]) / (2.0 * h) for e in steps], axis=1)
        np.testing.assert_allclose(J, expected, atol=1e-3)


def test_a_scale_of_the_gyroscope_explains_rates_that_are_larger(factors: CalibrationImuFactors) -> None:
    """A rotation that is larger by 2 % about its axis agrees with the IMU if the scale is."""
    R = np.stack([np.eye(3), exp_so3(1.02 * log_so3(factors.rotation[0]))])
    one = CalibrationImuFactors(*(getattr(factors, each.name)[:1] for each in fields(factors)))
    states = R, np.zeros((2, 3)), np.zeros((2, 3))
    unscaled, scaled = (one.residuals(*states, np.zeros(6), GRAVITY_M_S2, scale)[0][0, :3] for scale in (0.0, 0.02))
    assert np.linalg.norm(unscaled) > 1e-3
    np.testing.assert_allclose(scaled, 0.0, atol=1e-12)


def test_no_factors() -> None:
    """A single keyframe has no factor."""
    factors = CalibrationImuFactors.from_preintegrated([], np.zeros(6), [])
    r, J = factors.residuals(np.eye(3)[None], np.zeros((1, 3)), np.zeros((1, 3)), np.zeros(6), GRAVITY_M_S2, 0.0)
    assert len(factors) == 0
    assert (r.shape, J.shape) == ((0, 9), (0, 9, 26))
