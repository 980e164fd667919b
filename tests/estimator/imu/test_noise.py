"""The noise of the IMU, learnt from how well its intervals fit what else is known."""

from collections.abc import Callable

import gtsam
import numpy as np
import pytest

from dronevio.estimator.backend.landmarks import LandmarkConfig
from dronevio.estimator.backend.smoother import KeyframeSmoother, SmootherConfig
from dronevio.estimator.imu.buffer import ImuBuffer
from dronevio.estimator.imu.noise import (
    ImuNoiseEstimator,
    ImuVarianceComponents,
    NoiseDensityEstimator,
    NoiseEstimationConfig,
    VarianceComponent,
)
from dronevio.estimator.imu.preintegration import PreintegrationConfig, integrate
from dronevio.estimator.initialization.static import InitialSigmas
from dronevio.models.imu import EUROC_IMU
from dronevio.models.state import NavState

DT_S = 0.2
DENSITY = 2e-3


def learnt(true_level: float, assumed_level: float, told_by_others: float, intervals: int = 1000) -> list[float]:
    """Return how many times noisier than its data sheet the IMU is said to be, after each of some intervals.

    Each measures a motion twice, by the IMU and by others, whose noise is known; the estimate is their weighted mean.

    Args:
        true_level: Of the IMU's noise.
        assumed_level: Of the IMU's noise at first.
        told_by_others: Standard deviation of the others, relative to the IMU's at level 1.
        intervals: How many.
    """
    rng, level = np.random.default_rng(0), NoiseDensityEstimator(DENSITY, assumed_level, NoiseEstimationConfig())
    unit, found = DENSITY * np.sqrt(DT_S), []
    for _ in range(intervals):
        by_imu = rng.normal(0.0, true_level * unit, 9)
        by_others = rng.normal(0.0, told_by_others * unit, 9)
        assumed, others = (level.density * np.sqrt(DT_S)) ** 2, (told_by_others * unit) ** 2
        estimate = (by_imu / assumed + by_others / others) / (1.0 / assumed + 1.0 / others)
        followed = 1.0 / (1.0 / assumed + 1.0 / others)
        eye = np.eye(9)
        misfit = ImuVarianceComponents.from_residual(by_imu - estimate, assumed * eye, followed * eye, DT_S)
        level.update(misfit.accelerometer)
        found.append(level.density / DENSITY)
    return found


@pytest.mark.parametrize("true_level", [0.7, 1.0, 4.0, 12.0])
@pytest.mark.parametrize("assumed_level", [1.0, 5.0, 25.0])
@pytest.mark.parametrize("told_by_others", [0.1, 0.5, 1.0])
def test_level_becomes_that_of_the_noise(true_level: float, assumed_level: float, told_by_others: float) -> None:
    later = learnt(true_level, assumed_level, told_by_others)[-500:]
    assert np.mean(later) == pytest.approx(true_level, rel=0.2)


def test_low_redundancy_is_learnt_slowly_from_the_safe_side() -> None:
    found = learnt(1.0, 5.0, 3.0)
    assert 1.0 < found[-1] < 0.5 * found[0]


def test_an_assumption_is_unlearnt_within_seconds() -> None:
    assert learnt(1.0, 5.0, 1.0)[25] < 2.0
    assert learnt(10.0, 3.0, 1.0)[25] > 6.0


def test_inflated_or_not_redundant_residuals_teach_nothing() -> None:
    level = NoiseDensityEstimator(DENSITY, 5.0, NoiseEstimationConfig())
    level.update(VarianceComponent(normalized_square=1e-6, redundancy=1.0, assumed_density2=(100.0 * DENSITY) ** 2))
    level.update(VarianceComponent(normalized_square=0.0, redundancy=0.0, assumed_density2=(5.0 * DENSITY) ** 2))
    assert level.density == pytest.approx(5.0 * DENSITY)


def test_a_jolt_is_no_noise_and_no_level_is_absurd() -> None:
    config = NoiseEstimationConfig()
    level = NoiseDensityEstimator(DENSITY, 1.0, config)
    for _ in range(100):
        level.update(VarianceComponent(normalized_square=1.0, redundancy=1.0, assumed_density2=DENSITY**2))
    level.update(VarianceComponent(normalized_square=1e6, redundancy=1.0, assumed_density2=DENSITY**2))
    assert level.density < 1.2 * DENSITY
    for squared, limit in ((1e9, config.max_factor), (0.0, config.min_factor)):
        for _ in range(2000):
            level.update(VarianceComponent(squared, redundancy=1.0, assumed_density2=level.density**2))
        assert level.density == limit * DENSITY


def test_parameters_of_preintegration_follow() -> None:
    noise = ImuNoiseEstimator(EUROC_IMU, PreintegrationConfig(), NoiseEstimationConfig())
    noise.update(None)
    config, sheet = PreintegrationConfig(), (EUROC_IMU.gyro_noise_density, EUROC_IMU.accel_noise_density)
    inflated = config.gyro_noise_inflation * sheet[0], config.accel_noise_inflation * sheet[1]
    assert noise.densities == pytest.approx(inflated)
    exact = ImuVarianceComponents(*(VarianceComponent(1.0, 1.0, density**2) for density in sheet))
    for _ in range(500):
        noise.update(exact)
    assert noise.densities == pytest.approx(sheet, rel=1e-3)
    found = noise.params.getGyroscopeCovariance(), noise.params.getAccelerometerCovariance()
    for covariance, density in zip(found, sheet, strict=True):
        np.testing.assert_allclose(covariance, density**2 * np.eye(3), rtol=3e-3)


@pytest.mark.parametrize("imu_noise", [1.0, 10.0])
def test_noise_of_a_flight_is_found(make_flight: Callable, imu_noise: float) -> None:
    """The smoother says of every interval that leaves it how well it fits; its noise is that of the simulation."""
    flight = make_flight(2, rest_s=-5.0, duration_s=15.0, imu_noise=imu_noise)
    step = 4
    times = flight.frame_times_ns[::step]
    first = flight.truth_at(times[:1])
    start = NavState(
        int(times[0]),
        first.Ts_world_imu[0],
        first.velocity_m_s[0],
        first.gyro_bias_rad_s[0],
        first.accel_bias_m_s2[0],
    )
    front_end, buffer = flight.front_end(), ImuBuffer()
    buffer.add(flight.imu)
    buffer.take_until(start.t_ns)
    front_end.track(flight.frame(0), np.eye(3))
    P = InitialSigmas().covariance(start.T_world_imu[:3, :3])
    smoother = KeyframeSmoother(flight.rig.cameras, SmootherConfig(), LandmarkConfig(), start, P, front_end.replenish())
    noise = ImuNoiseEstimator(flight.rig.imu, PreintegrationConfig(), NoiseEstimationConfig())
    levels, sheet = [], np.array([flight.rig.imu.gyro_noise_density, flight.rig.imu.accel_noise_density])
    for k, t_ns in enumerate(times[1:].tolist(), 1):
        pim = gtsam.PreintegratedCombinedMeasurements(noise.params, smoother.gtsam_state[1])
        integrate(pim, buffer.take_until(t_ns))
        front_end.track(flight.frame(step * k), np.eye(3))
        result = smoother.add_keyframe(t_ns, pim, front_end.replenish(), still=False)
        noise.update(result.imu_variance)
        levels.append(noise.densities / sheet)
    gyro, accel = np.mean(levels[-40:], axis=0)
    assert gyro == pytest.approx(imu_noise, rel=0.35)
    assert 0.7 * imu_noise < accel < 1.3 * imu_noise + 1.0  # the flight's IMU is sampled at points: that adds an error
