"""The lowest spectral density of IMU samples, and the noise estimate that it bounds."""

import numpy as np
import pytest

from dronevio.estimator.imu.noise import (
    ImuNoiseEstimator,
    ImuVarianceComponents,
    NoiseEstimationConfig,
    VarianceComponent,
    pooled_density,
)
from dronevio.estimator.imu.preintegration import PreintegrationConfig
from dronevio.estimator.imu.spectral_floor import SEGMENT, SpectralFloor
from dronevio.models.arrays import Array
from dronevio.models.imu import EUROC_IMU, ImuSamples

SHEET = np.array([EUROC_IMU.gyro_noise_density, EUROC_IMU.accel_noise_density])


def samples(values: Array, rate_hz: float) -> ImuSamples:
    """Return readings (N, 6) as samples."""
    return ImuSamples(np.round(np.arange(len(values)) * 1e9 / rate_hz).astype(np.int64), values[:, :3], values[:, 3:])


def white(n: int, rate_hz: float, factor: float = 1.0) -> Array:
    """Return white noise (N, 6) of the data sheet times a factor."""
    return np.asarray(factor * np.random.default_rng(0).normal(size=(n, 6)) * np.repeat(SHEET, 3) * np.sqrt(rate_hz))


def floor_of(values: Array, rate_hz: float) -> Array:
    """Return the floor relative to the data sheet."""
    floor = SpectralFloor()
    for begin in range(0, len(values), 7):
        floor.add(samples(values, rate_hz)[begin : begin + 7])
    return np.asarray(np.array(floor.densities) / SHEET)


@pytest.mark.parametrize("rate_hz", [100.0, 200.0, 1000.0])
@pytest.mark.parametrize("factor", [1.0, 20.0])
def test_the_floor_of_white_noise_is_its_density(rate_hz: float, factor: float) -> None:
    np.testing.assert_allclose(floor_of(white(2000, rate_hz, factor), rate_hz), factor, rtol=0.35)


def test_motion_and_a_line_of_vibration_do_not_raise_the_floor() -> None:
    t_s = np.arange(2000) / 200.0
    motion = np.sin(2.0 * np.pi * 1.3 * t_s)[:, None] * np.repeat([3.0, 10.0], 3)
    vibration = np.sin(2.0 * np.pi * 87.0 * t_s)[:, None] * np.repeat([0.3, 15.0], 3)
    assert np.all(floor_of(white(2000, 200.0) + motion + vibration, 200.0) < 2.0)


def test_vibration_whose_frequency_wanders_raises_the_floor() -> None:
    phase = 2.0 * np.pi * 87.0 * np.arange(2000) / 200.0 + np.cumsum(np.random.default_rng(1).normal(0.0, 0.2, 2000))
    vibration = np.sin(phase)[:, None] * np.repeat([0.3, 15.0], 3)
    assert np.all(floor_of(white(2000, 200.0) + vibration, 200.0) > [8.0, 30.0])


def test_there_is_no_floor_before_the_first_segment() -> None:
    assert np.all(floor_of(white(SEGMENT - 1, 200.0), 200.0) == 0.0)


def estimator() -> ImuNoiseEstimator:
    """Return an estimator before the first sample."""
    return ImuNoiseEstimator(EUROC_IMU, PreintegrationConfig(), NoiseEstimationConfig())


@pytest.mark.parametrize(("factor", "expected"), [(1.0, (2.0, 5.0)), (8.0, (2.0, 5.0)), (60.0, (30.0, 30.0))])
def test_only_gross_noise_replaces_the_initial_estimate(factor: float, expected: tuple[float, float]) -> None:
    noise = estimator()
    noise.add_imu(samples(white(400, 200.0, factor), 200.0))
    np.testing.assert_allclose(np.array(noise.densities) / SHEET, expected, rtol=0.3)
    np.testing.assert_allclose(np.sqrt(noise.params.accel_variance), noise.densities[1])
    np.testing.assert_allclose(np.array(noise.measured) / SHEET, factor, rtol=0.3)


@pytest.mark.parametrize(
    ("square", "shown", "expected"), [(0.5, 50.0, 5.0), (4.0, 50.0, 10.0), (2.0, 8.0, 5.0 * 2.0**0.5)]
)
def test_first_intervals_raise_noise_up_to_what_samples_show(square: float, shown: float, expected: float) -> None:
    noise = estimator()
    noise.add_imu(samples(white(400, 200.0, min(shown, 8.0)), 200.0))
    limit = noise.measured[1] / SHEET[1]
    gyro = VarianceComponent(0.1, 1.0, (2.0 * SHEET[0]) ** 2)
    component = ImuVarianceComponents(gyro, VarianceComponent(square, 1.0, (5.0 * SHEET[1]) ** 2))
    raised = noise.raise_initial([component] * 4)
    assert noise.densities[1] / SHEET[1] == pytest.approx(max(5.0, min(expected, limit)))
    assert raised == (noise.densities[1] > 1.3 * 5.0 * SHEET[1])


def test_intervals_without_redundancy_show_no_noise() -> None:
    assert pooled_density([VarianceComponent(9.0, 0.01, 1.0)] * 10) == 0.0
    assert pooled_density([VarianceComponent(2.0, 0.5, 4.0)] * 10) == pytest.approx(4.0)


@pytest.mark.parametrize(
    ("rate_hz", "factor", "aliased"), [(200.0, 60.0, False), (100.0, 1.0, False), (100.0, 20.0, True)]
)
def test_vibration_is_aliased_where_samples_are_left_out(rate_hz: float, factor: float, aliased: bool) -> None:
    noise = estimator()
    noise.add_imu(samples(white(400, rate_hz, factor), rate_hz))
    assert noise.is_aliased == aliased
    assert noise.is_excessive == (factor > 1.0)
    assert noise.measured[1] / SHEET[1] == pytest.approx((4.0 if rate_hz < 200.0 else 1.0) * factor, rel=0.3)


@pytest.mark.parametrize(("rate_hz", "before"), [(200.0, False), (100.0, True)])
def test_samples_show_aliasing_before_images_do(rate_hz: float, before: bool) -> None:
    """Eight times the data sheet may be 32 times where vibration is aliased; images may show that it is not."""
    noise = estimator()
    noise.add_imu(samples(white(400, rate_hz, 8.0), rate_hz))
    assert not noise.is_excessive
    assert noise.is_aliased is before
    noise.update(None)
    assert noise.is_aliased is before
    component = VarianceComponent(0.5, 0.5, 0.0)
    noise.update(ImuVarianceComponents(component, component))
    assert not noise.is_aliased
