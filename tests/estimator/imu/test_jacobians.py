"""The transition matrix of dead reckoning, against derivatives of the integration."""

import numpy as np
import pytest

from dronevio.estimator.baselines.dead_reckoning import preintegrate
from dronevio.estimator.imu.buffer import Increments
from dronevio.estimator.imu.covariance import propagate_covariance
from dronevio.models.arrays import Array
from dronevio.models.imu import GRAVITY_M_S2, ImuModel
from dronevio.models.rotation import exp_so3, log_so3

GRAVITY = np.array([0.0, 0.0, -GRAVITY_M_S2])
NOISELESS = ImuModel("none", 200.0, 0.0, 0.0, 0.0, 0.0)
DT_S = 0.005
THETA, P, V, BG, BA = (slice(3 * k, 3 * k + 3) for k in range(5))  # in the order of `NavState.covariance`
R_START = exp_so3(np.array([0.4, -0.7, 1.5]))


def changing_motion(steps: int, rate_rad_s: float) -> Increments:
    """Return increments of a changing motion whose angular velocity is of the order of a rate [rad/s]."""
    t = DT_S * np.arange(steps)[:, None]
    gyro = rate_rad_s * (np.array([0.6, -0.8, 0.4]) + 0.3 * np.sin(5.0 * t + [0.0, 1.0, 2.0]))
    accel = np.array([2.0, -1.0, 9.0]) + 1.5 * np.sin(7.0 * t + [2.0, 0.0, 1.0])
    return Increments(np.full(steps, DT_S), gyro, accel)


def transition(increments: Increments) -> Array:
    """Return the transition matrix (15, 15) of `propagate_covariance`, signs included.

    An initial covariance e eᵀ, for a unit vector e, becomes f fᵀ, where f is the matrix's column; it is read off the
    row of e itself, where f is positive: a state changes little within the interval.
    """
    dR, dv, dp = preintegrate(increments, np.zeros(3), np.zeros(3))
    F, dt_s = np.zeros((15, 15)), float(increments.dt_s.sum())
    for i, e in enumerate(np.eye(15)):
        propagated = propagate_covariance(np.outer(e, e), R_START, dR=dR, dp=dp, dv=dv, dt_s=dt_s, imu=NOISELESS)
        F[:, i] = propagated[i] / np.sqrt(propagated[i, i])
    return F


def numerical_transition(increments: Increments) -> Array:
    """Return the derivative (15, 15) of the state at the end of an interval by that at the start."""

    def end(delta: Array) -> list[Array]:
        R, t = R_START @ exp_so3(delta[THETA]), float(increments.dt_s.sum())
        dR, dv, dp = preintegrate(increments, delta[BG], delta[BA])
        p = delta[P] + delta[V] * t + 0.5 * GRAVITY * t**2 + R @ dp
        return [R @ dR, p, delta[V] + GRAVITY * t + R @ dv, delta[BG], delta[BA]]

    h = 1e-6
    columns = []
    for step in h * np.eye(15):
        ahead, behind = end(step), end(-step)
        rotation = log_so3(behind[0].T @ ahead[0])
        columns.append(np.concatenate([rotation, *(a - b for a, b in zip(ahead[1:], behind[1:], strict=True))]))
    return np.stack(columns, axis=1) / (2.0 * h)


def test_bias_columns_at_constant_rotation() -> None:
    """Without rotation, a bias b of the accelerometer changes the velocity by −R b t and the position by −R b t²/2."""
    t, F = 40 * DT_S, transition(changing_motion(40, rate_rad_s=0.0))
    np.testing.assert_allclose(F[V, BA], -t * R_START, atol=1e-12)
    np.testing.assert_allclose(F[P, BA], -0.5 * t**2 * R_START, atol=1e-12)
    np.testing.assert_allclose(F[THETA, BG], -t * np.eye(3), atol=1e-12)
    np.testing.assert_allclose(F[BG, BG], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(F[BA, BA], np.eye(3), atol=1e-12)
    assert not F[THETA, BA].any()


@pytest.mark.parametrize("rate_rad_s", [0.0, 1.0])
@pytest.mark.parametrize("steps", [5, 20, 40])
def test_transition_is_the_derivative_of_integration(steps: int, rate_rad_s: float) -> None:
    """Exact for orientation, position and velocity, and of first order in the angle ω t for the biases."""
    increments = changing_motion(steps, rate_rad_s)
    F, expected = transition(increments), numerical_transition(increments)
    np.testing.assert_allclose(F[:, :9], expected[:, :9], atol=1e-7)
    angle = np.linalg.norm(increments.gyro_rad_s, axis=1).max() * steps * DT_S
    assert angle < 0.3
    for rows, columns in ((V, BG), (P, BG)):  # the rotation that turns a step's specific force is that at its start
        error = np.linalg.norm(F[rows, columns] - expected[rows, columns], 2)
        assert error < (angle + 2.0 / steps) * np.linalg.norm(expected[rows, columns], 2)
    for rows, columns in ((THETA, BG), (V, BA), (P, BA)):
        error = np.linalg.norm(F[rows, columns] - expected[rows, columns], 2)
        assert error < (angle + 1e-6) * np.linalg.norm(expected[rows, columns], 2)
