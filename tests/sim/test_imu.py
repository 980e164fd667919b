from dataclasses import fields, replace

import numpy as np
import pytest

from dronevio.models.errors import ConfigError
from dronevio.models.imu import EUROC_IMU, ImuModel, ImuSamples, Sampling
from dronevio.models.imu_presets import IMUS, imu_named
from dronevio.sim.inertial.imu import ImuErrors

N = 40_000
STEP_NS = 5_000_000
STATIONARY = ImuSamples(np.arange(N, dtype=np.int64) * STEP_NS, np.zeros((N, 3)), np.zeros((N, 3)))
NOISELESS = ImuModel(
    gyro_noise_density=0.0,
    gyro_random_walk=0.0,
    accel_noise_density=0.0,
    accel_random_walk=0.0,
    gyro_turn_on_bias_rad_s=0.0,
    accel_turn_on_bias_m_s2=0.0,
)


def random_samples(sampling: Sampling = "point") -> ImuSamples:
    rng = np.random.default_rng(5)
    return ImuSamples(STATIONARY.t_ns, rng.normal(size=(N, 3)), 9.81 * rng.normal(size=(N, 3)), sampling)


@pytest.mark.parametrize("sampling", ["point", "increment"])
@pytest.mark.parametrize("name", IMUS)
def test_white_noise_has_the_requested_density(name: str, sampling: Sampling) -> None:
    model = replace(IMUS[name], gyro_resolution_rad_s=0.0, accel_resolution_m_s2=0.0)
    t_ns = np.arange(N, dtype=np.int64) * round(1e9 / model.rate_hz)
    stationary = ImuSamples(t_ns, np.zeros((N, 3)), np.zeros((N, 3)), sampling)
    noisy, gyro_bias, accel_bias = ImuErrors(model, np.random.default_rng(0)).add_to(stationary)
    gyro, accel = noisy.gyro_rad_s - gyro_bias, noisy.accel_m_s2 - accel_bias
    np.testing.assert_allclose(gyro.std(axis=0), model.gyro_noise_density * np.sqrt(model.rate_hz), rtol=0.02)
    np.testing.assert_allclose(accel.std(axis=0), model.accel_noise_density * np.sqrt(model.rate_hz), rtol=0.02)
    correlation = np.corrcoef(np.hstack([gyro[1:], accel[1:], gyro[:-1], accel[:-1]]).T)
    assert np.abs(correlation - np.eye(12)).max() < 0.03  # white, and independent between axes


def test_increments_have_the_mean_noise_of_their_interval() -> None:
    model = replace(NOISELESS, gyro_noise_density=1e-3, accel_noise_density=1e-2)
    dt_ns = np.where(np.arange(N) % 2 == 0, STEP_NS, 4 * STEP_NS)
    uneven = ImuSamples(np.cumsum(dt_ns), np.zeros((N, 3)), np.zeros((N, 3)), "increment")
    errors = ImuErrors(model, np.random.default_rng(1))
    gyro = np.concatenate([errors.add_to(uneven[k : k + 5])[0].gyro_rad_s for k in range(0, N, 5)])
    for phase in range(10):  # the first of a batch is as noisy as the others
        dt_s = 5e-3 if phase % 2 == 0 else 20e-3
        np.testing.assert_allclose(gyro[phase::10].std(), 1e-3 / np.sqrt(dt_s), rtol=0.04)


def test_turn_on_biases_have_the_requested_deviation() -> None:
    starts = [ImuErrors(EUROC_IMU, np.random.default_rng(seed)).add_to(STATIONARY[:1])[1:] for seed in range(1000)]
    gyro, accel = (np.concatenate(s) for s in zip(*starts, strict=True))
    np.testing.assert_allclose(gyro.std(), EUROC_IMU.gyro_turn_on_bias_rad_s, rtol=0.05)
    np.testing.assert_allclose(accel.std(), EUROC_IMU.accel_turn_on_bias_m_s2, rtol=0.05)


@pytest.mark.parametrize("sampling", ["point", "increment"])
def test_a_sensor_without_errors_adds_nothing(sampling: Sampling) -> None:
    perfect = random_samples(sampling)
    errors = ImuErrors(NOISELESS, np.random.default_rng(2))
    noisy, gyro_bias, accel_bias = errors.add_to(perfect)
    np.testing.assert_array_equal(noisy.gyro_rad_s, perfect.gyro_rad_s)
    np.testing.assert_array_equal(noisy.accel_m_s2, perfect.accel_m_s2)
    assert noisy.sampling == sampling
    assert not gyro_bias.any() and not accel_bias.any()
    np.testing.assert_array_equal(errors.constants.gyro_matrix, np.eye(3))
    np.testing.assert_array_equal(errors.constants.accel_matrix, np.eye(3))
    assert not errors.constants.gyro_g_sensitivity.any()


@pytest.mark.parametrize("name", IMUS)
def test_residuals_of_biases_and_constants_are_noise(name: str) -> None:
    """The ground truth contains all errors except the noise, which has the stated density."""
    model = IMUS[name]
    errors, perfect = ImuErrors(model, np.random.default_rng(3)), random_samples()
    measured, gyro_bias, accel_bias = errors.add_to(perfect)
    gyro, accel = errors.constants.response(perfect.gyro_rad_s, perfect.accel_m_s2)
    in_range = np.abs(gyro) < 0.9 * model.gyro_range_rad_s, np.abs(accel) < 0.9 * model.accel_range_m_s2
    gyro_residual = (measured.gyro_rad_s - gyro - gyro_bias)[in_range[0]]
    accel_residual = (measured.accel_m_s2 - accel - accel_bias)[in_range[1]]
    root_rate = np.sqrt(model.rate_hz)
    np.testing.assert_allclose(
        gyro_residual.std(),
        np.hypot(model.gyro_noise_density * root_rate, model.gyro_resolution_rad_s / 12**0.5),
        rtol=0.02,
    )
    np.testing.assert_allclose(
        accel_residual.std(),
        np.hypot(model.accel_noise_density * root_rate, model.accel_resolution_m_s2 / 12**0.5),
        rtol=0.02,
    )
    np.testing.assert_allclose(gyro_residual.mean(), 0.0, atol=0.01 * gyro_residual.std())
    np.testing.assert_allclose(accel_residual.mean(), 0.0, atol=0.01 * accel_residual.std())


def test_scale_misalignment_and_g_sensitivity_have_their_sigmas() -> None:
    model = replace(
        NOISELESS,
        gyro_scale_error=0.02,
        accel_scale_error=0.01,
        gyro_misalignment_rad=0.004,
        accel_misalignment_rad=0.003,
        gyro_g_sensitivity_rad_s_per_m_s2=1e-4,
    )
    rng = np.random.default_rng(4)
    units = [ImuErrors(model, rng).constants for _ in range(1000)]
    gyro = np.stack([unit.gyro_matrix for unit in units]) - np.eye(3)
    accel = np.stack([unit.accel_matrix for unit in units]) - np.eye(3)
    axes, tilts = np.eye(3, dtype=bool), ~np.eye(3, dtype=bool)
    np.testing.assert_allclose(gyro[:, axes].std(), 0.02, rtol=0.05)
    np.testing.assert_allclose(gyro[:, tilts].std(), 0.004, rtol=0.05)
    np.testing.assert_allclose(accel[:, axes].std(), 0.01, rtol=0.05)
    np.testing.assert_allclose(accel[:, tilts].std(), 0.003, rtol=0.05)
    sensitivity = np.stack([unit.gyro_g_sensitivity for unit in units])
    np.testing.assert_allclose(sensitivity.std(), 1e-4, rtol=0.05)
    drawn = np.hstack([part.reshape(1000, 9) for part in (gyro, accel, sensitivity)])
    assert np.abs(np.corrcoef(drawn.T) - np.eye(27)).max() < 0.15  # all constants are independent


def test_rows_of_the_constants_belong_to_axes() -> None:
    model = replace(NOISELESS, gyro_scale_error=0.1, gyro_misalignment_rad=0.1, gyro_g_sensitivity_rad_s_per_m_s2=1e-2)
    errors = ImuErrors(model, np.random.default_rng(6))
    rotation = ImuSamples(STATIONARY.t_ns[:3], np.eye(3), np.zeros((3, 3)))  # about one axis after the other
    np.testing.assert_array_equal(errors.add_to(rotation)[0].gyro_rad_s, errors.constants.gyro_matrix.T)
    force = ImuSamples(STATIONARY.t_ns[3:6], np.zeros((3, 3)), np.eye(3))
    measured = errors.add_to(force)[0]
    np.testing.assert_array_equal(measured.gyro_rad_s, errors.constants.gyro_g_sensitivity.T)
    np.testing.assert_array_equal(measured.accel_m_s2, np.eye(3))


def test_constant_errors_have_an_independent_random_stream() -> None:
    """A scale error does not change noise and biases, so that errors can be added one at a time."""
    good, bad = EUROC_IMU, replace(EUROC_IMU, gyro_scale_error=0.01, accel_misalignment_rad=0.01)
    (first, *biases), (second, *other) = (
        ImuErrors(m, np.random.default_rng(7)).add_to(STATIONARY) for m in (good, bad)
    )
    np.testing.assert_array_equal(first.gyro_rad_s, second.gyro_rad_s)
    np.testing.assert_array_equal(first.accel_m_s2, second.accel_m_s2)
    np.testing.assert_array_equal(biases, other)
    flickering = replace(EUROC_IMU, gyro_bias_instability_rad_s=1e-3, gyro_resolution_rad_s=0.0)
    smooth = replace(EUROC_IMU, gyro_resolution_rad_s=0.0)
    noises = []
    for model in (flickering, smooth):
        measured, bias, _ = ImuErrors(model, np.random.default_rng(7)).add_to(STATIONARY)
        noises.append(measured.gyro_rad_s - bias)
    np.testing.assert_allclose(noises[0], noises[1], atol=1e-12)


def test_readings_are_quantized_and_saturated() -> None:
    model = replace(
        NOISELESS, gyro_range_rad_s=2.0, gyro_resolution_rad_s=0.25, accel_range_m_s2=19.9, accel_resolution_m_s2=0.5
    )
    perfect = random_samples()
    read = ImuErrors(model, np.random.default_rng(8)).add_to(perfect)[0]
    assert np.abs(read.gyro_rad_s).max() == 2.0 and np.abs(read.accel_m_s2).max() == 19.9
    inside = np.abs(perfect.gyro_rad_s) < 2.0
    np.testing.assert_array_equal(read.gyro_rad_s[inside] % 0.25, 0.0)
    assert np.abs(read.gyro_rad_s - perfect.gyro_rad_s)[inside].max() <= 0.125
    np.testing.assert_array_equal(read.gyro_rad_s[perfect.gyro_rad_s > 2.125], 2.0)
    np.testing.assert_array_equal(read.gyro_rad_s[perfect.gyro_rad_s < -2.125], -2.0)


def test_the_random_walk_continues_between_batches() -> None:
    walking = ImuModel(gyro_noise_density=0.0, accel_noise_density=0.0)
    errors = ImuErrors(walking, np.random.default_rng(3))
    first, gyro_bias, _ = errors.add_to(STATIONARY[:1000])
    errors.add_to(STATIONARY[1000:1000])
    second, _, _ = errors.add_to(STATIONARY[1000:2000])
    np.testing.assert_array_equal(first.gyro_rad_s, gyro_bias)
    jump = np.abs(second.gyro_rad_s[0] - first.gyro_rad_s[-1]) / (walking.gyro_random_walk * np.sqrt(5e-3))
    assert np.all(jump > 0.0) and np.all(jump < 5.0)


@pytest.mark.parametrize("name", IMUS)
def test_same_seed_same_bytes(name: str) -> None:
    model = IMUS[name]
    one, other, different = (ImuErrors(model, np.random.default_rng(s)).add_to(STATIONARY[:100])[0] for s in (0, 0, 1))
    assert one.gyro_rad_s.tobytes() == other.gyro_rad_s.tobytes()
    assert one.accel_m_s2.tobytes() == other.accel_m_s2.tobytes()
    assert np.mean(one.gyro_rad_s == different.gyro_rad_s) < 0.1  # some coincide because of the coarse quantization


def test_invalid_parameters_are_refused_by_name() -> None:
    for field in fields(ImuModel)[1:]:
        for wrong in (-1.0, float("nan")):
            with pytest.raises(ConfigError, match=field.name):
                replace(EUROC_IMU, **{field.name: wrong})  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="rate_hz 0"):
        ImuModel(rate_hz=0.0)


def test_presets_agree_with_their_data_sheets() -> None:
    """The data sheets also state these values in other units than those that the presets are converted from."""
    adis, bmi, mpu, tactical = (imu_named(name) for name in ("ADIS16448", "BMI088", "MPU-6050", "tactical"))
    assert np.degrees(adis.gyro_noise_density) * 60.0 == pytest.approx(0.81)  # °/√h; the sheet's 0.66 is at rest
    assert adis.accel_noise_density * 60.0 == pytest.approx(0.11, rel=0.25)  # m/s/√h
    assert adis.gyro_range_rad_s / adis.gyro_resolution_rad_s == pytest.approx(25_000)
    assert bmi.gyro_range_rad_s / bmi.gyro_resolution_rad_s == pytest.approx(2**15)
    assert mpu.gyro_range_rad_s / mpu.gyro_resolution_rad_s == pytest.approx(2**15, rel=1e-3)
    assert mpu.accel_range_m_s2 / mpu.accel_resolution_m_s2 == pytest.approx(2**15)
    assert tactical.gyro_noise_density == pytest.approx(4.3633e-5, rel=1e-4)  # rad/s/√Hz
    assert tactical.accel_noise_density == pytest.approx(1e-3)  # m/s²/√Hz
    assert tactical.gyro_bias_instability_rad_s == pytest.approx(2.4241e-6, rel=1e-4)
    with pytest.raises(ConfigError, match="unknown IMU 'IMU-7'; expected one of euroc, ADIS16448"):
        imu_named("IMU-7")
