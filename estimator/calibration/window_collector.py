"""Collects keyframes into the windows that are adjusted."""

from dataclasses import dataclass, replace

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


@dataclass(frozen=True, eq=False)
class CollectedKeyframes:
    """Keyframes that are collected until they are a window.

    Windows do not overlap. One that begins at rest begins with the last keyframe before the motion, and its beginning
    is adjusted several times while it grows.
    """

    keyframes: tuple[WindowKeyframe, ...] = ()
    """The keyframes in the order of time."""
    begins_stationary: bool = False
    """Whether the vehicle is stationary at the first of them."""
    adjusted_s: float = 0.0
    """Time that the keyframes span at the next adjustment [s]."""

    @property
    def is_stationary(self) -> bool:
        """Whether the vehicle has been stationary so far."""
        return self.begins_stationary and len(self.keyframes) == 1

    def after(self, t_ns: int) -> tuple[WindowKeyframe, ...]:
        """Return the keyframes that are later than a time [ns]."""
        return tuple(keyframe for keyframe in self.keyframes if keyframe.state.t_ns > t_ns)

    def is_connected(self, keyframe: WindowKeyframe) -> bool:
        """Return whether the next keyframe has enough landmarks in common with the last one, if any."""
        return not self.keyframes or len(np.intersect1d(self.keyframes[-1].ids, keyframe.ids)) >= MIN_COMMON

    def added(
        self, keyframe: WindowKeyframe, config: CalibrationConfig, *, stationary: bool
    ) -> tuple["CollectedKeyframes", CalibrationWindow | None]:
        """Return the keyframes with another one, and a window, or the beginning of one, that is due.

        Args:
            keyframe: The next keyframe.
            config: Settings.
            stationary: Whether the vehicle is stationary since the previous keyframe.
        """
        if not self.keyframes or (stationary and self.is_stationary):
            length_s = min(config.first_window_s, config.window_s) if stationary else config.window_s
            return CollectedKeyframes((keyframe,), stationary, length_s), None
        keyframes = (*self.keyframes, keyframe)
        span_s = (keyframe.state.t_ns - keyframes[0].state.t_ns) * 1e-9
        if span_s >= config.window_s or len(keyframes) >= config.max_keyframes:
            return NO_KEYFRAMES, CalibrationWindow(keyframes, self.begins_stationary)
        if span_s < self.adjusted_s:
            return replace(self, keyframes=keyframes), None
        part = CalibrationWindow(keyframes, self.begins_stationary, is_complete=False)
        return replace(self, keyframes=keyframes, adjusted_s=PART_GROWTH * self.adjusted_s), part


NO_KEYFRAMES = CollectedKeyframes()
"""What is collected before the first keyframe of a window."""
