"""When the answers of the map take effect: after times by time stamps, which do not depend on the machine's speed."""

import math
from collections import deque
from dataclasses import dataclass
from typing import Annotated

from dronevio.models.ranges import Range, Settings

TIME_TOLERANCE_NS = 1_000_000
"""Tolerance of times, because time stamps are rounded and jitter [ns]."""


@dataclass(frozen=True)
class DelayConfig(Settings):
    """Settings of the delay between a keyframe that joins the map and the correction by it.

    The delay depends on time stamps and on numbers of keyframes and loops alone, so that results do not depend on the
    machine. A worker that is slower than the delay makes frames wait.
    """

    initial_s: Annotated[float, Range(0.001, 60.0)] = 0.3
    """Delay with an empty map [s]."""
    step_s: Annotated[float, Range(0.001, 60.0)] = 0.05
    """Time by which the delay grows with the map, and time between the corrections of successive keyframes [s]."""
    loops_per_step: Annotated[int, Range(1, 1_000_000)] = 100
    """Number of loops by which the delay grows by one step, since the optimization of the pose graph takes longer."""
    keyframes_per_step: Annotated[int, Range(1, 1_000_000)] = 500
    """Number of keyframes of the map by which the delay grows by one step."""


class CorrectionSchedule:
    """The times at which the answers to the messages of an odometry are due, in the order of the messages."""

    def __init__(self, config: DelayConfig) -> None:
        """Begin without messages.

        Args:
            config: The delay.
        """
        self._config = config
        self._due_ns: deque[int] = deque()
        self._last_ns: int | None = None

    def add(self, t_ns: int, keyframes: int, loops: int) -> None:
        """Add a message. Messages at one frame have answers that are due one step after another.

        Args:
            t_ns: Time stamp of the frame at which the message is sent [ns].
            keyframes: Number of keyframes that have been sent.
            loops: Number of loops that have been received in answers that were due.
        """
        c, step_ns = self._config, round(self._config.step_s * 1e9)
        steps = loops // c.loops_per_step + keyframes // c.keyframes_per_step
        due_ns = t_ns + round(c.initial_s * 1e9) + steps * step_ns
        self._last_ns = due_ns if self._last_ns is None else max(due_ns, self._last_ns + step_ns)
        self._due_ns.append(self._last_ns)

    def take_due(self, t_ns: int) -> int:
        """Return the number of answers that are due at a frame with a time stamp [ns], and remove them."""
        count = 0
        while self._due_ns and self._due_ns[0] <= t_ns + TIME_TOLERANCE_NS:
            self._due_ns.popleft()
            count += 1
        return count


@dataclass(frozen=True)
class AdjustmentScheduleConfig(Settings):
    """When the map is adjusted during the flight, and when the result takes effect.

    Both depend on numbers of keyframes and loops alone, so that results do not depend on the machine.
    """

    enabled: bool = True
    """Adjust the map during the flight, too, and not only after it."""
    min_loops: Annotated[int, Range(1, 1_000_000)] = 10
    """Number of closed loops at which the map is adjusted for the first time."""
    growth: Annotated[float, Range(1.01, 100.0)] = 1.3
    """Ratio of the number of keyframes to that at the last adjustment at which the map is adjusted again."""
    keyframes: Annotated[int, Range(1, 100_000)] = 10
    """Number of keyframes after which the adjustment of a small map takes effect."""
    keyframes_per_keyframe: Annotated[int, Range(1, 1000)] = 20
    """Number of keyframes of the map by which that number grows by one, since the adjustment takes longer."""


class AdjustmentSchedule:
    """When adjustments of the map begin and are due, by the numbers of its keyframes and loops."""

    def __init__(self, config: AdjustmentScheduleConfig) -> None:
        """Begin before the first adjustment.

        Args:
            config: Settings.
        """
        self._config = config
        self._least = 0
        self._due: int | None = None

    def takes_effect(self, keyframes: int) -> bool:
        """Return whether an adjustment is due, once for each.

        Args:
            keyframes: Number of keyframes of the flight.
        """
        is_due = self._due is not None and keyframes >= self._due
        self._due = None if is_due else self._due
        return is_due

    def begins(self, keyframes: int, loops: int) -> bool:
        """Return whether an adjustment begins with a keyframe.

        Args:
            keyframes: Number of keyframes of the flight.
            loops: Number of closed loops.
        """
        c = self._config
        if not c.enabled or self._due is not None or loops < c.min_loops or keyframes < self._least:
            return False
        self._least = math.ceil(c.growth * keyframes)
        self._due = keyframes + c.keyframes + keyframes // c.keyframes_per_keyframe
        return True
