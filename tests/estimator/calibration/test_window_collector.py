"""Windows of keyframes: they end where too few landmarks connect them."""

import numpy as np
import numpy.typing as npt

from dronevio.estimator.calibration.config import CalibrationConfig
from dronevio.estimator.calibration.window import WindowKeyframe
from dronevio.estimator.calibration.window_collector import MIN_COMMON, CalibrationWindow, WindowCollector
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.state import NavState


def keyframe(t_s: float, ids: npt.NDArray[np.int64]) -> WindowKeyframe:
    """Return a keyframe that observes landmarks."""
    state = NavState(round(t_s * 1e9), np.eye(4), np.zeros(3), np.zeros(3), np.zeros(3))
    camera, xy = np.zeros(len(ids), np.int64), np.zeros((len(ids), 2))
    return WindowKeyframe(state, np.zeros(3), 0.0, GRAVITY_M_S2, None, ids, camera, xy)


def windows(common: int, stationary: bool = False) -> list[CalibrationWindow]:
    """Return the windows of 6 s of keyframes, of which those before and after 3 s have some landmarks in common."""
    collector = WindowCollector(CalibrationConfig(window_s=5.0))
    due = []
    for t_s in np.arange(0.0, 6.05, 0.5):
        ids = np.arange(20) + (20 - common if t_s >= 3.0 else 0)
        window = collector.add(keyframe(t_s, ids), stationary)
        due += [window] if window is not None and window.is_complete else []
    return due


def test_a_window_is_connected_by_landmarks() -> None:
    (whole,) = windows(MIN_COMMON)
    assert [k.state.t_ns for k in whole.keyframes][::10] == [0, 5_000_000_000]
    assert windows(MIN_COMMON - 1) == []  # neither part lasts for 5 s


def test_at_rest_landmarks_need_not_connect_it() -> None:
    """Every keyframe at rest begins the window anew; the first one in motion continues it."""
    assert windows(MIN_COMMON - 1, stationary=True) == []
    collector = WindowCollector(CalibrationConfig(first_window_s=0.8))
    collector.add(keyframe(0.0, np.arange(20)), stationary=True)
    moving = (collector.add(keyframe(t_s, np.arange(20)), stationary=False) for t_s in (0.5, 1.0))
    parts = [part for part in moving if part is not None]
    assert len(parts) == 1 and parts[0].begins_stationary and len(parts[0].keyframes) == 3
