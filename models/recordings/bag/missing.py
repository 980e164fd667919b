"""Parts that a bag lacks, collected so that one error names all of them."""

from collections.abc import Iterator
from contextlib import contextmanager

from dronevio.models.errors import InputError
from dronevio.models.recordings.bag.file import BagFile


class MissingPartError(InputError):
    """A part of a recording is missing in a bag, while other parts may be there."""


class MissingParts:
    """Collects the parts that are missing in a bag."""

    def __init__(self, bag: BagFile) -> None:
        """Begin without missing parts."""
        self._bag = bag
        self._errors: list[MissingPartError] = []

    @contextmanager
    def collected(self) -> Iterator[None]:
        """Keep a `MissingPartError` that is raised in the context, instead of raising it."""
        try:
            yield
        except MissingPartError as error:
            self._errors.append(error)

    def check(self) -> None:
        """Raise one error for all missing parts, if there are any.

        Raises:
            InputError: A part is missing; the message names each part and what supplies it.
        """
        if len(self._errors) == 1:
            raise self._errors[0]
        if self._errors:
            prefix = f"{self._bag.path}: "
            parts = "; ".join(f"({n}) {str(error).removeprefix(prefix)}" for n, error in enumerate(self._errors, 1))
            raise InputError(self._bag.path, f"{len(self._errors)} parts are missing: {parts}", "all of them")


def missing(bag: BagFile, found: str, expected: str) -> MissingPartError:
    """Return the error for a missing part of a bag.

    Args:
        bag: The bag.
        found: Description of what is missing.
        expected: Description of what is expected, with the option that supplies it.
    """
    return MissingPartError(bag.path, found, expected)
