"""Collects keyframes into the windows that are adjusted."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dronevio.estimator.calibration.config import CalibrationConfig
from dronevio.estimator.calibration.window import WindowKeyframe

PART_GROWTH = 1.4
"""Ratio of the lengths of successive parts of a window that are adjusted before it is complete."""
MIN_COMMON = 8
"""Smallest number of landmarks that successive keyframes of a window in motion observe both. With fewer, the IMU
connects them, and a single wrong feature looks like another calibration."""


@dataclass(frozen=True, eq=False)
class CalibrationWindow:
    """Keyframes that are adjusted together."""

    keyframes: tuple[WindowKeyframe, ...]
    """The keyframes in the order of time."""
    begins_stationary: bool
    """Whether the vehicle is stationary at the first of them."""
    is_complete: bool = True
    """Whether the next window begins after it; otherwise it is the beginning of a window that continues."""


class WindowCollector:
    """Collects keyframes until they are a window.

    Windows do not overlap. One that begins at rest begins with the last keyframe before the motion, and its beginning
    is adjusted several times while it grows.
    """

    def __init__(self, config: CalibrationConfig) -> None:
        """Begin without keyframes.

        Args:
            config: Settings.
        """
        self._config = config
        self._keyframes: list[WindowKeyframe] = []
        self._is_stationary = self._begins_stationary = False  # throughout the window, and at its beginning
        self._next_s = config.window_s  # length of the window at its next adjustment

    def restart(self) -> None:
        """Discard the keyframes, because their states are not consistent with those that follow."""
        self._keyframes, self._is_stationary = [], False

    def discard(self) -> None:
        """Discard the keyframes of the window under way."""
        self._keyframes = []

    def after(self, t_ns: int) -> Sequence[WindowKeyframe]:
        """Return the keyframes of the window under way that are later than a time [ns]."""
        return [keyframe for keyframe in self._keyframes if keyframe.state.t_ns > t_ns]

    def is_connected(self, keyframe: WindowKeyframe) -> bool:
        """Return whether the next keyframe has enough landmarks in common with the last one of the window, if any."""
        return not self._keyframes or len(np.intersect1d(self._keyframes[-1].ids, keyframe.ids)) >= MIN_COMMON

    def add(self, keyframe: WindowKeyframe, stationary: bool) -> CalibrationWindow | None:
        """Add a keyframe and return a window, or the beginning of one, that is due.

        Args:
            keyframe: The keyframe.
            stationary: Whether the vehicle is stationary since the previous keyframe.
        """
        c = self._config
        if stationary and self._is_stationary:
            self._keyframes = []
        if not self._keyframes:
            self._is_stationary = self._begins_stationary = stationary
            self._next_s = min(c.first_window_s, c.window_s) if stationary else c.window_s
        self._is_stationary &= stationary
        self._keyframes.append(keyframe)
        span_s = (keyframe.state.t_ns - self._keyframes[0].state.t_ns) * 1e-9
        if span_s >= c.window_s or len(self._keyframes) >= c.max_keyframes:
            window, self._keyframes = CalibrationWindow(tuple(self._keyframes), self._begins_stationary), []
            return window
        if span_s >= self._next_s and not self._is_stationary:
            self._next_s *= PART_GROWTH
            return CalibrationWindow(tuple(self._keyframes), self._begins_stationary, is_complete=False)
        return None
