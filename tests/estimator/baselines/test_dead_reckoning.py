"""Dead reckoning against a motion in closed form."""

import numpy as np
import pytest

from dronevio.estimator.baselines.dead_reckoning import DeadReckoning
from dronevio.models.arrays import Array
from dronevio.models.imu import GRAVITY_M_S2, ImuSamples
from dronevio.models.rig import euroc_rig
from dronevio.models.rotation import exp_so3
from dronevio.models.state import CameraFrame, Estimate, Health

RATE_HZ, STATIONARY_S = 200, 1.0
GYRO_BIAS_RAD_S = np.array([0.01, -0.02, 0.03])
ANGULAR_VELOCITY_RAD_S, ACCEL_WORLD_M_S2 = np.array([0.0, 0.0, 0.8]), np.array([0.3, -0.2, 0.1])


def run(duration_s: float, accel_noise_m_s2: float = 0.0) -> tuple[list[Estimate], Array]:
    """Run the estimator on a stationary phase followed by constant yaw rate and acceleration.

    Returns:
        Estimates at 20 Hz, and their times (N,) [s].
    """
    t_ns = np.arange(0, round(duration_s * RATE_HZ) + 1) * (10**9 // RATE_HZ)
    moving_s = np.clip(t_ns * 1e-9 - STATIONARY_S, 0.0, None)
    is_moving = (t_ns * 1e-9 >= STATIONARY_S)[:, None]
    R_world_imu = exp_so3(moving_s[:, None] * ANGULAR_VELOCITY_RAD_S)
    force_world = is_moving * ACCEL_WORLD_M_S2 + [0.0, 0.0, GRAVITY_M_S2]
    noise = accel_noise_m_s2 * np.random.default_rng(0).normal(size=(len(t_ns), 3))
    gyro = is_moving * ANGULAR_VELOCITY_RAD_S + GYRO_BIAS_RAD_S
    imu = ImuSamples(t_ns, gyro, np.einsum("nji,nj->ni", R_world_imu, force_world) + noise)
    estimator, estimates, start = DeadReckoning(euroc_rig()), [], 0
    for row in range(0, len(t_ns), 10):
        estimator.add_imu(imu[start : row + 1])
        estimates.append(estimator.add_frame(CameraFrame(int(t_ns[row]), ())))
        start = row + 1
    return estimates, np.asarray(t_ns[::10] * 1e-9)


def test_constant_acceleration_is_integrated_exactly() -> None:
    estimates, t_s = run(5.0)
    first, last = next(e.state for e in estimates if e.state is not None), estimates[-1].state
    assert first is not None
    assert last is not None
    np.testing.assert_allclose(first.gyro_bias_rad_s, GYRO_BIAS_RAD_S, atol=1e-12)
    R0 = first.T_world_imu[:3, :3]  # the initial yaw is arbitrary
    moving_s = t_s[-1] - STATIONARY_S
    # The interval in which the motion begins has the mean of its ends: half of the motion for 5 ms.
    np.testing.assert_allclose(last.T_world_imu[:3, 3], R0 @ ACCEL_WORLD_M_S2 * moving_s**2 / 2, atol=0.01)
    np.testing.assert_allclose(last.velocity_m_s, R0 @ ACCEL_WORLD_M_S2 * moving_s, atol=0.008)
    np.testing.assert_allclose(last.T_world_imu[:3, :3], R0 @ exp_so3(moving_s * ANGULAR_VELOCITY_RAD_S), atol=0.003)


def test_initialization_requires_a_stationary_imu() -> None:
    estimates, t_s = run(3.0)
    healths = [estimate.health for estimate in estimates]
    first = healths.index(Health.INERTIAL_ONLY)
    assert t_s[first] == pytest.approx(0.8)
    assert set(healths[first:]) == {Health.INERTIAL_ONLY}
    assert all(estimate.state is None for estimate in estimates[:first])
    assert {estimate.health for estimate in run(3.0, accel_noise_m_s2=2.0)[0]} == {Health.INITIALIZING}


def test_reports_count_the_time_since_initialization() -> None:
    reports = [estimate.health_report for estimate in run(3.0)[0] if estimate.state is not None]
    times_s = [report.inertial_only_s for report in reports if report is not None]
    np.testing.assert_allclose(times_s, 0.05 * np.arange(len(reports)), atol=1e-9)


def test_position_sigma_grows() -> None:
    states = [estimate.state for estimate in run(5.0)[0] if estimate.state is not None]
    sigmas = [np.sqrt(np.diag(state.covariance)[3:6]).max() for state in states if state.covariance is not None]
    assert len(sigmas) == len(states)
    assert np.all(np.diff(sigmas) > 0.0)
    assert sigmas[-1] > 1.0
