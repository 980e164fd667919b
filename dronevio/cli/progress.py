"""Progress of long operations on standard error: bars on a terminal, lines of text elsewhere."""

import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol, TextIO

from dronevio.models.progress import Progress, silent

if TYPE_CHECKING:
    from rich.progress import Progress as RichProgress
    from rich.progress import TaskID

FIRST_LINE_S = 5.0
"""Duration of a phase after which its progress is printed as a line [s]; of shorter phases, only the end is."""
LINE_INTERVAL_S = 10.0
"""Time between two lines of a phase [s]."""
LEAST_SHARE = 0.05
"""Share of the units that must be finished for the first line to tell how long the rest takes."""


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


class PhaseLine:
    """The lines of text of one phase."""

    def __init__(self, description: str, clock: Callable[[], float] = time.monotonic) -> None:
        """Prepare the lines of a phase that has not begun.

        Args:
            description: Name of the phase.
            clock: Function that returns the time [s].
        """
        self._description = description
        self._clock = clock
        self._begin_s: float | None = None
        self._next_s = FIRST_LINE_S
        self._first: tuple[float, int] | None = None  # time and finished units of the first line
        self._ended = False

    def due(self, done: int, total: int) -> str | None:
        """Return the line that is to be printed now; None if the last line is recent.

        Args:
            done: Number of finished units.
            total: Number of all units.
        """
        now_s = self._clock()
        self._begin_s = now_s if self._begin_s is None else self._begin_s
        elapsed_s = now_s - self._begin_s
        is_end = done >= total
        if self._ended or (elapsed_s < self._next_s and not is_end):
            return None
        self._next_s, self._ended = elapsed_s + LINE_INTERVAL_S, is_end
        # The pace is that since the first line: the first units are often slow.
        since_s, since = self._first or (0.0, 0)
        is_known = since < done < total and (self._first is not None or done >= LEAST_SHARE * total)
        self._first = self._first or (elapsed_s, done)
        left = f", about {(elapsed_s - since_s) * (total - done) / (done - since):.0f} s left" if is_known else ""
        return f"{self._description}: {done} of {total} after {elapsed_s:.0f} s{left}"
