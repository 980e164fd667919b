"""How long work tells how far it is, without knowing who listens."""

from typing import Protocol


class Progress(Protocol):
    """Called from time to time by long work."""

    def __call__(self, done: int, total: int) -> None:
        """Say that ``done`` of ``total`` units are finished."""


def silent(done: int, total: int) -> None:
    """Listen to nothing: the default of everything that reports progress."""
