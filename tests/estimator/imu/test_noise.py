"""Estimation of the IMU's noise densities by variance components."""

from collections.abc import Callable, Sequence
from dataclasses import astuple, replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dronevio.estimator.imu.buffer import NO_INCREMENTS, Increments
from dronevio.estimator.imu.noise import (
    ImuNoiseEstimator,
    ImuVarianceComponents,
    NoiseDensityEstimator,
    NoiseEstimationConfig,
    VarianceComponent,
    is_white,
    stationary_densities,
)
from dronevio.estimator.imu.preintegration import PreintegrationConfig
from dronevio.estimator.initialization.static import InitialSigmas
from dronevio.models.arrays import Array
from dronevio.models.imu import EUROC_IMU, ImuSamples
from dronevio.models.state import NavState

if TYPE_CHECKING:
    from tests.estimator.conftest import KeyframeFeed, SyntheticFlight


DT_S = 0.2
DENSITY = 2e-3


def estimated(true_factor: float, initial_factor: float, reference_sigma: float, intervals: int = 1000) -> list[float]:
    """Return the ratio of the estimated noise density to the data sheet, after each of some intervals.

    In each interval a motion is measured twice, by the IMU and by a reference of known accuracy, and estimated by the
    weighted mean.

    Args:
        true_factor: Ratio of the true noise density to the data sheet.
        initial_factor: Ratio of the initial noise density to the data sheet.
        reference_sigma: Standard deviation of the reference relative to that of the IMU by the data sheet.
        intervals: Number of intervals.
    """
    rng = np.random.default_rng(0)
    estimator = NoiseDensityEstimator(DENSITY, initial_factor * DENSITY, NoiseEstimationConfig())
    unit, found, eye = DENSITY * np.sqrt(DT_S), [], np.eye(9)
    for _ in range(intervals):
        imu = rng.normal(0.0, true_factor * unit, 9)
        reference = rng.normal(0.0, reference_sigma * unit, 9)
        assumed, reference_variance = (estimator.density * np.sqrt(DT_S)) ** 2, (reference_sigma * unit) ** 2
        variance = 1.0 / (1.0 / assumed + 1.0 / reference_variance)
        residual = imu - variance * (imu / assumed + reference / reference_variance)
        components = ImuVarianceComponents.from_residual(residual, assumed * eye, variance * eye, DT_S)
        estimator.update(components.accelerometer)
        found.append(estimator.density / DENSITY)
    return found


@pytest.mark.parametrize("true_factor", [0.7, 1.0, 4.0, 12.0])
@pytest.mark.parametrize("initial_factor", [1.0, 5.0, 25.0])
@pytest.mark.parametrize("reference_sigma", [0.1, 0.5, 1.0])
def test_estimate_converges_to_the_noise(true_factor: float, initial_factor: float, reference_sigma: float) -> None:
    last = estimated(true_factor, initial_factor, reference_sigma)[-500:]
    assert np.mean(last) == pytest.approx(true_factor, rel=0.2)


def test_low_redundancy_converges_slowly_from_above() -> None:
    found = estimated(1.0, 5.0, 3.0)
    assert 1.0 < found[-1] < 0.5 * found[0]


def test_a_wrong_initial_density_is_corrected_in_5_s() -> None:
    assert estimated(1.0, 5.0, 1.0)[25] < 2.0
    assert estimated(10.0, 3.0, 1.0)[25] > 6.0


def test_components_of_a_residual_worked_out_by_hand() -> None:
    """Rotation: half of the variance is estimated. Velocity: three times the expectation, estimated exactly."""
    assumed = np.diag([4.0] * 3 + [1.0] * 3 + [9.0] * 3)
    estimate = np.diag([2.0] * 3 + [1.0] * 3 + [0.0] * 3)
    residual = np.array([2.0, 0.0, 2.0, 50.0, 50.0, 50.0, 9.0, 0.0, 0.0])
    found = ImuVarianceComponents.from_residual(residual, assumed, estimate, dt_s=0.5)
    assert astuple(found.gyroscope) == pytest.approx((8.0 / 12.0, 0.5, 8.0))
    assert astuple(found.accelerometer) == pytest.approx((3.0, 1.0, 18.0))


def test_excess_noise_and_zero_redundancy_are_ignored() -> None:
    estimator = NoiseDensityEstimator(DENSITY, 5.0 * DENSITY, NoiseEstimationConfig())
    estimator.update(VarianceComponent(normalized_square=1e-6, redundancy=1.0, assumed_density2=(100.0 * DENSITY) ** 2))
    estimator.update(VarianceComponent(normalized_square=0.0, redundancy=0.0, assumed_density2=(5.0 * DENSITY) ** 2))
    assert estimator.density == pytest.approx(5.0 * DENSITY)


def test_a_shock_hardly_changes_the_estimate() -> None:
    estimator = NoiseDensityEstimator(DENSITY, DENSITY, NoiseEstimationConfig())
    for _ in range(100):
        estimator.update(VarianceComponent(normalized_square=1.0, redundancy=1.0, assumed_density2=DENSITY**2))
    estimator.update(VarianceComponent(normalized_square=1e6, redundancy=1.0, assumed_density2=DENSITY**2))
    assert estimator.density < 1.2 * DENSITY


@pytest.mark.parametrize(("square", "factor"), [(1e9, 30.0), (0.0, 0.5)])
def test_density_stays_in_its_range(square: float, factor: float) -> None:
    estimator = NoiseDensityEstimator(DENSITY, DENSITY, NoiseEstimationConfig(min_factor=0.5, max_factor=30.0))
    for _ in range(2000):
        estimator.update(VarianceComponent(square, redundancy=1.0, assumed_density2=estimator.density**2))
    assert estimator.density == factor * DENSITY


@pytest.mark.parametrize(("factor", "expected"), [(0.1, (3e-4, 1e-2)), (0.0, (3e-4, 1e-2)), (10.0, None)])
def test_initial_noise_of_a_good_data_sheet_is_that_of_an_airframe(
    factor: float, expected: tuple[float, float] | None
) -> None:
    """No data sheet knows the vibration. The first intervals replace the initial noise."""
    sheet = factor * EUROC_IMU.gyro_noise_density, factor * EUROC_IMU.accel_noise_density
    imu, config = replace(EUROC_IMU, gyro_noise_density=sheet[0], accel_noise_density=sheet[1]), PreintegrationConfig()
    noise = ImuNoiseEstimator(imu, config, NoiseEstimationConfig())
    inflated = config.gyro_noise_inflation * sheet[0], config.accel_noise_inflation * sheet[1]
    assert noise.densities == pytest.approx(expected or inflated)
    assert noise.params.gyro_variance == pytest.approx(noise.densities[0] ** 2)
    for _ in range(100):
        noise.update(ImuVarianceComponents(*(VarianceComponent(1.0, 1.0, (0.7 * d) ** 2) for d in noise.densities)))
    assert all(now < 0.8 * (first or 1.0) for now, first in zip(noise.densities, expected or inflated, strict=True))


def test_preintegration_parameters_follow_the_estimate() -> None:
    config, sheet = PreintegrationConfig(), (EUROC_IMU.gyro_noise_density, EUROC_IMU.accel_noise_density)
    noise = ImuNoiseEstimator(EUROC_IMU, config, NoiseEstimationConfig())
    noise.update(None)
    inflated = config.gyro_noise_inflation * sheet[0], config.accel_noise_inflation * sheet[1]
    assert noise.densities == pytest.approx(inflated)
    expected = ImuVarianceComponents(*(VarianceComponent(1.0, 1.0, density**2) for density in sheet))
    for _ in range(500):
        noise.update(expected)
    assert noise.densities == pytest.approx(sheet, rel=1e-3)
    params = noise.params.to_gtsam()
    covariances = params.getGyroscopeCovariance(), params.getAccelerometerCovariance()
    for covariance, density in zip(covariances, sheet, strict=True):
        np.testing.assert_allclose(covariance, density**2 * np.eye(3), rtol=3e-3)


def frames_of(readings: Array, dt_s: float, counts: Sequence[int]) -> list[Increments]:
    """Return readings (N, 6) of gyroscope and accelerometer as increments between frames, with a number for each."""
    parts = np.split(readings[: sum(counts)], np.cumsum(counts)[:-1])
    return [Increments(np.full(len(part), dt_s), part[:, :3], part[:, 3:]) for part in parts]


@pytest.mark.parametrize("counts", [[10] * 400, [8, 12] * 200], ids=["regular", "irregular"])
def test_noise_at_rest_is_that_of_the_samples(counts: list[int]) -> None:
    """White noise of 0.02 rad/s/√Hz and 0.3 m/s²/√Hz, whatever the biases and gravity, and without vibration."""
    rng, dt_s = np.random.default_rng(1), 0.005
    n, constant = sum(counts), [0.1, -0.2, 0.3, 9.0, -2.0, 3.0]
    readings = constant + rng.normal(size=(n, 6)) * np.repeat([0.02, 0.3], 3) / np.sqrt(dt_s)
    assert stationary_densities(frames_of(readings, dt_s, counts)) == pytest.approx((0.02, 0.3), rel=0.05)
    vibrating = readings + 10.0 * np.sin(2.0 * np.pi * 50.0 * dt_s * np.arange(n))[:, None]  # a quarter of the rate
    assert stationary_densities(frames_of(vibrating, dt_s, [12] * (n // 12)))[1] == pytest.approx(0.3, rel=0.05)


def test_noise_at_rest_of_two_intervals() -> None:
    """Mean angular velocities of 1 and 4 rad/s over 0.2 s and 0.05 s: (4 - 1)² = N² (1 / 0.2 + 1 / 0.05)."""
    first = Increments(np.array([0.05, 0.15]), np.repeat([[2.5], [0.5]], 3, axis=1), np.full((2, 3), 1.0))
    second = Increments(np.array([0.05]), np.full((1, 3), 4.0), np.full((1, 3), 7.0))
    assert stationary_densities([first, second]) == pytest.approx((0.6, 1.2))
    assert stationary_densities([first]) == stationary_densities([]) == (0.0, 0.0)


@pytest.mark.parametrize(("factor", "expected"), [(1.0, 2.0), (8.0, 8.0), (100.0, 30.0)])
def test_noise_at_rest_does_not_reduce_the_estimate(factor: float, expected: float) -> None:
    """Before the first interval the gyroscope has twice the noise of its data sheet; 30 times is the limit."""
    noise, dt_s = ImuNoiseEstimator(EUROC_IMU, PreintegrationConfig(), NoiseEstimationConfig()), 0.005
    sheet = EUROC_IMU.gyro_noise_density
    readings = np.random.default_rng(2).normal(size=(4000, 6)) * factor * sheet / np.sqrt(dt_s)
    noise.add_stationary([NO_INCREMENTS, *frames_of(readings, dt_s, [10] * 400)])
    assert noise.densities[0] / sheet == pytest.approx(expected, rel=0.05)
    assert noise.at_rest[0] / sheet == pytest.approx(factor, rel=0.05)
    assert noise.params.gyro_variance == pytest.approx(noise.densities[0] ** 2)


def test_vibration_is_not_white() -> None:
    """White noise of any size is; a vibration of a fifth of the sampling rate on the accelerometer is not."""
    rng, dt_s, n = np.random.default_rng(4), 0.005, 160
    readings = 0.02 * rng.normal(size=(n, 6))
    assert is_white(frames_of(readings, dt_s, [10] * 16))
    assert is_white(frames_of(readings, dt_s, [9, 11] * 8))
    means_of_two = 0.5 * (readings[1:] + readings[:-1])
    assert is_white(frames_of(means_of_two, dt_s, [10] * 15))
    readings[:, 3:] += 0.1 * np.sin(2.0 * np.pi * 0.2 * np.arange(n))[:, None]
    assert not is_white(frames_of(readings, dt_s, [10] * 16))
    assert not is_white([])


def test_vibration_at_rest_leaves_the_random_walks() -> None:
    noise, n = ImuNoiseEstimator(EUROC_IMU, PreintegrationConfig(), NoiseEstimationConfig()), 160
    initial = noise.params
    vibration = np.sin(2.0 * np.pi * 0.2 * np.arange(n) + [[0.0], [1.0], [2.0], [3.0], [4.0], [5.0]]).T
    readings = np.random.default_rng(5).normal(size=(n, 6)) * np.repeat([0.0024, 0.028], 3)  # data sheet
    noise.add_stationary(frames_of(readings + vibration * np.repeat([0.02, 0.2], 3), 0.005, [9, 11] * 8))
    assert noise.at_rest[0] > 1.3 * EUROC_IMU.gyro_noise_density
    assert noise.params.gyro_walk_variance == initial.gyro_walk_variance
    assert noise.params.accel_walk_variance == initial.accel_walk_variance


def test_an_ideal_data_sheet_has_no_ratio_to_the_noise_at_rest() -> None:
    """Without noise in the data sheet, the random walks stay finite, and are those of the settings."""
    ideal = replace(EUROC_IMU, gyro_noise_density=0.0, accel_noise_density=0.0)
    noise = ImuNoiseEstimator(ideal, PreintegrationConfig(), NoiseEstimationConfig())
    initial, readings = noise.params, np.random.default_rng(6).normal(size=(160, 6))
    noise.add_stationary(frames_of(readings, 0.005, [10] * 16))
    assert noise.params.gyro_walk_variance == initial.gyro_walk_variance
    assert noise.params.accel_walk_variance == initial.accel_walk_variance


@pytest.mark.parametrize(("factor", "walk_factor"), [(0.5, 1.0), (1.0, 1.0), (4.0, 4.0)])
def test_random_walks_follow_the_noise_at_rest(factor: float, walk_factor: float) -> None:
    """They are those of the data sheet, unless the unit is noisier at the last rest."""
    noise = ImuNoiseEstimator(EUROC_IMU, PreintegrationConfig(), NoiseEstimationConfig())
    initial, dt_s = noise.params, 0.005
    densities = np.repeat([EUROC_IMU.gyro_noise_density, EUROC_IMU.accel_noise_density], 3)
    readings = np.random.default_rng(3).normal(size=(4000, 6)) * densities / np.sqrt(dt_s)
    for at_rest, expected in ((factor, walk_factor), (1.0, 1.0)):
        noise.add_stationary(frames_of(at_rest * readings, dt_s, [10] * 400))
        found = np.array([noise.params.gyro_walk_variance, noise.params.accel_walk_variance])
        given = np.array([initial.gyro_walk_variance, initial.accel_walk_variance])
        np.testing.assert_allclose(np.sqrt(found / given), expected, rtol=0.05 if expected > 1.0 else 1e-12)


@pytest.mark.parametrize("are_corrected", [False, True])
def test_random_walks_follow_the_biases(are_corrected: bool) -> None:
    """Each that of its sensor, unless another calibration has changed the bias."""
    noise = ImuNoiseEstimator(EUROC_IMU, PreintegrationConfig(), NoiseEstimationConfig())
    before = noise.params
    for i in range(10):
        bias = np.full(3, 5.0 * np.sqrt(3.0 * before.accel_walk_variance) * i)
        state = NavState(i * 3_000_000_000, np.eye(4), np.zeros(3), np.zeros(3), bias, 1e-12 * np.eye(15))
        noise.add_biases(state, are_corrected=are_corrected)
    assert noise.params.gyro_walk_variance == pytest.approx(before.gyro_walk_variance)
    ratio = noise.params.accel_walk_variance / before.accel_walk_variance
    assert ratio == pytest.approx(1.0) if are_corrected else ratio > 10.0


@pytest.mark.parametrize(("factor", "expected"), [(1.0, 5.0), (16.0, 8.0), (100.0, 50.0)])
def test_a_start_in_motion_begins_with_half_of_the_noise_that_the_samples_show(factor: float, expected: float) -> None:
    """It is at least that of the settings, five times the data sheet, and may exceed the limit of 30 times."""
    noise, dt_s, n = ImuNoiseEstimator(EUROC_IMU, PreintegrationConfig(), NoiseEstimationConfig()), 0.005, 1920
    densities = np.repeat([EUROC_IMU.gyro_noise_density, EUROC_IMU.accel_noise_density], 3)
    readings = np.random.default_rng(7).normal(size=(n, 6)) * factor * densities / np.sqrt(dt_s)
    noise.add_imu(ImuSamples(np.arange(n) * 5_000_000, readings[:, :3], readings[:, 3:], "increment"))
    noise.begin_in_motion()
    assert noise.densities[1] / EUROC_IMU.accel_noise_density == pytest.approx(expected, rel=0.35)
    assert noise.params.accel_variance == pytest.approx(noise.densities[1] ** 2)


def test_noise_that_images_have_shown_is_kept_by_a_later_start() -> None:
    noise, n = ImuNoiseEstimator(EUROC_IMU, PreintegrationConfig(), NoiseEstimationConfig()), 640
    sheet = (EUROC_IMU.gyro_noise_density, EUROC_IMU.accel_noise_density)
    readings = np.random.default_rng(8).normal(size=(n, 6)) * 16.0 * np.repeat(sheet, 3) / np.sqrt(0.005)
    noise.add_imu(ImuSamples(np.arange(n) * 5_000_000, readings[:, :3], readings[:, 3:], "increment"))
    for _ in range(500):
        noise.update(ImuVarianceComponents(*(VarianceComponent(1.0, 1.0, density**2) for density in sheet)))
    before = noise.densities
    noise.begin_in_motion()
    assert noise.densities == before


@pytest.mark.slow
@pytest.mark.parametrize("imu_noise", [1.0, 10.0])
def test_noise_of_a_flight_is_estimated(
    make_flight: Callable[..., "SyntheticFlight"], keyframe_feed: "type[KeyframeFeed]", imu_noise: float
) -> None:
    """The variance components of the intervals that leave a smoother's window give the simulated noise."""
    flight = make_flight(2, rest_s=-5.0, duration_s=15.0, imu_noise=imu_noise)
    start = flight.state_at(int(flight.frame_times_ns[0]))
    noise = ImuNoiseEstimator(flight.rig.imu, PreintegrationConfig(), NoiseEstimationConfig())
    covariance = InitialSigmas().covariance(start.T_world_imu[:3, :3])
    factors, sheet = [], np.array([flight.rig.imu.gyro_noise_density, flight.rig.imu.accel_noise_density])
    for feed in keyframe_feed(flight, start, covariance, params=lambda: noise.params):
        noise.update(feed.results[-1].imu_variance)
        factors.append(noise.densities / sheet)
    gyro, accel = np.mean(factors[-40:], axis=0)
    assert gyro == pytest.approx(imu_noise, rel=0.35)
    assert 0.7 * imu_noise < accel < 1.3 * imu_noise + 1.0  # integration of point samples adds an error
