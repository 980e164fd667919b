"""Windows of keyframes: what connects them, and how they begin."""

import numpy as np
import numpy.typing as npt

from dronevio.estimator.calibration.config import CalibrationConfig
from dronevio.estimator.calibration.window import WindowKeyframe
from dronevio.estimator.calibration.window_collector import MIN_COMMON, WindowCollector
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.state import NavState


def keyframe(t_s: float, ids: npt.NDArray[np.int64]) -> WindowKeyframe:
    """Return a keyframe that observes landmarks."""
    state = NavState(round(t_s * 1e9), np.eye(4), np.zeros(3), np.zeros(3), np.zeros(3))
    camera, xy = np.zeros(len(ids), np.int64), np.zeros((len(ids), 2))
    return WindowKeyframe(state, np.zeros(3), 0.0, GRAVITY_M_S2, None, ids, camera, xy)


def test_a_window_is_connected_by_landmarks() -> None:
    collector = WindowCollector(CalibrationConfig())
    assert collector.is_connected(keyframe(0.0, np.arange(3)))  # the first one
    collector.add(keyframe(0.0, np.arange(20)), stationary=False)
    assert collector.is_connected(keyframe(0.5, np.arange(20 - MIN_COMMON, 40)))
    assert not collector.is_connected(keyframe(0.5, np.arange(21 - MIN_COMMON, 40)))


def test_the_first_keyframe_in_motion_continues_a_rest() -> None:
    collector = WindowCollector(CalibrationConfig(first_window_s=0.8))
    collector.add(keyframe(0.0, np.arange(20)), stationary=True)
    moving = (collector.add(keyframe(t_s, np.arange(20)), stationary=False) for t_s in (0.5, 1.0))
    parts = [part for part in moving if part is not None]
    assert len(parts) == 1 and parts[0].begins_stationary and len(parts[0].keyframes) == 3
