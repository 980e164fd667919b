"""Callbacks by which long operations report their progress."""

from typing import Protocol


class Progress(Protocol):
    """Callback of a long operation."""

    def __call__(self, done: int, total: int) -> None:
        """Report that ``done`` of ``total`` units are finished."""


def silent(done: int, total: int) -> None:
    """Ignore the progress; the default of all functions that report it."""
