"""Callbacks by which long operations report their progress, and its text."""

import sys
import time
from collections.abc import Callable
from typing import Protocol

FIRST_LINE_S = 5.0
"""Duration of a phase after which its progress is a line of text [s]; of shorter phases, only the end is."""
LINE_INTERVAL_S = 10.0
"""Time between two lines of a phase [s]."""
LEAST_SHARE = 0.05
"""Share of the units that must be finished for the first line to tell how long the rest takes."""

_NOTEBOOK_FIRST_S, _NOTEBOOK_INTERVAL_S = 1.0, 0.5  # the line is replaced, so that it may change often


class Progress(Protocol):
    """Callback of a long operation."""

    def __call__(self, done: int, total: int) -> None:
        """Report that ``done`` of ``total`` units are finished."""


def silent(done: int, total: int) -> None:
    """Ignore the progress; the default of all functions that report it."""


Stages = Callable[[str], Progress]
"""Function that returns the callback of a stage of an operation by its name."""


def silent_stages(stage: str) -> Progress:
    """Ignore the progress of all stages."""
    return silent


class PhaseLine:
    """The lines of text of one phase."""

    def __init__(
        self,
        description: str,
        clock: Callable[[], float] = time.monotonic,
        first_s: float = FIRST_LINE_S,
        interval_s: float = LINE_INTERVAL_S,
    ) -> None:
        """Prepare the lines of a phase that has not begun.

        Args:
            description: Name of the phase.
            clock: Function that returns the time [s].
            first_s: Duration after which the first line is due [s]; of shorter phases, only the end is.
            interval_s: Time between two lines [s].
        """
        self._description = description
        self._clock = clock
        self._begin_s: float | None = None
        self._next_s = first_s
        self._interval_s = interval_s
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
        self._next_s, self._ended = elapsed_s + self._interval_s, is_end
        # The pace is that since the first line: the first units are often slow.
        since_s, since = self._first or (0.0, 0)
        is_known = since < done < total and (self._first is not None or done >= LEAST_SHARE * total)
        self._first = self._first or (elapsed_s, done)
        left = f", about {(elapsed_s - since_s) * (total - done) / (done - since):.0f} s left" if is_known else ""
        return f"{self._description}: {done} of {total} after {elapsed_s:.0f} s{left}"


def notebook_line(description: str) -> Progress:
    """Return a callback that shows a phase in a Jupyter notebook as a line, which vanishes when all units are finished.

    It is silent elsewhere, as in scripts.

    Args:
        description: Name of the phase.
    """
    # A notebook has loaded IPython, whose shell then has a kernel.
    ipython = sys.modules.get("IPython")
    if ipython is None or not hasattr(ipython.get_ipython(), "kernel"):
        return silent
    from IPython.display import DisplayHandle

    line = PhaseLine(description, first_s=_NOTEBOOK_FIRST_S, interval_s=_NOTEBOOK_INTERVAL_S)
    shown: list[DisplayHandle] = []

    def advance(done: int, total: int) -> None:
        text = line.due(done, total)
        if text is None:
            return
        content = {"text/plain": "" if done >= total else text}
        if shown:
            shown[0].update(content, raw=True)
        elif done < total:
            shown.append(DisplayHandle())
            shown[0].display(content, raw=True)

    return advance
