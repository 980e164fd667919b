"""Zero-velocity detection: the image does not move, and the IMU does not contradict it."""

import numpy as np
import pytest

from dronevio.estimator.imu.buffer import NO_INCREMENTS, Increments
from dronevio.estimator.initialization.zero_velocity import ZeroVelocityConfig, ZeroVelocityDetector
from dronevio.estimator.types import Observations
from dronevio.models.imu import GRAVITY_M_S2

FRAME_NS = 50_000_000
CONFIG = ZeroVelocityConfig()


def observed(moved_px: float = 0.0, n: int = 40, first_id: int = 0, seed: int = 0) -> Observations:
    rng = np.random.default_rng(0)
    pixels = rng.uniform(20.0, 400.0, (n, 2)) + [moved_px, 0.0]
    pixels += np.random.default_rng(seed).normal(0.0, 0.05, (n, 2))
    return Observations(first_id + np.arange(n), pixels, pixels / 400.0, np.ones(n, np.int64))


def imu_increments(gyro: float = 0.01, accel: float = GRAVITY_M_S2 + 0.1, n: int = 10) -> Increments:
    return Increments(np.full(n, 0.005), np.tile([gyro, 0.0, 0.0], (n, 1)), np.tile([accel, 0.0, 0.0], (n, 1)))


def stationary_times(sequence: list[tuple[Observations, Increments]]) -> list[float]:
    """Return the stationary time after each frame [s]."""
    detector = ZeroVelocityDetector(CONFIG)
    stationary_s = []
    for k, (observations, increments) in enumerate(sequence):
        detector.update(10**18 + k * FRAME_NS, observations, increments)
        stationary_s.append(detector.stationary_s)
    return stationary_s


def test_stationary_time_starts_at_the_first_frame() -> None:
    stationary_s = stationary_times([(observed(seed=k), imu_increments()) for k in range(10)])
    np.testing.assert_allclose(stationary_s, 0.05 * np.arange(10), atol=1e-12)


def test_motion_has_no_stationary_time() -> None:
    assert not any(stationary_times([(observed(moved_px=2.0 * k), imu_increments()) for k in range(10)]))


def test_slow_drift_accumulates_from_the_reference() -> None:
    """A drift of 0.1 px per frame is below the threshold from each frame to the next."""
    stationary_s = stationary_times([(observed(moved_px=0.1 * k), imu_increments()) for k in range(40)])
    assert 0.2 < max(stationary_s) < 0.5


def test_stationary_time_restarts_after_a_step() -> None:
    stationary_s = stationary_times([(observed(moved_px=5.0 * (k >= 6), seed=k), imu_increments()) for k in range(12)])
    np.testing.assert_allclose(stationary_s, [0.05 * (k - 6 * (k >= 6)) for k in range(12)], atol=1e-12)


@pytest.mark.parametrize(
    "increments",
    [
        imu_increments(gyro=1.5 * CONFIG.max_gyro_rad_s),
        imu_increments(accel=GRAVITY_M_S2 + 1.5 * CONFIG.max_accel_error_m_s2),
        imu_increments(accel=GRAVITY_M_S2 - 1.5 * CONFIG.max_accel_error_m_s2),
        imu_increments(n=0),
    ],
    ids=["rotates", "accelerates", "falls", "no samples"],
)
def test_imu_contradicts_a_constant_image(increments: Increments) -> None:
    stationary_s = stationary_times(
        [
            (observed(), imu_increments()),
            (observed(), imu_increments()),
            (observed(), increments),
            (observed(), imu_increments()),
        ]
    )
    np.testing.assert_allclose(stationary_s, [0.0, 0.05, 0.0, 0.05], atol=1e-12)


def test_zero_mean_vibration_is_not_motion() -> None:
    at_rest = imu_increments(n=10)
    vibration = np.tile([[1.0], [-1.0]], (5, 1)) * [3.0, 0.0, 0.0]
    stationary_s = stationary_times(
        [(observed(), Increments(at_rest.dt_s, at_rest.gyro_rad_s + vibration, at_rest.accel_m_s2 + vibration))] * 4
    )
    np.testing.assert_allclose(stationary_s, 0.05 * np.arange(4), atol=1e-12)


def test_few_features_do_not_prove_zero_velocity() -> None:
    few = CONFIG.min_features - 1
    assert not any(stationary_times([(observed(n=few), imu_increments())] * 5))
    assert any(stationary_times([(observed(n=few + 1), imu_increments())] * 5))


def test_features_need_equal_identities() -> None:
    assert not any(stationary_times([(observed(first_id=100 * k), imu_increments()) for k in range(5)]))


def test_a_minority_of_moving_features_is_not_motion() -> None:
    """A third of the features lie on moving objects."""

    def with_moving_features(k: int) -> Observations:
        observations = observed(seed=k)
        observations.pixels[::3] += 8.0 * k
        return observations

    stationary_s = stationary_times([(with_moving_features(k), imu_increments()) for k in range(6)])
    np.testing.assert_allclose(stationary_s, 0.05 * np.arange(6), atol=1e-12)


def test_frames_without_an_image_are_tested_by_the_imu() -> None:
    """The features of the next image are compared with those before; a motion of the IMU ends the interval."""
    detector = ZeroVelocityDetector(CONFIG)
    for k in range(6):
        detector.update(k * FRAME_NS, None if k in (0, 3) else observed(seed=k), imu_increments())
    assert detector.stationary_s == pytest.approx(4 * FRAME_NS * 1e-9)
    detector.update(6 * FRAME_NS, None, imu_increments(gyro=2.0 * CONFIG.max_gyro_rad_s))
    assert detector.stationary_s == 0.0


@pytest.mark.parametrize("rate_hz", [10, 20, 60, 200])
def test_vibration_at_rest_is_no_motion_at_any_frame_rate(rate_hz: int) -> None:
    """A vibration of 40 Hz vanishes in a mean over a twentieth of a second, though not between two frames."""
    detector, stationary_s = ZeroVelocityDetector(CONFIG), 0.0
    t_ns = 10**18 + np.rint(np.arange(0.0, 0.5, 1.0 / rate_hz) * 1e9).astype(np.int64)
    imu_ns = np.arange(t_ns[0], t_ns[-1] + 1, 5_000_000)
    accel_m_s2 = GRAVITY_M_S2 + 4.0 * np.sin(2.0 * np.pi * 40.0 * (imu_ns - t_ns[0]) * 1e-9)
    for k, now_ns in enumerate(t_ns.tolist()):
        rows = (imu_ns > t_ns[max(k - 1, 0)]) & (imu_ns <= now_ns)
        samples = np.column_stack([accel_m_s2, *np.zeros((2, len(imu_ns)))])[rows]
        detector.update(now_ns, observed(seed=k), Increments(np.full(len(samples), 0.005), 0.0 * samples, samples))
        stationary_s = detector.stationary_s
    assert stationary_s > 0.35  # but for the first frames, before there are readings for the time


def test_a_gap_of_the_imu_is_no_rest() -> None:
    """Readings before the gap do not stand for those that are missing."""
    frames = [(observed(seed=k), imu_increments() if k != 5 else NO_INCREMENTS) for k in range(8)]
    np.testing.assert_allclose(stationary_times(frames)[5:], [0.0, 0.05, 0.1], atol=1e-12)
