"""Consistency of an estimate: whether innovations and their covariance have agreed for long enough.

A wrong calibration, or measurements that do not belong together, contradict the estimate as soon as the vehicle moves.
An estimate that has been consistent over a long motion is *established*: what contradicts it later is more probably a
disturbance, such as a jolt or a passing object, than a wrong calibration. Its NIS may therefore be larger, and it is
consistent again soon after a short contradiction.
"""

import numpy as np

from dronevio.estimator.monitoring.config import HealthConfig
from dronevio.estimator.optimization.linear_fit import median

MIN_FRAMES, MIN_SPAN_S = 3, 0.1
"""Smallest number of frames of a window that has begun anew, as at an initialization, and shortest time between the
first and the last of them, for its median to count: at a high frame rate, a jolt disturbs more frames."""
TIME_TOLERANCE_S = 0.001
"""Tolerance of the lengths of windows, because time stamps are rounded and jitter [s]."""


class ConsistencyMonitor:
    """Decides frame by frame whether an estimate is consistent: its innovations agree with their covariance."""

    def __init__(self, config: HealthConfig, *, is_consistent: bool) -> None:
        """Begin at an initialization.

        Args:
            config: Limits of the NIS, and durations.
            is_consistent: Whether the estimate is consistent from its beginning, not only after `recovery_s`.
        """
        self._config, self._is_consistent = config, is_consistent
        self._recent_nis: tuple[tuple[int, float], ...] = ()  # times and NIS of the window
        self._begin_ns: int | None = None  # time of the first frame since the window began anew
        self._last_ns: int | None = None  # time of the last frame
        self._motion_ns = 0  # duration of the consistent motion
        self._contradicted_ns: tuple[int, int] | None = None  # first and last time of the last contradiction
        self._is_disturbance = False  # whether that contradiction is a disturbance

    @property
    def is_consistent(self) -> bool:
        """Whether the innovations have agreed with their covariance for long enough, or always."""
        return self._is_consistent

    @property
    def median_nis(self) -> float:
        """Median NIS over the window, 0 before the window is full."""
        return self._median() if self._covers(self._config.consistency_window_s) else 0.0

    @property
    def is_established(self) -> bool:
        """Whether the estimate has been consistent over a long motion."""
        return self._motion_ns * 1e-9 >= self._config.established_s

    def restart_motion(self) -> None:
        """Reset: the estimate is no longer established, and the window is empty."""
        self._motion_ns, self._recent_nis, self._begin_ns = 0, (), None

    def update(self, t_ns: int, nis: float | None, *, moves: bool) -> None:
        """Add a frame.

        Args:
            t_ns: Time of the frame [ns].
            nis: NIS of the frame; None where too few landmarks are observed, which empties the window.
            moves: Whether the vehicle moves.
        """
        c, step_ns = self._config, 0 if self._last_ns is None else t_ns - self._last_ns
        self._last_ns = t_ns
        self._add_to_window(t_ns, nis)
        ratio = c.established_nis_ratio if self.is_established or self._is_disturbance else 1.0
        is_large = (nis or 0.0) > ratio * c.max_frame_nis or self._median() > ratio * c.max_consistent_nis
        if is_large or (self._contradicted_ns is None and not self._is_consistent):
            self.add_contradiction(t_ns)
        elif moves and nis is not None and self._is_consistent:
            self._motion_ns += step_ns
        if self._contradicted_ns is not None and not self._is_consistent:
            needed_s = c.disturbance_s if self._is_disturbance else c.recovery_s
            self._is_consistent = (t_ns - self._contradicted_ns[1]) * 1e-9 >= needed_s
            self._is_disturbance &= not self._is_consistent

    def add_contradiction(self, t_ns: int) -> None:
        """Note a contradiction, which continues the last one as long as the estimate is not consistent again."""
        if self._contradicted_ns is None or self._is_consistent:
            self._contradicted_ns, self._is_disturbance = (t_ns, t_ns), self.is_established
        begin_ns = self._contradicted_ns[0]
        self._contradicted_ns, self._is_consistent = (begin_ns, t_ns), False
        self._is_disturbance &= (t_ns - begin_ns) * 1e-9 <= self._config.disturbance_s
        self._motion_ns = 0

    def _add_to_window(self, t_ns: int, nis: float | None) -> None:
        """Add a frame to the window, or empty the window."""
        if nis is None:
            self._recent_nis, self._begin_ns = (), None
            return
        begin_ns = t_ns - round(self._config.consistency_window_s * 1e9)
        self._begin_ns = t_ns if self._begin_ns is None else self._begin_ns
        self._recent_nis = (*(entry for entry in self._recent_nis if entry[0] > begin_ns), (t_ns, nis))

    def _covers(self, span_s: float) -> bool:
        """Return whether the frames since the window began anew span a time [s]."""
        if self._begin_ns is None or self._last_ns is None:
            return False
        return (self._last_ns - self._begin_ns) * 1e-9 >= span_s - TIME_TOLERANCE_S

    def _median(self) -> float:
        """Return the median NIS over the window, 0 as long as it is not full and has too few frames."""
        values = np.array([value for _, value in self._recent_nis])
        is_enough = len(values) >= MIN_FRAMES and self._covers(MIN_SPAN_S)
        return median(values) if is_enough or self._covers(self._config.consistency_window_s) else 0.0
