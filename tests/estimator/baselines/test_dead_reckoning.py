"""Dead reckoning against a motion that is known in closed form."""

import numpy as np
import pytest

from dronevio.estimator.baselines.dead_reckoning import DeadReckoning
from dronevio.models.imu import GRAVITY_M_S2, ImuSamples
from dronevio.models.rig import euroc_rig
from dronevio.models.rotation import exp_so3
from dronevio.models.state import CameraFrame, Estimate, Health

RATE_HZ, REST_S = 200, 1.0
BIAS = np.array([0.01, -0.02, 0.03])
TURN_RAD_S, ACCEL_WORLD = np.array([0.0, 0.0, 0.8]), np.array([0.3, -0.2, 0.1])


def flown(duration_s: float, shake: float = 0.0) -> tuple[list[Estimate], np.ndarray]:
    """Rest, then turn about the vertical while accelerating evenly; return the estimates at 20 Hz and their times."""
    t_ns = np.arange(0, round(duration_s * RATE_HZ) + 1) * (10**9 // RATE_HZ)
    moving_s = np.clip(t_ns * 1e-9 - REST_S, 0.0, None)
    turning = (t_ns * 1e-9 >= REST_S)[:, None]
    R_world_imu = exp_so3(moving_s[:, None] * TURN_RAD_S)
    force_world = turning * ACCEL_WORLD + [0.0, 0.0, GRAVITY_M_S2]
    noise = shake * np.random.default_rng(0).normal(size=(len(t_ns), 3))
    gyro = turning * TURN_RAD_S + BIAS
    imu = ImuSamples(t_ns, gyro, np.einsum("nji,nj->ni", R_world_imu, force_world) + noise)
    estimator, estimates, start = DeadReckoning(euroc_rig()), [], 0
    for row in range(0, len(t_ns), 10):
        estimator.add_imu(imu[start : row + 1])
        estimates.append(estimator.add_frame(CameraFrame(int(t_ns[row]), ())))
        start = row + 1
    return estimates, t_ns[::10] * 1e-9


def test_constant_rate_and_acceleration_match_the_formula() -> None:
    estimates, t_s = flown(5.0)
    first, last = next(e.state for e in estimates if e.state is not None), estimates[-1].state
    assert first is not None
    assert last is not None
    np.testing.assert_allclose(first.gyro_bias_rad_s, BIAS, atol=1e-12)
    R0 = first.T_world_imu[:3, :3]  # the yaw of the start is free
    moved_s = t_s[-1] - REST_S
    # At the sample where the motion sets in, the mean of two points is half of either: 5 ms of half the motion.
    np.testing.assert_allclose(last.T_world_imu[:3, 3], R0 @ ACCEL_WORLD * moved_s**2 / 2, atol=0.01)
    np.testing.assert_allclose(last.velocity_m_s, R0 @ ACCEL_WORLD * moved_s, atol=0.008)
    np.testing.assert_allclose(last.T_world_imu[:3, :3], R0 @ exp_so3(moved_s * TURN_RAD_S), atol=0.003)


def test_it_starts_after_a_rest_and_never_while_shaken() -> None:
    estimates, t_s = flown(3.0)
    healths = [estimate.health for estimate in estimates]
    first = healths.index(Health.INERTIAL_ONLY)
    assert t_s[first] == pytest.approx(0.8)
    assert set(healths[first:]) == {Health.INERTIAL_ONLY}
    assert all(estimate.state is None for estimate in estimates[:first])
    assert {estimate.health for estimate in flown(3.0, shake=2.0)[0]} == {Health.INITIALIZING}


def test_it_says_that_it_gets_worse() -> None:
    states = [estimate.state for estimate in flown(5.0)[0] if estimate.state is not None]
    sigmas = [np.sqrt(np.diag(state.covariance)[3:6]).max() for state in states if state.covariance is not None]
    assert np.all(np.diff(sigmas) > 0.0)
    assert sigmas[-1] > 1.0
