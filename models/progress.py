"""Callbacks by which long operations report their progress."""

from collections.abc import Callable
from typing import Protocol


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
