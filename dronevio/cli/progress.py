"""Progress of long operations on standard error: bars on a terminal, lines of text elsewhere."""

import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol, TextIO

from dronevio.models.progress import PhaseLine, Progress, silent

if TYPE_CHECKING:
    from rich.progress import Progress as RichProgress
    from rich.progress import TaskID


class Bars(Protocol):
    """Shows the progress of a command."""

    def bar(self, description: str) -> Progress:
        """Return the progress callback of a phase, which is shown from the first call on."""


class NoBars:
    """Shows nothing."""

    def bar(self, description: str) -> Progress:
        """Return a callback that does nothing."""
        return silent


class RichBars:
    """Draws a bar for each phase."""

    def __init__(self, bars: "RichProgress") -> None:
        """Use a display of rich.

        Args:
            bars: The display, already started.
        """
        self._bars = bars

    def bar(self, description: str) -> Progress:
        """Return the progress callback of a phase, whose bar and clock start with the first call."""
        tasks: list[TaskID] = []

        def advance(done: int, total: int) -> None:
            if not tasks:
                tasks.append(self._bars.add_task(description))
            self._bars.update(tasks[0], completed=done, total=total)

        return advance


class LineBars:
    """Prints a line for each phase from time to time, for log files and pipes."""

    def __init__(self, stream: TextIO | None = None, clock: Callable[[], float] = time.monotonic) -> None:
        """Print lines.

        Args:
            stream: Stream to print to; standard error by default.
            clock: Function that returns the time [s].
        """
        self._stream = stream
        self._clock = clock

    def bar(self, description: str) -> Progress:
        """Return the progress callback of a phase, whose clock starts with the first call."""
        line = PhaseLine(description, self._clock)

        def advance(done: int, total: int) -> None:
            text = line.due(done, total)
            if text is not None:
                print(text, file=self._stream or sys.stderr, flush=True)

        return advance
