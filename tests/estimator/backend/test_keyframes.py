"""Keyframe selection: by time, by the share of tracked features and by the innovation."""

import numpy as np
import pytest

from dronevio.estimator.backend.keyframes import KeyframeConfig, KeyframePolicy
from dronevio.estimator.types import Observations

FRAME_S = 0.05


def features(*ids: int) -> Observations:
    """Return observations of features, all at the principal point."""
    n = len(ids)
    return Observations(np.array(ids, dtype=np.int64), np.zeros((n, 2)), np.zeros((n, 2)), np.ones(n, np.int64))


@pytest.fixture
def policy() -> KeyframePolicy:
    """A policy with default settings whose last keyframe observes the features 0 to 9."""
    policy = KeyframePolicy(KeyframeConfig())
    policy.set_reference(features(*range(10)))
    return policy


@pytest.mark.parametrize(
    ("elapsed_s", "in_motion", "stationary"),
    [(0.15, False, False), (0.1999, True, False), (0.45, True, False), (0.5, True, True)],
)
def test_interval_is_longer_while_stationary(
    policy: KeyframePolicy, elapsed_s: float, in_motion: bool, stationary: bool
) -> None:
    frame = features(*range(10))
    assert policy.is_due(elapsed_s, FRAME_S, 0.0, frame) == in_motion
    assert policy.is_due(elapsed_s, FRAME_S, 9.0, frame) == stationary


@pytest.mark.parametrize("rate_hz", [7.5, 10.0, 12.0, 12.5, 15.0, 20.0, 24.0, 29.97, 60.0, 200.0])
@pytest.mark.parametrize("jitter_s", [0.0, 0.002])
def test_a_keyframe_is_the_frame_nearest_to_the_interval(
    policy: KeyframePolicy, rate_hz: float, jitter_s: float
) -> None:
    """At 12 Hz two frames, not three, are nearest to 0.2 s; jitter of the stamps does not halve the interval."""
    frames, frame_s = features(*range(10)), np.diff(np.arange(80) / rate_hz)
    frame_s += jitter_s * np.resize([1.0, -1.0], len(frame_s))
    elapsed_s = np.cumsum(frame_s)
    due = [policy.is_due(*times, 0.0, frames) for times in zip(elapsed_s.tolist(), frame_s.tolist(), strict=True)]
    assert abs(elapsed_s[due.index(True)] - 0.2) <= 0.5 / rate_hz + jitter_s + 0.001


def test_lost_features_make_a_keyframe(policy: KeyframePolicy) -> None:
    assert not policy.is_due(0.05, FRAME_S, 0.0, features(*range(4, 20)))  # six of ten are left
    assert policy.is_due(0.05, FRAME_S, 0.0, features(*range(5, 20)))
    assert policy.is_due(0.05, FRAME_S, 0.0, features())


def test_lost_features_are_ignored_while_stationary(policy: KeyframePolicy) -> None:
    assert not policy.is_due(0.05, FRAME_S, 9.0, features())


def test_without_features_only_time_counts(policy: KeyframePolicy) -> None:
    policy.set_reference(features())
    assert not policy.is_due(0.05, FRAME_S, 0.0, features())
    assert policy.is_due(0.2, FRAME_S, 0.0, features())


def test_large_innovation_makes_a_keyframe_after_0_1_s(policy: KeyframePolicy) -> None:
    frame = features(*range(10))
    assert not policy.is_due(0.15, FRAME_S, 0.0, frame, 1.9) and not policy.is_due(0.15, FRAME_S, 0.0, frame, None)
    assert policy.is_due(0.15, FRAME_S, 0.0, frame, 2.1)
    assert not policy.is_due(0.05, FRAME_S, 0.0, frame, 50.0)
