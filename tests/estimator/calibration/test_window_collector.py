"""Windows of keyframes: what connects them, and how they begin."""

import numpy as np
import numpy.typing as npt

from dronevio.estimator.calibration.config import CalibrationConfig
from dronevio.estimator.calibration.window import WindowKeyframe
from dronevio.estimator.calibration.window_collector import MIN_COMMON, NO_KEYFRAMES, CalibrationWindow
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.state import NavState


def keyframe(t_s: float, ids: npt.NDArray[np.int64]) -> WindowKeyframe:
    """Return a keyframe that observes landmarks."""
    state = NavState(round(t_s * 1e9), np.eye(4), np.zeros(3), np.zeros(3), np.zeros(3))
    camera, xy = np.zeros(len(ids), np.int64), np.zeros((len(ids), 2))
    return WindowKeyframe(state, np.zeros(3), 0.0, GRAVITY_M_S2, None, ids, camera, xy)


def test_a_window_is_connected_by_landmarks() -> None:
    assert NO_KEYFRAMES.is_connected(keyframe(0.0, np.arange(3)))  # the first one
    collected, _ = NO_KEYFRAMES.added(keyframe(0.0, np.arange(20)), CalibrationConfig(), stationary=False)
    assert collected.is_connected(keyframe(0.5, np.arange(20 - MIN_COMMON, 40)))
    assert not collected.is_connected(keyframe(0.5, np.arange(21 - MIN_COMMON, 40)))


def windows(stationary: list[bool], config: CalibrationConfig) -> list[CalibrationWindow]:
    """Return the windows, and beginnings of windows, of keyframes at intervals of half a second."""
    collected, found = NO_KEYFRAMES, list[CalibrationWindow]()
    for i, is_stationary in enumerate(stationary):
        collected, window = collected.added(keyframe(0.5 * i, np.arange(20)), config, stationary=is_stationary)
        found += [window] if window is not None else []
    return found


def test_the_first_keyframe_in_motion_continues_a_rest() -> None:
    (part,) = windows([True, False, False], CalibrationConfig(first_window_s=0.8))
    assert part.begins_stationary and len(part.keyframes) == 3 and not part.is_complete


def test_a_window_begins_with_the_last_keyframe_at_rest() -> None:
    """A rest during it does not begin another. A part of 1.5 s is adjusted before it is complete."""
    config = CalibrationConfig(window_s=2.5, first_window_s=1.5)
    part, window = windows([True, True, True, False, False, True, True, False], config)
    assert part.keyframes[0].state.t_ns == window.keyframes[0].state.t_ns == 1_000_000_000
    assert (len(part.keyframes), len(window.keyframes)) == (4, 6)
    assert not part.is_complete and window.is_complete


def test_a_window_in_motion_has_no_parts() -> None:
    first, second = windows([False] * 7, CalibrationConfig(max_keyframes=3))
    assert first.is_complete and second.is_complete and not first.begins_stationary
    assert [w.keyframes[0].state.t_ns for w in (first, second)] == [0, 1_500_000_000]
