"""The errors of many IMUs against the statistics of single units, and the independence of units."""

from dataclasses import replace

import numpy as np
import pytest

from dronevio.models.imu import EUROC_IMU, ImuModel, ImuSamples
from dronevio.models.imu_presets import IMUS
from dronevio.models.quadrotor import Quadrotor
from dronevio.models.rig import euroc_rig
from dronevio.models.vibration import EUROC_VIBRATION
from dronevio.sim.inertial.batch_imu import BatchImuErrors, vibration_of
from dronevio.sim.inertial.imu import ImuErrors
from dronevio.sim.inertial.vibration import RotorHarmonics

UNITS = 1000
PERFECT = np.tile([0.3, -0.2, 0.1, 1.0, 9.0, -2.0], (UNITS, 1))
LAST = np.array([False, False, True])
IDEAL = ImuModel(
    gyro_noise_density=0.0,
    gyro_random_walk=0.0,
    accel_noise_density=0.0,
    accel_random_walk=0.0,
    gyro_turn_on_bias_rad_s=0.0,
    accel_turn_on_bias_m_s2=0.0,
)


def single_units(model: ImuModel, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Return last measurements and biases (N, 6) of single units after their first sample and some steps."""
    t_ns = np.arange(steps + 1, dtype=np.int64) * round(1e9 / model.rate_hz)
    perfect = ImuSamples(t_ns, np.tile(PERFECT[0, :3], (len(t_ns), 1)), np.tile(PERFECT[0, 3:], (len(t_ns), 1)))
    found = []
    for seed in range(UNITS):
        measured, gyro_bias, accel_bias = ImuErrors(model, np.random.default_rng(seed)).add_to(perfect)
        last = (measured.gyro_rad_s[-1], measured.accel_m_s2[-1], gyro_bias[-1], accel_bias[-1])
        found.append(np.concatenate(last))
    values = np.array(found)
    return values[:, :6], values[:, 6:]


@pytest.mark.parametrize("name", IMUS)
def test_statistics_are_those_of_single_units(name: str) -> None:
    model = replace(IMUS[name], gyro_random_walk=1e-3, accel_random_walk=0.1)  # visible after 50 steps
    errors = BatchImuErrors(model, UNITS, np.random.default_rng(0))
    errors.first(PERFECT, np.arange(UNITS))
    for _ in range(50):
        measured, bias = errors.add_to(PERFECT)
    single_measured, single_bias = single_units(model, 50)
    np.testing.assert_allclose(measured.std(axis=0), single_measured.std(axis=0), rtol=0.1)
    np.testing.assert_allclose(bias.std(axis=0), single_bias.std(axis=0), rtol=0.1)
    spread = 4.0 * (measured.std(axis=0) + 1e-12) / np.sqrt(UNITS)
    assert np.all(np.abs(measured.mean(axis=0) - PERFECT[0]) < spread)
    noise, single_noise = measured - bias, single_measured - single_bias
    np.testing.assert_allclose(noise.std(axis=0), single_noise.std(axis=0), rtol=0.1)


def test_an_ideal_sensor_adds_nothing() -> None:
    errors = BatchImuErrors(IDEAL, UNITS, np.random.default_rng(0))
    measured, bias = errors.add_to(PERFECT)
    np.testing.assert_array_equal(measured, PERFECT)
    np.testing.assert_array_equal(errors.first(PERFECT, np.arange(UNITS))[0], PERFECT)
    assert not bias.any()
    np.testing.assert_array_equal(errors.response, np.tile(np.eye(6), (UNITS, 1, 1)))


def test_bias_instability_is_stationary_with_its_floor() -> None:
    model = replace(IDEAL, gyro_bias_instability_rad_s=1e-3)
    errors = BatchImuErrors(model, UNITS, np.random.default_rng(1))
    spread = [errors.add_to(PERFECT)[1][:, :3].std() for _ in range(300)]
    np.testing.assert_allclose(spread, spread[0], rtol=0.05)
    np.testing.assert_allclose(spread[0], 1e-3 / 0.664 * np.sqrt(6.0 * np.log(10.0) / np.pi), rtol=0.03)


def test_measurements_are_quantized_and_clipped() -> None:
    model = replace(EUROC_IMU, gyro_range_rad_s=0.25)
    measured, _ = BatchImuErrors(model, UNITS, np.random.default_rng(2)).add_to(PERFECT)
    steps = measured[:, 3:] / model.accel_resolution_m_s2
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-6)
    assert np.abs(measured[:, :3]).max() == 0.25


def test_a_reset_leaves_the_other_units_identical() -> None:
    model = replace(IMUS["tactical"], gyro_scale_error=0.01)
    perfect = PERFECT[:3]
    undisturbed, errors = (BatchImuErrors(model, 3, np.random.default_rng(3)) for _ in range(2))
    first = errors.response[2]
    for step in range(6):
        if step == 3:
            errors.reset(LAST)
            errors.first(perfect[LAST], np.flatnonzero(LAST))
        measured, expected = errors.add_to(perfect)[0], undisturbed.add_to(perfect)[0]
        np.testing.assert_array_equal(measured[~LAST], expected[~LAST])
    assert not np.any(measured[2] == expected[2])
    assert not np.all(errors.response[2] == first)


def test_restored_errors_continue_with_the_same_bytes() -> None:
    errors, other = (BatchImuErrors(EUROC_IMU, 3, np.random.default_rng(seed)) for seed in (4, 5))
    errors.add_to(PERFECT[:3])
    saved = errors.save()
    expected = [errors.add_to(PERFECT[:3])[0] for _ in range(3)]
    other.restore(saved)
    np.testing.assert_array_equal([other.add_to(PERFECT[:3])[0] for _ in range(3)], expected)
    other.reseed(np.random.default_rng(6))
    assert not np.any(other.add_to(PERFECT[:3])[1] == errors.add_to(PERFECT[:3])[1])


def test_vibration_of_each_unit_is_that_of_a_single_one() -> None:
    drone, rig, count = replace(Quadrotor(), vibration=EUROC_VIBRATION), euroc_rig(), 3
    vibration = vibration_of(drone, rig, count)
    assert vibration is not None and vibration_of(Quadrotor(), rig, count) is None
    errors = BatchImuErrors(IDEAL, count, np.random.default_rng(7), vibration)
    singles = []
    for angles in vibration.state.angle_rad:
        single = RotorHarmonics(drone, rig, np.random.default_rng(0))
        single._angle = angles
        singles.append(single)
    speeds = np.random.default_rng(8).uniform(500.0, 700.0, (20, count, 4))
    found = [errors.first(PERFECT[:count], np.arange(count), speeds[0])[0]]
    found += [errors.add_to(PERFECT[:count], step)[0] for step in speeds[1:]]
    t_ns = np.arange(20, dtype=np.int64) * 5_000_000
    for k, single in enumerate(singles):
        gyro, accel = single.sensed(ImuSamples(t_ns, np.zeros((20, 3)), np.zeros((20, 3))), speeds[:, k])
        np.testing.assert_allclose(np.array(found)[:, k] - PERFECT[0], np.hstack([gyro, accel]), atol=1e-9)
    saved = errors.save()
    expected = errors.add_to(PERFECT[:count], speeds[0])[0]
    errors.restore(saved)
    np.testing.assert_array_equal(errors.add_to(PERFECT[:count], speeds[0])[0], expected)
