"""When the answers of the map take effect: after a number of frames that does not depend on the machine's speed."""

from collections import deque
from dataclasses import dataclass
from typing import Annotated

from dronevio.models.ranges import Range, Settings


@dataclass(frozen=True)
class DelayConfig(Settings):
    """Settings of the delay between a keyframe that joins the map and the correction by it.

    The delay depends on numbers of keyframes and loops alone, so that results do not depend on the machine.
    A worker that is slower than the delay makes frames wait.
    """

    frames: Annotated[int, Range(1, 1000)] = 6
    """Delay with an empty map, in frames."""
    loops_per_frame: Annotated[int, Range(1, 1_000_000)] = 100
    """Number of loops by which the delay grows by one frame, since the optimization of the pose graph takes longer."""
    keyframes_per_frame: Annotated[int, Range(1, 1_000_000)] = 500
    """Number of keyframes of the map by which the delay grows by one frame."""


class CorrectionSchedule:
    """The frames at which the answers to the messages of an odometry are due, in the order of the messages."""

    def __init__(self, config: DelayConfig) -> None:
        """Begin without messages.

        Args:
            config: The delay.
        """
        self._config = config
        self._due: deque[int] = deque()
        self._last = 0

    def add(self, frame: int, keyframes: int, loops: int) -> None:
        """Add a message. Messages at one frame have answers that are due at consecutive frames.

        Args:
            frame: Number of the frame at which the message is sent.
            keyframes: Number of keyframes that have been sent.
            loops: Number of loops that have been received in answers that were due.
        """
        c = self._config
        delay = c.frames + loops // c.loops_per_frame + keyframes // c.keyframes_per_frame
        self._last = max(frame + delay, self._last + 1)
        self._due.append(self._last)

    def take_due(self, frame: int) -> int:
        """Return the number of answers that are due at a frame, and remove them."""
        count = 0
        while self._due and self._due[0] <= frame:
            self._due.popleft()
            count += 1
        return count
