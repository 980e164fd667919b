"""Static initialization: roll, pitch and gyroscope bias of a stationary IMU."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.estimator.imu.buffer import ImuBuffer, Increments
from dronevio.estimator.initialization.static import (
    InitialSigmas,
    initialize_static,
    level_rotation,
    mean_angular_velocity,
)
from dronevio.estimator.types import GAUGE_SIGMA
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.rotation import exp_so3

if TYPE_CHECKING:
    from tests.estimator.conftest import SyntheticFlight

MakeFlight = Callable[..., "SyntheticFlight"]

ups = st.lists(st.floats(-10.0, 10.0), min_size=3, max_size=3).map(np.array).filter(lambda v: np.linalg.norm(v) > 0.01)


@given(ups)
@settings(max_examples=200, deadline=None)
def test_level_rotation_maps_up_to_the_z_axis(up_imu: np.ndarray) -> None:
    R = level_rotation(up_imu)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    np.testing.assert_allclose(R @ up_imu, [0.0, 0.0, float(np.linalg.norm(up_imu))], atol=1e-9)
    np.testing.assert_allclose(level_rotation(3.7 * up_imu), R, atol=1e-12)  # the norm is irrelevant


@pytest.mark.parametrize("axis", [*np.eye(3), *-np.eye(3)])
def test_imu_may_be_mounted_along_any_axis(axis: np.ndarray) -> None:
    np.testing.assert_allclose(level_rotation(axis) @ axis, [0.0, 0.0, 1.0], atol=1e-15)


def stationary(up_imu: np.ndarray, gyro_bias: np.ndarray, parts: int = 16, noise: float = 0.0) -> list[Increments]:
    """Return the increments of a stationary IMU over several frames of 10 samples."""
    rng = np.random.default_rng(0)
    dt_s = rng.uniform(0.004, 0.006, (parts, 10))
    return [
        Increments(
            dt, gyro_bias + noise * rng.normal(size=(10, 3)), up_imu * GRAVITY_M_S2 + noise * rng.normal(size=(10, 3))
        )
        for dt in dt_s
    ]


@pytest.mark.parametrize("seed", range(5))
def test_tilt_and_gyro_bias_are_recovered(seed: int) -> None:
    rng = np.random.default_rng(seed)
    R_world_imu, bias = exp_so3(rng.normal(size=3)), 0.05 * rng.normal(size=3)
    up_imu = R_world_imu[2]
    state = initialize_static(123, stationary(up_imu, bias))
    assert state.t_ns == 123
    np.testing.assert_allclose(state.gyro_bias_rad_s, bias, atol=1e-14)
    np.testing.assert_allclose(state.T_world_imu[2, :3], up_imu, atol=1e-12)  # roll and pitch; yaw is free
    for zero in (state.T_world_imu[:3, 3], state.velocity_m_s, state.accel_bias_m_s2):
        np.testing.assert_array_equal(zero, np.zeros(3))


def test_noise_averages_out() -> None:
    up = np.array([1.0, 0.0, 0.0])
    state = initialize_static(0, stationary(up, np.array([0.01, 0.02, -0.03]), parts=40, noise=0.05))
    np.testing.assert_allclose(state.gyro_bias_rad_s, [0.01, 0.02, -0.03], atol=4 * 0.05 / np.sqrt(400))
    np.testing.assert_allclose(state.T_world_imu[2, :3], up, atol=4 * 0.05 / np.sqrt(400) / GRAVITY_M_S2)


def test_mean_rate_weighs_by_time() -> None:
    slow = Increments(np.array([0.3]), np.array([[1.0, 0.0, 0.0]]), np.zeros((1, 3)))
    fast = Increments(np.array([0.1]), np.array([[5.0, 0.0, 4.0]]), np.zeros((1, 3)))
    np.testing.assert_allclose(mean_angular_velocity([slow, fast]), [2.0, 0.0, 1.0])


def test_stationary_flight_is_initialized(make_flight: MakeFlight) -> None:
    flight = make_flight(3, rest_s=5.0, duration_s=2.0)
    buffer = ImuBuffer()
    buffer.add(flight.imu)
    truth = flight.truth_at(flight.frame_times_ns[:1])
    assert truth.gyro_bias_rad_s is not None and truth.accel_bias_m_s2 is not None
    increments = [buffer.take_until(int(t)) for t in flight.frame_times_ns[:21]]
    state = initialize_static(int(flight.frame_times_ns[0]), increments[1:])
    np.testing.assert_allclose(state.gyro_bias_rad_s, truth.gyro_bias_rad_s[0], atol=1e-3)
    tilt = np.arccos(state.T_world_imu[2, :3] @ truth.rotations[0, 2])
    assert tilt < 1.2 * np.linalg.norm(truth.accel_bias_m_s2[0]) / GRAVITY_M_S2  # due to the bias


def test_sigmas_are_where_they_belong() -> None:
    R = exp_so3(np.array([0.3, -1.2, 2.0]))
    P = InitialSigmas(tilt_rad=0.1, velocity_m_s=0.2, gyro_bias_rad_s=0.3, accel_bias_m_s2=0.4).covariance(R)
    np.testing.assert_allclose(P, P.T)
    world = R @ P[:3, :3] @ R.T  # rotation errors in the world frame: the one about z is yaw
    np.testing.assert_allclose(world, np.diag([0.01, 0.01, GAUGE_SIGMA**2]), atol=1e-15)
    np.testing.assert_allclose(np.sqrt(np.diag(P)[3:]), np.repeat([GAUGE_SIGMA, 0.2, 0.3, 0.4], 3))
    assert np.count_nonzero(P[:3, 3:]) == 0 and np.count_nonzero(P[3:, 3:] - np.diag(np.diag(P)[3:])) == 0
