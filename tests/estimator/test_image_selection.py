"""Selection of the images that are tracked: motion and keyframes, by hand and as properties."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dronevio.estimator.backend.keyframes import KeyframeConfig
from dronevio.estimator.image_selection import MAX_DISPLACEMENT, MIN_FEATURES, ImageSelection
from dronevio.estimator.types import Observations
from dronevio.models.arrays import Array
from dronevio.models.rotation import rotation_z

FRAME_S = 0.05
STILL = np.eye(3)
CONFIG = KeyframeConfig()


def features(shift: float = 0.0, n: int = 40) -> Observations:
    """Return features whose normalized coordinates are shifted along x."""
    xy = np.random.default_rng(0).uniform(-0.4, 0.4, (n, 2)) + [shift, 0.0]
    return Observations(np.arange(n), 400.0 * xy, xy, np.ones(n, np.int64))


def tracked(
    speed: float,
    R_cur_prev: Array = STILL,
    n: int = 40,
    config: KeyframeConfig = CONFIG,
    frames: int = 21,
    needs_flow: bool = False,
) -> list[int]:
    """Return the frames whose images are tracked; features move with a speed [1/s], and keyframes are due in time."""
    selection, chosen, keyframe = ImageSelection(config), list[int](), 0
    for k in range(frames):
        if selection.may_leave_out(FRAME_S, R_cur_prev, FRAME_S * (k - 1 - keyframe), needs_flow=needs_flow):
            continue
        selection.add(features(speed * FRAME_S * k, n))
        chosen.append(k)
        if k - keyframe >= 4:
            keyframe = k
    return chosen


def test_in_calm_flight_keyframes_alone_are_tracked() -> None:
    """At 0.3 per second, features move by 0.06 between keyframes; two images show that."""
    assert tracked(speed=0.3) == [0, 1, 4, 8, 12, 16, 20]
    assert tracked(speed=0.3, config=KeyframeConfig(interval_s=0.25)) == [0, 1, 5, 10, 15, 20]


def test_the_image_before_a_keyframe_is_tracked_where_the_flow_is_needed() -> None:
    assert tracked(speed=0.3, needs_flow=True) == [0, 1, 3, 4, 7, 8, 11, 12, 15, 16, 19, 20]


@pytest.mark.parametrize(
    ("speed", "R_cur_prev", "n", "config"),
    [
        (0.3, STILL, 40, KeyframeConfig(every_image=True)),
        (0.5, STILL, 40, CONFIG),
        (0.0, rotation_z(0.025), 40, CONFIG),
        (0.0, STILL, MIN_FEATURES - 1, CONFIG),
    ],
    ids=["if it is a setting", "fast", "turning", "few features"],
)
def test_every_image_is_tracked(speed: float, R_cur_prev: Array, n: int, config: KeyframeConfig) -> None:
    """At 0.5 per second, features would move by 0.1 between keyframes."""
    assert tracked(speed, R_cur_prev, n, config) == list(range(21))


@pytest.mark.parametrize(("since_s", "leaves_out"), [(None, False), (0.1, True), (0.126, False), (0.15, False)])
def test_the_image_of_a_keyframe_is_tracked(since_s: float | None, leaves_out: bool) -> None:
    """The frame nearest to 0.2 s after the last keyframe becomes the next one."""
    selection = ImageSelection(CONFIG)
    for k in range(2):
        assert not selection.may_leave_out(FRAME_S, STILL, None)
        selection.add(features(0.001 * k))
    assert selection.may_leave_out(FRAME_S, STILL, since_s) is leaves_out


def test_new_features_have_no_speed() -> None:
    """After the images have shown another place, the next one is tracked."""
    selection = ImageSelection(CONFIG)
    for k in range(3):
        selection.may_leave_out(FRAME_S, STILL, None)
        selection.add(replace(features(), ids=np.arange(40) + (1000 if k == 2 else 0)))
    assert not selection.may_leave_out(FRAME_S, STILL, 0.0)


@given(st.lists(st.tuples(st.floats(0.005, 0.15), st.floats(0.0, 0.1), st.floats(0.0, 0.3)), min_size=1, max_size=60))
def test_no_image_is_left_out_when_a_keyframe_is_due_or_features_are_fast(
    frames: list[tuple[float, float, float]],
) -> None:
    """Whatever the rate, the motion and the keyframes."""
    selection, speed, since_s, shift, last = ImageSelection(CONFIG), np.inf, 0.0, 0.0, None
    for frame_s, step, keyframe_s in frames:
        since_s, shift = since_s + frame_s, shift + step
        if selection.may_leave_out(frame_s, STILL, keyframe_s):
            assert keyframe_s + 1.5 * frame_s < CONFIG.interval_s
            assert speed * CONFIG.interval_s <= MAX_DISPLACEMENT + 1e-9
        else:
            selection.add(features(shift))
            speed, last, since_s = np.inf if last is None else (shift - last) / since_s, shift, 0.0
