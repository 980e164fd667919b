"""Whether innovations and their covariance have agreed for long enough, so that an estimate can be trusted.

A wrong calibration, or measurements that do not belong together, contradict the estimate as soon as the vehicle moves.
An estimate that has been consistent over a long motion is *established*: what contradicts it later is more probably a
disturbance, such as a jolt or a passing object, than a wrong calibration. Its NIS may therefore be larger, and it is
trusted again soon after a short contradiction.
"""

from dataclasses import dataclass

import numpy as np

from dronevio.estimator.innovation import median

MIN_FRAMES = 3
"""Smallest number of frames of a window that has begun anew, as at an initialization, for its median to count."""


@dataclass(frozen=True)
class TrustLimits:
    """Limits of the NIS, in units of its expectation, and durations."""

    window_s: float
    """Length of the window over which the median NIS is taken [s]."""
    max_median_nis: float
    """Largest median over the window of a consistent estimate."""
    max_frame_nis: float
    """Largest NIS of a frame of a consistent estimate."""
    distrust_s: float
    """Time for which an estimate must be consistent again before it is trusted [s]."""
    established_s: float
    """Time of consistent motion after which an estimate is established [s]."""
    established_ratio: float
    """Ratio of both limits of an established estimate to those above."""
    disturbance_s: float
    """Longest contradiction of an established estimate that counts as a disturbance, and the time for which the
    estimate must be consistent after it [s]."""


class Trust:
    """Decides frame by frame whether an estimate is trusted."""

    def __init__(self, limits: TrustLimits, *, is_trusted: bool) -> None:
        """Begin at an initialization.

        Args:
            limits: Limits of the NIS, and durations.
            is_trusted: Whether the estimate is trusted from its beginning, not only after `distrust_s`.
        """
        self._limits, self._is_trusted = limits, is_trusted
        self._recent_nis: tuple[tuple[int, float], ...] = ()  # times and NIS of the window
        self._is_full = False  # whether these cover the window
        self._last_ns: int | None = None  # time of the last frame
        self._motion_ns = 0  # duration of the consistent motion
        self._contradicted_ns: tuple[int, int] | None = None  # first and last time of the last contradiction
        self._is_disturbance = False  # whether that contradiction is a disturbance

    @property
    def is_trusted(self) -> bool:
        """Whether the estimate is trusted."""
        return self._is_trusted

    @property
    def median_nis(self) -> float:
        """Median NIS over the window, 0 before the window is full."""
        return self._median() if self._is_full else 0.0

    @property
    def is_established(self) -> bool:
        """Whether the estimate has been consistent over a long motion."""
        return self._motion_ns * 1e-9 >= self._limits.established_s

    def restart_motion(self) -> None:
        """Let the estimate no longer be established, and the window begin anew."""
        self._motion_ns, self._recent_nis, self._is_full = 0, (), False

    def update(self, t_ns: int, nis: float | None, *, moves: bool) -> None:
        """Add a frame.

        Args:
            t_ns: Time of the frame [ns].
            nis: NIS of the frame; None where too few landmarks are observed, which empties the window.
            moves: Whether the vehicle moves.
        """
        c, step_ns = self._limits, 0 if self._last_ns is None else t_ns - self._last_ns
        self._last_ns = t_ns
        self._add_to_window(t_ns, nis)
        ratio = c.established_ratio if self.is_established or self._is_disturbance else 1.0
        is_large = (nis or 0.0) > ratio * c.max_frame_nis or self._median() > ratio * c.max_median_nis
        if is_large or (self._contradicted_ns is None and not self._is_trusted):
            self.contradict(t_ns)
        elif moves and nis is not None and self._is_trusted:
            self._motion_ns += step_ns
        if self._contradicted_ns is not None and not self._is_trusted:
            needed_s = c.disturbance_s if self._is_disturbance else c.distrust_s
            self._is_trusted = (t_ns - self._contradicted_ns[1]) * 1e-9 >= needed_s
            self._is_disturbance &= not self._is_trusted

    def contradict(self, t_ns: int) -> None:
        """Note a contradiction, which continues the last one as long as the estimate is not trusted again."""
        if self._contradicted_ns is None or self._is_trusted:
            self._contradicted_ns, self._is_disturbance = (t_ns, t_ns), self.is_established
        begin_ns = self._contradicted_ns[0]
        self._contradicted_ns, self._is_trusted = (begin_ns, t_ns), False
        self._is_disturbance &= (t_ns - begin_ns) * 1e-9 <= self._limits.disturbance_s
        self._motion_ns = 0

    def _add_to_window(self, t_ns: int, nis: float | None) -> None:
        """Add a frame to the window, or empty the window."""
        begin_ns = t_ns - round(self._limits.window_s * 1e9)
        self._is_full = nis is not None and bool(self._recent_nis) and self._recent_nis[0][0] <= begin_ns
        recent = tuple(entry for entry in self._recent_nis if entry[0] > begin_ns)
        self._recent_nis = () if nis is None else (*recent, (t_ns, nis))

    def _median(self) -> float:
        """Return the median NIS over the window, 0 while it is not full and has fewer than `MIN_FRAMES` frames."""
        values = np.array([value for _, value in self._recent_nis])
        return median(values) if self._is_full or len(values) >= MIN_FRAMES else 0.0
