"""Errors that are caused by input or settings, and that the user can correct."""

import copyreg
from collections.abc import Iterable
from pathlib import Path
from typing import Any

DEFECT = "a defect in dronevio"
"""Name, in messages, of a failure that the user did not cause: an unexpected exception, or a worker that dies."""


class DefectError(Exception):
    """A worker process died, or failed in a way that no input should cause; the command line exits with 70."""


class DronevioError(Exception):
    """Base class of all errors that the user can correct; the command line prints them on one line and exits with 2."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle message and attributes, since those of a worker process are raised again in its parent."""
        return copyreg.__newobj__, (type(self), *self.args), self.__dict__  # type: ignore[attr-defined]


class InputError(DronevioError):
    """A file or folder is missing, unreadable or not in the expected format."""

    def __init__(self, path: Path | str, found: str, expected: str, line: int | None = None) -> None:
        """Compose the message ``PATH:LINE: FOUND; expected EXPECTED``.

        Args:
            path: The file or folder.
            found: Description of what was found.
            expected: Description of what was expected.
            line: Line number, counted from 1, if the error belongs to a line.
        """
        self.path = Path(path)
        self.line = line
        where = f"{path}:{line}" if line is not None else f"{path}"
        self.found = f"{where}: {found}"
        """The message without what was expected."""
        super().__init__(f"{self.found}; expected {expected}")


class ConfigError(DronevioError):
    """A setting, a name or a combination of them is invalid."""


class GraphicsError(DronevioError):
    """No off-screen OpenGL context can render a frame."""


class EvaluationError(DronevioError):
    """Two trajectories cannot be compared, for example because they do not overlap in time."""


class IncompleteError(DronevioError):
    """A long operation stopped early, for example because the disk is full; the finished part can be read."""


def unknown_name(what: str, name: str, known: Iterable[str], expected: str | None = None) -> ConfigError:
    """Return the error for a name that is none of the known ones, with those that are like it.

    Args:
        what: What has the name, such as ``world``.
        name: The name.
        known: The names that exist.
        expected: What is expected, where the names are too many for a message; by default one of them all.
    """
    from difflib import get_close_matches

    names = list(known)
    lower = {each.lower(): each for each in reversed(names)}
    like = [lower[each] for each in get_close_matches(str(name).lower(), list(lower), 3, 0.6)]
    hint = f"; did you mean {' or '.join(like)}?" if like else ""
    return ConfigError(f"unknown {what} {name!r}; expected {expected or 'one of ' + ', '.join(names)}{hint}")
