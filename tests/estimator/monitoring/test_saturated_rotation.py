"""Rotation beyond the range of the gyroscope: what the images show of it, and flights with a saturated gyroscope."""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dronevio.estimator.imu.buffer import Increments
from dronevio.estimator.monitoring.innovation import Innovation, PredictionUncertainty
from dronevio.estimator.monitoring.saturated_rotation import (
    MIN_LANDMARKS,
    SIGMA_INFLATION,
    missing_rotation,
    saturated_sigma_rad,
    with_rotation,
)
from dronevio.eval.metrics.alignment import align
from dronevio.models.arrays import Array
from dronevio.models.rotation import exp_so3
from dronevio.models.state import Estimate, Health, Trajectory

if TYPE_CHECKING:
    from tests.estimator.conftest import SyntheticFlight

MakeFlight = Callable[..., "SyntheticFlight"]

FOCAL_PX = 450.0
SATURATED_SIGMA = np.array([0.02, 0.0, 0.0])
FAST = {"angle_rates": np.array([[1.5, 2.5], [1.1, 2.7], [0.9, 2.3]])}
RANGE_RAD_S = 0.7


def innovation_after(rotation_rad: Array, rng: np.random.Generator, outliers: int = 0, count: int = 60) -> Innovation:
    """Return the innovation of a frame whose prediction lacks a rotation, with 0.1 px of noise and 1 mm of error."""
    points = rng.uniform([-2.0, -2.0, 3.0], [2.0, 2.0, 6.0], (count, 3))  # the IMU frame is that of the camera
    seen = (points - 0.001 * rng.standard_normal(3)) @ exp_so3(rotation_rad)
    xy = points[:, :2] / points[:, 2:]
    residual_px = FOCAL_PX * (seen[:, :2] / seen[:, 2:] - xy) + 0.1 * rng.standard_normal(xy.shape)
    residual_px[:outliers] += rng.uniform(-20.0, 20.0, (outliers, 2))
    axes = np.broadcast_to(np.eye(3), (count, 3, 3))
    J = (FOCAL_PX / points[:, 2])[:, None, None] * (axes[:, :2] - xy[:, :, None] * axes[:, 2:])
    uncertainty = PredictionUncertainty(1e-6 * np.eye(3), 1e-8, 0.01)
    R, focal_px = exp_so3(np.array([0.2, -0.4, 1.0])), np.full(count, FOCAL_PX)
    return Innovation(np.arange(count), residual_px, points, J, R, focal_px, np.ones(count), uncertainty)


def saturated_increments() -> Increments:
    """Return ten increments of 5 ms, of which four are saturated about x, and one of these about z."""
    excess = np.zeros((10, 6))
    excess[3:7, 0], excess[5, 2] = 0.5, 0.5
    return Increments(np.full(10, 0.005), np.ones((10, 3)), np.ones((10, 3)), excess)


def clipped(flight: "SyntheticFlight") -> "SyntheticFlight":
    """Return a flight with a gyroscope that saturates."""
    imu = flight.imu
    limited = np.clip(imu.gyro_rad_s, -RANGE_RAD_S, RANGE_RAD_S)
    assert (limited != imu.gyro_rad_s).any(axis=1).mean() > 0.2
    saturated = replace(flight)
    saturated.__dict__.update(imu=replace(imu, gyro_rad_s=limited))
    return saturated


def error_m(flight: "SyntheticFlight", estimates: list[Estimate]) -> float:
    """Return the absolute trajectory error, aligned in position and yaw [m]."""
    states = Trajectory.from_states(e.state for e in estimates if e.state is not None)
    truth = flight.truth_at(states.t_ns)
    fit = align(truth.p_world_imu, states.p_world_imu, "yaw")
    errors_m = truth.p_world_imu - fit.positions(states.p_world_imu)
    return float(np.sqrt(np.mean(np.sum(errors_m**2, axis=1))))


@pytest.mark.parametrize("angle_rad", [-0.02, 0.0, 0.01])
def test_the_missing_rotation_is_found(angle_rad: float) -> None:
    """The estimate errs by its standard deviation; a fifth of outliers does little harm."""
    rng, true = np.random.default_rng(0), np.array([angle_rad, 0.0, 0.0])
    errors = []
    for _ in range(50):
        found = missing_rotation(innovation_after(true, rng), SATURATED_SIGMA)
        assert found is not None
        rotation_rad, sigma_rad = found
        assert sigma_rad[0] < 5e-4
        errors.append((rotation_rad[0] - angle_rad) / sigma_rad[0])
    assert abs(np.mean(errors)) < 0.7
    assert np.std(errors) < 1.2
    for _ in range(20):
        found = missing_rotation(innovation_after(true, rng, outliers=12), SATURATED_SIGMA)
        assert found is not None
        assert abs(found[0][0] - angle_rad) < 1e-3


def test_rotation_about_other_axes_is_not_taken_for_missing() -> None:
    """An error of the prediction about an axis within the range is not attributed to the saturated axis."""
    found = missing_rotation(innovation_after(np.array([0.0, 0.002, 0.0]), np.random.default_rng(0)), SATURATED_SIGMA)
    assert found is not None
    assert abs(found[0][0]) < 3e-4


def test_few_landmarks_show_no_rotation() -> None:
    few = innovation_after(np.zeros(3), np.random.default_rng(0), count=MIN_LANDMARKS - 1)
    assert missing_rotation(few, SATURATED_SIGMA) is None


def test_a_rotation_is_added_to_saturated_readings() -> None:
    measured = saturated_increments()
    np.testing.assert_allclose(saturated_sigma_rad(measured), [0.01, 0.0, 0.0025])
    rotation_rad, sigma_rad = np.array([0.02, 0.7, -0.001]), np.array([1e-4, 1e-4, 1.0])
    found = with_rotation(measured, measured, rotation_rad, sigma_rad)
    added = found.gyro_rad_s - measured.gyro_rad_s
    np.testing.assert_allclose(found.dt_s @ added, [0.02, 0.0, -0.001], atol=1e-12)
    np.testing.assert_array_equal(added != 0.0, measured.excess_sigma[:, :3] > 0.0)
    np.testing.assert_allclose(found.excess_sigma[3:7, 0], SIGMA_INFLATION * 1e-4 / 0.02)
    assert found.excess_sigma[5, 2] == 0.5  # never less certain than without the images
    np.testing.assert_array_equal(found.accel_m_s2, measured.accel_m_s2)


def test_a_gap_of_the_imu_is_not_taken_for_saturation() -> None:
    measured = saturated_increments()
    gap = replace(measured, excess_sigma=measured.excess_sigma + [0.0, 0.0, 0.0, 2.0, 2.0, 2.0])
    assert not saturated_sigma_rad(gap).any()
    found = with_rotation(gap, gap, np.full(3, 0.01), np.full(3, 1e-4))
    np.testing.assert_array_equal(found.gyro_rad_s, gap.gyro_rad_s)
    np.testing.assert_array_equal(found.excess_sigma, gap.excess_sigma)


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.slow
def test_a_flight_with_a_saturated_gyroscope_is_as_accurate(make_flight: MakeFlight, seed: int) -> None:
    """It tracks but for the take-off, with an error within twice that of the same flight with a sufficient range."""
    flight = make_flight(seed, motion=FAST)
    estimates = clipped(flight).run()
    first = next(i for i, e in enumerate(estimates) if e.health is Health.TRACKING)
    assert sum(e.health is not Health.TRACKING for e in estimates[first:]) <= 2
    assert error_m(flight, estimates) < max(2.0 * error_m(flight, flight.run()), 0.01)
