"""Keyframes that no feature connects with the ones before."""

import numpy as np
import pytest

from dronevio.estimator.monitoring.image_connection import ImageConnection, are_connected
from dronevio.estimator.types import Observations


@pytest.mark.parametrize(
    ("before", "now", "tracked", "expected"),
    [
        (range(20), range(12, 120), 90, True),  # 8 features in common
        (range(20), range(13, 120), 90, False),  # 7 features in common
        (range(100), range(85, 200), 90, True),  # 15 % of the features in common
        (range(100), range(86, 200), 90, False),  # 14 % of them, which may be tracked by mistake
        (range(100), range(100, 200), 0, True),  # after darkness
        (range(100), range(100, 105), 90, True),  # hardly anything is visible
        (range(0), range(100, 200), 90, True),  # the first keyframe
    ],
)
def test_keyframes_without_common_features_are_not_connected(
    before: range, now: range, tracked: int, expected: bool
) -> None:
    assert are_connected(np.array(before, np.int64), np.array(now, np.int64), tracked) is expected


def seen(ids: range) -> Observations:
    """Return observations of features."""
    count = len(ids)
    return Observations(np.array(ids, np.int64), np.zeros((count, 2)), np.zeros((count, 2)), np.ones(count, np.int64))


def test_keyframes_are_compared_with_those_before() -> None:
    connection, connected = ImageConnection(), []
    darkness = range(0)
    for tracked, keyframe in (
        (darkness, range(50)),
        (range(50), range(30, 80)),
        (range(30, 50), range(100, 150)),
        (darkness, None),
        (darkness, range(200, 250)),
    ):
        connection.add_frame(seen(tracked))
        connected += [] if keyframe is None else [connection.add_keyframe(seen(keyframe))]
    assert connected == [True, True, False, True]
