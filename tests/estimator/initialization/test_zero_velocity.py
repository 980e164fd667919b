"""Standing still: seen by the camera, and not denied by the IMU."""

import numpy as np
import pytest

from dronevio.estimator.imu.buffer import Increments
from dronevio.estimator.initialization.zero_velocity import ZeroVelocityConfig, ZeroVelocityDetector
from dronevio.estimator.types import Observations
from dronevio.models.imu import GRAVITY_M_S2

FRAME_NS = 50_000_000
CONFIG = ZeroVelocityConfig()


def seen(moved_px: float = 0.0, n: int = 40, first_id: int = 0, seed: int = 0) -> Observations:
    rng = np.random.default_rng(0)
    pixels = rng.uniform(20.0, 400.0, (n, 2)) + [moved_px, 0.0]
    pixels += np.random.default_rng(seed).normal(0.0, 0.05, (n, 2))
    return Observations(first_id + np.arange(n), pixels, pixels / 400.0, np.ones(n, np.int64))


def sensed(gyro: float = 0.01, accel: float = GRAVITY_M_S2 + 0.1, n: int = 10) -> Increments:
    return Increments(np.full(n, 0.005), np.tile([gyro, 0.0, 0.0], (n, 1)), np.tile([accel, 0.0, 0.0], (n, 1)))


def watch(sequence: list[tuple[Observations, Increments]]) -> list[float]:
    """Return for how long the drone has been still, after each frame [s]."""
    detector = ZeroVelocityDetector(CONFIG)
    still_s = []
    for k, (observations, increments) in enumerate(sequence):
        detector.update(10**18 + k * FRAME_NS, observations, increments)
        still_s.append(detector.stationary_s)
    return still_s


def test_rest_is_measured_from_the_first_frame_on() -> None:
    still_s = watch([(seen(seed=k), sensed()) for k in range(10)])
    np.testing.assert_allclose(still_s, 0.05 * np.arange(10), atol=1e-12)


def test_motion_is_never_rest() -> None:
    assert not any(watch([(seen(moved_px=2.0 * k), sensed()) for k in range(10)]))


def test_slow_drift_adds_up_against_the_anchor() -> None:
    """0.1 px a frame is below the threshold from each frame to the next."""
    still_s = watch([(seen(moved_px=0.1 * k), sensed()) for k in range(40)])
    assert 0.2 < max(still_s) < 0.5


def test_rest_begins_anew_after_a_step() -> None:
    still_s = watch([(seen(moved_px=5.0 * (k >= 6), seed=k), sensed()) for k in range(12)])
    np.testing.assert_allclose(still_s, [0.05 * (k - 6 * (k >= 6)) for k in range(12)], atol=1e-12)


@pytest.mark.parametrize(
    "increments",
    [
        sensed(gyro=1.5 * CONFIG.max_gyro_rad_s),
        sensed(accel=GRAVITY_M_S2 + 1.5 * CONFIG.max_accel_error_m_s2),
        sensed(accel=GRAVITY_M_S2 - 1.5 * CONFIG.max_accel_error_m_s2),
        sensed(n=0),
    ],
    ids=["turns", "is pushed", "falls", "is silent"],
)
def test_imu_can_deny_it(increments: Increments) -> None:
    still_s = watch([(seen(), sensed()), (seen(), sensed()), (seen(), increments), (seen(), sensed())])
    np.testing.assert_allclose(still_s, [0.0, 0.05, 0.0, 0.05], atol=1e-12)


def test_vibration_that_averages_out_does_not_deny_it() -> None:
    shaken = sensed(n=10)
    shake = np.tile([[1.0], [-1.0]], (5, 1)) * [3.0, 0.0, 0.0]
    still_s = watch([(seen(), Increments(shaken.dt_s, shaken.gyro_rad_s + shake, shaken.accel_m_s2 + shake))] * 4)
    np.testing.assert_allclose(still_s, 0.05 * np.arange(4), atol=1e-12)


def test_darkness_proves_nothing() -> None:
    few = CONFIG.min_features - 1
    assert not any(watch([(seen(n=few), sensed())] * 5))
    assert any(watch([(seen(n=few + 1), sensed())] * 5))


def test_features_must_be_the_same_ones() -> None:
    assert not any(watch([(seen(first_id=100 * k), sensed()) for k in range(5)]))


def test_some_moving_things_do_not_deny_it() -> None:
    """People walk through a third of the picture."""

    def crowded(k: int) -> Observations:
        observations = seen(seed=k)
        observations.pixels[::3] += 8.0 * k
        return observations

    still_s = watch([(crowded(k), sensed()) for k in range(6)])
    np.testing.assert_allclose(still_s, 0.05 * np.arange(6), atol=1e-12)
