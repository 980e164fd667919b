import numpy as np
import pytest

from dronevio.models.imu import EUROC_IMU, ImuModel, ImuSamples
from dronevio.sim.imu import ImuErrors

N = 40_000
STEP_NS = 5_000_000
STILL = ImuSamples(np.arange(N, dtype=np.int64) * STEP_NS, np.zeros((N, 3)), np.zeros((N, 3)))
SILENT = ImuModel(
    gyro_noise_density=0.0,
    gyro_random_walk=0.0,
    accel_noise_density=0.0,
    accel_random_walk=0.0,
    gyro_turn_on_bias_rad_s=0.0,
    accel_turn_on_bias_m_s2=0.0,
)


def test_white_noise_has_the_density_that_was_asked_for() -> None:
    noisy, gyro_bias, accel_bias = ImuErrors(EUROC_IMU, np.random.default_rng(0)).add_to(STILL)
    gyro, accel = noisy.gyro_rad_s - gyro_bias, noisy.accel_m_s2 - accel_bias
    root_rate = np.sqrt(EUROC_IMU.rate_hz)
    np.testing.assert_allclose(gyro.std(axis=0), EUROC_IMU.gyro_noise_density * root_rate, rtol=0.02)
    np.testing.assert_allclose(accel.std(axis=0), EUROC_IMU.accel_noise_density * root_rate, rtol=0.02)
    correlation = np.corrcoef(np.hstack([gyro[1:], accel[1:], gyro[:-1], accel[:-1]]).T)
    assert np.abs(correlation - np.eye(12)).max() < 0.03  # white, and no axis knows of another


def test_biases_walk_with_the_density_that_was_asked_for() -> None:
    rng = np.random.default_rng(1)
    seconds = STILL[:: int(EUROC_IMU.rate_hz)]  # the walk depends on time, not on the number of samples
    walks = [ImuErrors(EUROC_IMU, rng).add_to(seconds)[1:] for _ in range(40)]
    spread = np.stack([[np.diff(gyro, axis=0), np.diff(accel, axis=0)] for gyro, accel in walks])
    np.testing.assert_allclose(spread[:, 0].std(), EUROC_IMU.gyro_random_walk, rtol=0.02)
    np.testing.assert_allclose(spread[:, 1].std(), EUROC_IMU.accel_random_walk, rtol=0.02)
    after_16_s = np.stack([[gyro[16:] - gyro[:-16], accel[16:] - accel[:-16]] for gyro, accel in walks])
    np.testing.assert_allclose(after_16_s[:, 0].std(), 4.0 * EUROC_IMU.gyro_random_walk, rtol=0.1)


def test_biases_at_switch_on_have_the_spread_that_was_asked_for() -> None:
    starts = [ImuErrors(EUROC_IMU, np.random.default_rng(seed)).add_to(STILL[:1])[1:] for seed in range(1000)]
    gyro, accel = (np.concatenate(s) for s in zip(*starts, strict=True))
    np.testing.assert_allclose(gyro.std(), EUROC_IMU.gyro_turn_on_bias_rad_s, rtol=0.05)
    np.testing.assert_allclose(accel.std(), EUROC_IMU.accel_turn_on_bias_m_s2, rtol=0.05)


def test_a_perfect_sensor_adds_nothing() -> None:
    rng = np.random.default_rng(2)
    perfect = ImuSamples(STILL.t_ns, rng.normal(size=(N, 3)), rng.normal(size=(N, 3)), "increment")
    noisy, gyro_bias, accel_bias = ImuErrors(SILENT, rng).add_to(perfect)
    np.testing.assert_array_equal(noisy.gyro_rad_s, perfect.gyro_rad_s)
    np.testing.assert_array_equal(noisy.accel_m_s2, perfect.accel_m_s2)
    assert noisy.sampling == "increment"
    assert not gyro_bias.any() and not accel_bias.any()


def test_batches_go_on_where_the_last_one_ended() -> None:
    walking = ImuModel(gyro_noise_density=0.0, accel_noise_density=0.0)
    errors = ImuErrors(walking, np.random.default_rng(3))
    first, gyro_bias, _ = errors.add_to(STILL[:1000])
    errors.add_to(STILL[1000:1000])
    second, _, _ = errors.add_to(STILL[1000:2000])
    np.testing.assert_array_equal(first.gyro_rad_s, gyro_bias)
    jump = np.abs(second.gyro_rad_s[0] - first.gyro_rad_s[-1]) / (walking.gyro_random_walk * np.sqrt(5e-3))
    assert np.all(jump > 0.0) and np.all(jump < 5.0)


@pytest.mark.parametrize("seed", [0, 7])
def test_same_seed_same_bytes(seed: int) -> None:
    one, other, stranger = (
        ImuErrors(EUROC_IMU, np.random.default_rng(s)).add_to(STILL[:100])[0] for s in (seed, seed, seed + 1)
    )
    assert one.gyro_rad_s.tobytes() == other.gyro_rad_s.tobytes()
    assert one.accel_m_s2.tobytes() == other.accel_m_s2.tobytes()
    assert np.mean(one.gyro_rad_s == stranger.gyro_rad_s) < 0.1  # the steps are coarse: some coincide
