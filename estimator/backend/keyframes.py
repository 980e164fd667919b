"""When a frame becomes a keyframe: one that gets a state of its own in the smoother's window."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.estimator.types import Observations

TIME_TOLERANCE_S = 0.001
"""Time stamps jitter: an interval of 0.2 s may come as 0.1999 s [s]."""


@dataclass(frozen=True)
class KeyframeConfig:
    """When a frame becomes a keyframe."""

    interval_s: float = 0.2
    """In motion, at the latest after this time [s]."""
    stationary_interval_s: float = 0.5
    """At rest, after this time [s]."""
    min_tracked: float = 0.6
    """Earlier, when less than this share of the last keyframe's features is left ..."""
    max_innovation_px: float = 2.0
    """... or when known landmarks are typically so far from where the IMU puts them [px], ten times as far as usual: a
    shock, or an IMU that errs, is not to be told for longer than need be ..."""
    min_interval_s: float = 0.1
    """... but not before this time for that reason, lest the window become short [s]."""


class KeyframePolicy:
    """Compares each frame with the last keyframe."""

    def __init__(self, config: KeyframeConfig) -> None:
        self._config = config
        self._ids: npt.NDArray[np.int64] = np.zeros(0, np.int64)  # of the last keyframe's features

    def set_reference(self, observations: Observations) -> None:
        """Take a keyframe: what comes is compared with what it sees."""
        self._ids = observations.ids

    def is_due(
        self, elapsed_s: float, stationary_s: float, observations: Observations, innovation_px: float | None = None
    ) -> bool:
        """Say whether a frame becomes a keyframe.

        Args:
            elapsed_s: Time since the last keyframe [s].
            stationary_s: For how long the drone has not moved [s].
            observations: What the frame shows.
            innovation_px: How far known landmarks are from where they should be [px]; None without any.
        """
        c = self._config
        if self.is_stationary(elapsed_s, stationary_s):
            return self.is_interval_over(elapsed_s, stationary=True)
        left = np.isin(self._ids, observations.ids).mean() if len(self._ids) else 1.0  # darkness is not worth a window
        surprised = (innovation_px or 0.0) > c.max_innovation_px and elapsed_s >= c.min_interval_s - TIME_TOLERANCE_S
        return self.is_interval_over(elapsed_s, stationary=False) or bool(left < c.min_tracked) or surprised

    def is_interval_over(self, elapsed_s: float, stationary: bool) -> bool:
        """Say whether it is time for a keyframe, whatever the frame shows."""
        interval_s = self._config.stationary_interval_s if stationary else self._config.interval_s
        return elapsed_s >= interval_s - TIME_TOLERANCE_S

    @staticmethod
    def is_stationary(elapsed_s: float, stationary_s: float) -> bool:
        """Say whether the drone has not moved since the last keyframe."""
        return stationary_s >= elapsed_s
