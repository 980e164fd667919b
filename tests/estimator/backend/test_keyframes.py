"""When a frame becomes a keyframe."""

import numpy as np
import pytest

from dronevio.estimator.backend.keyframes import KeyframeConfig, KeyframePolicy
from dronevio.estimator.types import Observations

CONFIG = KeyframeConfig()


def seen(*ids: int) -> Observations:
    n = len(ids)
    return Observations(np.array(ids, dtype=np.int64), np.zeros((n, 2)), np.zeros((n, 2)), np.ones(n, np.int64))


@pytest.fixture
def policy() -> KeyframePolicy:
    policy = KeyframePolicy(CONFIG)
    policy.set_reference(seen(*range(10)))
    return policy


def test_time_makes_a_keyframe_sooner_in_motion_than_at_rest(policy: KeyframePolicy) -> None:
    frame = seen(*range(10))
    for elapsed_s, moving, resting in (
        (0.15, False, False),
        (0.1999, True, False),
        (0.45, True, False),
        (0.5, True, True),
    ):
        assert policy.is_due(elapsed_s, 0.0, frame) == moving
        assert policy.is_due(elapsed_s, 9.0, frame) == resting


def test_features_that_are_gone_make_a_keyframe(policy: KeyframePolicy) -> None:
    assert not policy.is_due(0.05, 0.0, seen(*range(4, 20)))
    assert policy.is_due(0.05, 0.0, seen(*range(5, 20)))
    assert policy.is_due(0.05, 0.0, seen())  # it has become dark


def test_darkness_is_no_reason_for_more_keyframes(policy: KeyframePolicy) -> None:
    policy.set_reference(seen())
    assert not policy.is_due(0.05, 0.0, seen())
    assert policy.is_due(0.2, 0.0, seen())


def test_surprise_makes_a_keyframe_but_not_every_frame(policy: KeyframePolicy) -> None:
    frame = seen(*range(10))
    assert not policy.is_due(0.15, 0.0, frame, 1.9) and not policy.is_due(0.15, 0.0, frame, None)
    assert policy.is_due(0.15, 0.0, frame, 2.1)
    assert not policy.is_due(0.05, 0.0, frame, 50.0)
