"""Outlying samples of the IMU, and the buffer that leaves them out."""

import numpy as np
import pytest

from dronevio.estimator.imu.buffer import ImuBuffer
from dronevio.estimator.imu.outliers import LOOKAHEAD, MAX_RUN, OutlierFilter, outlying_samples
from dronevio.models.imu import EUROC_IMU, ImuSamples, Sampling

STEP_NS = 5_000_000
N = 600


def flight(seed: int = 0, noise: float = 1.0, rate_hz: float = 200.0, sampling: Sampling = "point") -> ImuSamples:
    """Return the samples of a smooth motion with noise and vibration."""
    rng, t_s = np.random.default_rng(seed), np.arange(N) / rate_hz
    motion = np.sin(2.0 * np.pi * 0.7 * t_s)[:, None]
    shake = np.sin(2.0 * np.pi * 0.31 * rate_hz * t_s)[:, None]
    gyro = motion * [1.0, 0.3, -0.5] + noise * (0.02 * shake + 0.01 * rng.normal(size=(N, 3)))
    accel = motion * [2.0, -1.0, 3.0] + [0.0, 0.0, 9.81] + noise * (0.5 * shake + 0.2 * rng.normal(size=(N, 3)))
    return ImuSamples(np.round(t_s * 1e9).astype(np.int64), gyro, accel, sampling)


def with_errors(samples: ImuSamples, rows: list[int], accel: float = 0.0, gyro: float = 0.0) -> ImuSamples:
    """Return samples with errors on one axis in some rows."""
    changed_gyro, changed_accel = samples.gyro_rad_s.copy(), samples.accel_m_s2.copy()
    changed_gyro[rows, 1] += gyro
    changed_accel[rows, 2] += accel
    return ImuSamples(samples.t_ns, changed_gyro, changed_accel, samples.sampling)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("noise", [0.0, 1.0, 10.0])
def test_a_flight_has_no_outliers(seed: int, noise: float) -> None:
    assert not outlying_samples(flight(seed, noise)).any()


@pytest.mark.parametrize("sampling", ["point", "increment"])
@pytest.mark.parametrize(("accel", "gyro"), [(150.0, 30.0), (-150.0, 0.0), (0.0, -30.0), (20.0, 0.0), (0.0, 3.0)])
def test_single_values_and_short_runs_are_outliers(sampling: Sampling, accel: float, gyro: float) -> None:
    rows = [9, 100, 102, 200, 201, 300, 301, 302, N - 4]
    found = outlying_samples(with_errors(flight(sampling=sampling), rows, accel, gyro))
    assert np.flatnonzero(found).tolist() == rows


def test_a_longer_run_and_a_step_are_motions() -> None:
    samples = flight()
    assert not outlying_samples(with_errors(samples, list(range(100, 101 + MAX_RUN)), 50.0)).any()
    assert not outlying_samples(with_errors(samples, list(range(100, N)), 50.0)).any()


def test_an_impact_leaves_the_vehicle_ringing() -> None:
    samples = flight(noise=0.1)
    accel, k = samples.accel_m_s2.copy(), np.arange(60)
    accel[200:260, 2] += 60.0 * np.exp(-k / 8.0) * np.cos(2.0 * np.pi * 0.27 * k)
    assert not outlying_samples(ImuSamples(samples.t_ns, samples.gyro_rad_s, accel)).any()


def test_vibration_that_begins_is_at_most_one_outlier() -> None:
    samples = flight(noise=0.1)
    accel, k = samples.accel_m_s2.copy(), np.arange(N - 300)
    accel[300:] += (15.0 * np.minimum(k / 100.0, 1.0) * np.sin(2.0 * np.pi * 87.0 / 200.0 * k))[:, None]
    assert outlying_samples(ImuSamples(samples.t_ns, samples.gyro_rad_s, accel)).sum() <= 1


def test_readings_at_the_range_are_clipped_and_not_outliers() -> None:
    samples = flight()
    accel = samples.accel_m_s2.copy()
    accel[100:102, 2], accel[200, 2] = EUROC_IMU.accel_range_m_s2, 1.1 * EUROC_IMU.accel_range_m_s2
    changed = ImuSamples(samples.t_ns, samples.gyro_rad_s, accel)
    assert np.flatnonzero(outlying_samples(changed, EUROC_IMU)).tolist() == [200]
    assert np.flatnonzero(outlying_samples(changed)).tolist() == [100, 101, 200]


@pytest.mark.parametrize("seed", range(10))
def test_the_result_does_not_depend_on_how_the_stream_is_divided(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows = sorted((8 * rng.choice(np.arange(2, N // 8 - 2), 30, replace=False)).tolist())
    samples = with_errors(flight(seed), rows, 80.0)
    whole, parts, filtered, row = OutlierFilter().add(samples), [], OutlierFilter(), 0
    while row < N:
        size = int(rng.integers(1, 12))
        part = filtered.add(samples[row : row + size])
        assert not len(part) or part.t_ns[-1] <= samples.t_ns[min(row + size, N) - 1]  # causal
        assert len(part) >= min(size, N - row) - MAX_RUN - LOOKAHEAD
        parts.append(part)
        row += size
    joined = ImuSamples.concatenated(parts)
    np.testing.assert_array_equal(joined.t_ns, whole.t_ns)
    assert filtered.rejected == N - len(joined) == len(rows)


def test_samples_without_a_jump_are_returned_at_once() -> None:
    filtered, samples = OutlierFilter(), flight()
    for row in range(N):
        assert len(filtered.add(samples[row : row + 1])) == 1


def test_the_buffer_interpolates_outliers() -> None:
    samples, rows = flight(noise=0.0), [50, 120, 121]
    clean, faulty = ImuBuffer(EUROC_IMU), ImuBuffer(EUROC_IMU)
    clean.add(samples)
    faulty.add(with_errors(samples, rows, 150.0, 30.0))
    assert faulty.outliers == len(rows) and clean.outliers == 0
    end_ns = int(samples.t_ns[-10])
    expected, found = clean.take_until(end_ns), faulty.take_until(end_ns)
    assert found.duration_s == pytest.approx(expected.duration_s)
    np.testing.assert_allclose(found.dt_s @ found.gyro_rad_s, expected.dt_s @ expected.gyro_rad_s, atol=1e-4)
    np.testing.assert_allclose(found.dt_s @ found.accel_m_s2, expected.dt_s @ expected.accel_m_s2, atol=1e-3)
    assert not found.is_degraded


def test_a_frame_does_not_wait_for_the_decision() -> None:
    samples = with_errors(flight(noise=0.0), [99], 150.0)
    buffer = ImuBuffer(EUROC_IMU)
    buffer.add(samples[:100])
    taken = buffer.take_until(int(samples.t_ns[99]))
    assert taken.duration_s == pytest.approx(99 * 0.005)
    assert np.abs(taken.accel_m_s2).max() < 20.0
    buffer.add(samples[100:])
    assert np.abs(buffer.take_until(int(samples.t_ns[-10])).accel_m_s2).max() < 20.0
    assert buffer.outliers == 1
