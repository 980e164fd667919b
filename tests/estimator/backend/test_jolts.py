"""A step of all images that the IMU has not felt: the interval is distrusted, and the scale stays as it was."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dronevio.estimator.backend import jolts
from dronevio.estimator.initialization.static import InitialSigmas
from dronevio.models.arrays import Array
from dronevio.models.state import NavState

if TYPE_CHECKING:
    from tests.estimator.conftest import KeyframeFeed, SyntheticFlight

MakeFlight = Callable[..., "SyntheticFlight"]
STEP_S, STEP_M = 2.5, np.array([0.06, 0.0, 0.0])


def velocity_errors(make_flight: MakeFlight, keyframe_feed: "type[KeyframeFeed]", step_m: Array) -> Array:
    """Return the errors (K,) of the velocity of the keyframes [m/s] if all landmarks move by a step after `STEP_S`."""
    flight = make_flight(0, rest_s=-5.0, duration_s=4.0, pixel_noise=0.03)
    begin_ns, still = int(flight.frame_times_ns[0]), flight.landmarks
    after_ns = begin_ns + round(1e9 * STEP_S)
    flight.__dict__["landmarks_at"] = lambda t_ns: still + (t_ns > after_ns) * step_m
    true = flight.state_at(begin_ns)
    start = NavState(begin_ns, true.T_world_imu, true.velocity_m_s, true.gyro_bias_rad_s, true.accel_bias_m_s2)
    feed = keyframe_feed(flight, start, InitialSigmas(velocity_m_s=0.3).covariance(true.T_world_imu[:3, :3])).finish()
    found = np.stack([state.velocity_m_s for state in feed.states])
    assert feed.truth.velocity_m_s is not None
    return np.asarray(np.linalg.norm(found - feed.truth.velocity_m_s, axis=1))


def test_the_velocity_is_right_again_one_keyframe_after_a_step(
    make_flight: MakeFlight, keyframe_feed: "type[KeyframeFeed]", monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without distrust of the IMU, its error is several times as large then."""
    distrusted = velocity_errors(make_flight, keyframe_feed, STEP_M)
    monkeypatch.setattr(jolts, "JOLT_RATIO", np.inf)
    trusted = velocity_errors(make_flight, keyframe_feed, STEP_M)
    first = int(STEP_S / 0.2)  # after the step
    np.testing.assert_array_equal(distrusted[:first], trusted[:first])
    assert distrusted[first + 1 :].max() < 0.01 < 0.3 * trusted[first + 1 :].max()


def test_without_a_step_nothing_is_distrusted(
    make_flight: MakeFlight, keyframe_feed: "type[KeyframeFeed]", monkeypatch: pytest.MonkeyPatch
) -> None:
    with_test = velocity_errors(make_flight, keyframe_feed, np.zeros(3))
    monkeypatch.setattr(jolts, "JOLT_RATIO", np.inf)
    np.testing.assert_array_equal(with_test, velocity_errors(make_flight, keyframe_feed, np.zeros(3)))
