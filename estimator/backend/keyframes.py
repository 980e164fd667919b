"""Keyframe selection: by time, by the share of tracked features and by the innovation."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt

from dronevio.estimator.types import Observations, common_rows
from dronevio.models.ranges import Range, Settings

STATIONARY_INTERVAL_S = 0.5
"""Shortest time between keyframes while the drone is stationary [s]."""
MIN_INTERVAL_S = 0.1
"""Shortest time to the last keyframe for a keyframe by innovation [s], so that the window does not become short."""
TIME_TOLERANCE_S = 0.001
"""Tolerance of time intervals [s], because time stamps are rounded and jitter."""


@dataclass(frozen=True)
class KeyframeConfig(Settings):
    """When a frame becomes a keyframe."""

    interval_s: Annotated[float, Range(0.01, 5.0)] = 0.2
    """Time between keyframes in motion, to the nearest frame [s]."""
    every_image: bool = False
    """Whether every image of a stereo rig is tracked. Otherwise those between keyframes are left out, as long as the
    image moves slowly and they show the features where they are expected, which takes a tenth less time."""
    min_tracked: Annotated[float, Range(0.0, 1.0)] = 0.6
    """Smallest share of the last keyframe's features that is still tracked. With fewer, the frame becomes a keyframe
    before `interval_s`."""
    max_innovation_px: Annotated[float, Range(above=0.0)] = 2.0
    """Largest median innovation of the landmarks [px]. Beyond it, for example after a shock, the frame becomes a
    keyframe before `interval_s`."""


class KeyframePolicy:
    """Decides whether a frame becomes a keyframe, by comparison with the last keyframe."""

    def __init__(self, config: KeyframeConfig) -> None:
        """Create a policy without a keyframe.

        Args:
            config: Settings.
        """
        self._config = config
        self._ids: npt.NDArray[np.int64] = np.zeros(0, np.int64)  # features of the last keyframe

    def set_reference(self, observations: Observations) -> None:
        """Set the observations of the last keyframe, with which frames are compared."""
        self._ids = observations.ids

    def is_due(
        self,
        elapsed_s: float,
        frame_s: float,
        stationary_s: float,
        observations: Observations,
        innovation_px: float | None = None,
    ) -> bool:
        """Return whether a frame becomes a keyframe.

        Args:
            elapsed_s: Time since the last keyframe [s].
            frame_s: Time since the last frame [s].
            stationary_s: Time for which the drone has been stationary [s].
            observations: Observations of the frame.
            innovation_px: Median innovation of the landmarks [px]; None without landmarks.
        """
        c = self._config
        if self.is_stationary(elapsed_s, stationary_s):
            return self.is_interval_over(elapsed_s, frame_s, stationary=True)
        tracked = len(common_rows(self._ids, observations.ids)[0]) / len(self._ids) if len(self._ids) else 1.0
        is_implausible = (innovation_px or 0.0) > c.max_innovation_px
        is_implausible &= elapsed_s >= MIN_INTERVAL_S - TIME_TOLERANCE_S
        is_late = self.is_interval_over(elapsed_s, frame_s, stationary=False)
        return is_late or tracked < c.min_tracked or is_implausible

    def is_interval_over(self, elapsed_s: float, frame_s: float, *, stationary: bool) -> bool:
        """Return whether the time between keyframes has elapsed; in motion, to the nearest frame.

        Args:
            elapsed_s: Time since the last keyframe [s].
            frame_s: Time since the last frame, and probably until the next one [s].
            stationary: Whether the drone has been stationary since then.
        """
        if stationary:
            return elapsed_s >= STATIONARY_INTERVAL_S - TIME_TOLERANCE_S
        return elapsed_s + 0.5 * frame_s >= self._config.interval_s - TIME_TOLERANCE_S

    @staticmethod
    def is_stationary(elapsed_s: float, stationary_s: float) -> bool:
        """Return whether the drone has been stationary since the last keyframe.

        Args:
            elapsed_s: Time since the last keyframe [s].
            stationary_s: Time for which the drone has been stationary [s].
        """
        return stationary_s >= elapsed_s
