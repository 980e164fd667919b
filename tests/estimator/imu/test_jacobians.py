"""Jacobians of dead reckoning and of the calibration's IMU factor, against derivatives of the integration itself."""

import gtsam
import numpy as np
import pytest

from dronevio.estimator.baselines.dead_reckoning import preintegrate
from dronevio.estimator.calibration.imu_factor import CalibrationImuFactor
from dronevio.estimator.imu.buffer import Increments
from dronevio.estimator.imu.covariance import propagate_covariance
from dronevio.estimator.imu.preintegration import PreintegrationConfig, integrate, preintegration_params
from dronevio.models.imu import EUROC_IMU, GRAVITY_M_S2, ImuModel
from dronevio.models.rotation import exp_so3, log_so3

GRAVITY = np.array([0.0, 0.0, -GRAVITY_M_S2])
NOISELESS = ImuModel("none", 200.0, 0.0, 0.0, 0.0, 0.0)
DT_S = 0.005
THETA, P, V, BG, BA = (slice(3 * k, 3 * k + 3) for k in range(5))  # in the order of `NavState.covariance`
R_START = exp_so3(np.array([0.4, -0.7, 1.5]))


def increments(steps: int, rate_rad_s: float) -> Increments:
    """Return a stretch of changing motion whose angular velocity is of the order of a rate [rad/s]."""
    t = DT_S * np.arange(steps)[:, None]
    gyro = rate_rad_s * (np.array([0.6, -0.8, 0.4]) + 0.3 * np.sin(5.0 * t + [0.0, 1.0, 2.0]))
    accel = np.array([2.0, -1.0, 9.0]) + 1.5 * np.sin(7.0 * t + [2.0, 0.0, 1.0])
    return Increments(np.full(steps, DT_S), gyro, accel)


def transition(steps: Increments) -> np.ndarray:
    """Return the transition matrix (15, 15) of `propagate`, signs included.

    An initial covariance e eᵀ, for a unit vector e, becomes f fᵀ, where f is the matrix's column; it is read off the
    row of e itself, where f is positive: a state changes little within the stretch.
    """
    dR, dv, dp = preintegrate(steps, np.zeros(3), np.zeros(3))
    F = np.zeros((15, 15))
    for i, e in enumerate(np.eye(15)):
        moved = propagate_covariance(
            np.outer(e, e), R_START, dR=dR, dp=dp, dv=dv, dt_s=float(steps.dt_s.sum()), imu=NOISELESS
        )
        F[:, i] = moved[i] / np.sqrt(moved[i, i])
    return F


def numerical_transition(steps: Increments) -> np.ndarray:
    """Return how the state at the end of a stretch differs by a change of that at the start (15, 15)."""

    def end(change: np.ndarray) -> list[np.ndarray]:
        R, t = R_START @ exp_so3(change[THETA]), float(steps.dt_s.sum())
        dR, dv, dp = preintegrate(steps, change[BG], change[BA])
        p = change[P] + change[V] * t + 0.5 * GRAVITY * t**2 + R @ dp
        return [R @ dR, p, change[V] + GRAVITY * t + R @ dv, change[BG], change[BA]]

    h = 1e-6
    columns = []
    for step in h * np.eye(15):
        more, less = end(step), end(-step)
        turned = log_so3(less[0].T @ more[0])
        columns.append(np.concatenate([turned, *(a - b for a, b in zip(more[1:], less[1:], strict=True))]) / (2.0 * h))
    return np.stack(columns, axis=1)


def test_bias_columns_at_constant_rotation() -> None:
    """Without a turn, a bias b of the accelerometer moves the velocity by −R b t and the position by −R b t²/2."""
    steps = increments(40, rate_rad_s=0.0)
    t, F = 40 * DT_S, transition(steps)
    np.testing.assert_allclose(F[V, BA], -t * R_START, atol=1e-12)
    np.testing.assert_allclose(F[P, BA], -0.5 * t**2 * R_START, atol=1e-12)
    np.testing.assert_allclose(F[THETA, BG], -t * np.eye(3), atol=1e-12)
    np.testing.assert_allclose(F[BG, BG], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(F[BA, BA], np.eye(3), atol=1e-12)
    assert not F[THETA, BA].any()


@pytest.mark.parametrize("rate_rad_s", [0.0, 1.0])
@pytest.mark.parametrize("steps", [5, 20, 40])
def test_transition_is_the_derivative_of_integration(steps: int, rate_rad_s: float) -> None:
    """Exact for orientation, position and velocity; of the biases, to the first order in the angle ω t."""
    stretch = increments(steps, rate_rad_s)
    F, numeric = transition(stretch), numerical_transition(stretch)
    np.testing.assert_allclose(F[:, :9], numeric[:, :9], atol=1e-7)
    angle = np.linalg.norm(stretch.gyro_rad_s, axis=1).max() * steps * DT_S
    for rows, columns in ((THETA, BG), (V, BA), (P, BA)):
        error = np.linalg.norm(F[rows, columns] - numeric[rows, columns], 2)
        assert error < (angle + 1e-6) * np.linalg.norm(numeric[rows, columns], 2)
        assert angle < 0.3


def calibration_interval(stretch: Increments, bias: np.ndarray) -> CalibrationImuFactor:
    """Return what the calibration makes of a stretch, at some biases (gyroscope, accelerometer)."""
    params = preintegration_params(EUROC_IMU, PreintegrationConfig())
    pim = gtsam.PreintegratedCombinedMeasurements(params, gtsam.imuBias.ConstantBias(bias[3:], bias[:3]))
    integrate(pim, stretch)
    return CalibrationImuFactor.from_preintegrated(pim, bias)


@pytest.fixture
def bias() -> np.ndarray:
    """Biases (gyroscope, accelerometer), about those of a cheap IMU."""
    return np.array([0.01, -0.02, 0.015, 0.1, -0.05, 0.08])


def test_calibration_interval_integrates_as_we_do(bias: np.ndarray) -> None:
    """Rotation, displacement and velocity, and how they move with the biases: those of our own integration."""
    stretch = increments(40, rate_rad_s=1.0)
    interval = calibration_interval(stretch, bias)

    def ours(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        dR, dv, dp = preintegrate(stretch, at[:3], at[3:])
        return dR, np.concatenate([dp, dv])

    R, pv = ours(bias)
    np.testing.assert_allclose(interval.rotation, R, atol=1e-5)  # GTSAM integrates on the tangent space
    np.testing.assert_allclose(interval.position_velocity, pv, atol=1e-3)
    h, numeric = 1e-5, np.zeros((9, 6))
    for axis, step in enumerate(h * np.eye(6)):
        (R_more, pv_more), (R_less, pv_less) = ours(bias + step), ours(bias - step)
        numeric[:, axis] = np.concatenate([log_so3(R_less.T @ R_more), pv_more - pv_less]) / (2.0 * h)
    for rows in (slice(0, 3), slice(3, 6), slice(6, 9)):
        for columns in (slice(0, 3), slice(3, 6)):
            scale = np.abs(numeric[rows]).max()
            np.testing.assert_allclose(interval.J_bias[rows, columns], numeric[rows, columns], atol=0.03 * scale)


@pytest.mark.parametrize("off", [0.0, 1.0])
def test_calibration_residual_moves_as_its_jacobian_says(bias: np.ndarray, off: float) -> None:
    """The residual between two keyframes: zero where they agree with the IMU, and its Jacobian by all 24 numbers.

    It is taken at the biases of the preintegration, and at some that are off by a multiple of a correction.
    """
    interval, t = calibration_interval(increments(40, rate_rad_s=1.0), bias), 40 * DT_S
    v, correction = np.array([1.0, -0.5, 0.3]), off * np.array([1e-3, -2e-3, 1e-3, 0.02, 0.01, -0.02])
    R = np.stack([R_START, R_START @ interval.rotation])
    p = np.stack([np.zeros(3), v * t + 0.5 * GRAVITY * t**2 + R_START @ interval.position_velocity[:3]])
    velocity = np.stack([v, v + GRAVITY * t + R_START @ interval.position_velocity[3:]])

    def residual(change: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        first, second = change[:9].reshape(3, 3), change[9:18].reshape(3, 3)
        turn, shift, speed = (np.stack(pair) for pair in zip(first, second, strict=True))
        return interval.residual(R @ exp_so3(turn), p + shift, velocity + speed, correction + change[18:])

    r, J = residual(np.zeros(24))
    if off == 0.0:
        np.testing.assert_allclose(r, 0.0, atol=1e-12)
    h = 1e-6
    numeric = np.stack([(residual(h * e)[0] - residual(-h * e)[0]) / (2.0 * h) for e in np.eye(24)], axis=1)
    np.testing.assert_allclose(J, numeric, atol=1e-3)
