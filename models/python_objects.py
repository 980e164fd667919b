"""Python objects of the user that are named by a text: ``python:package.module:NAME``.

The module is imported from the installed packages or, if it is not there, from the current folder.
"""

import importlib
import re
import sys
from dataclasses import dataclass
from pathlib import Path

from dronevio.models.errors import ConfigError

PREFIX = "python:"
"""Prefix of the name of an object of the user."""


@dataclass(frozen=True)
class PythonObject:
    """An object in a module."""

    what: str
    """What it is, such as ``estimator``, for messages."""
    module: str
    """Dotted name of the module."""
    name: str
    """Name of the object in the module."""

    @classmethod
    def parse(cls, what: str, text: str, kind: str = "NAME") -> "PythonObject":
        """Return the object that a text names.

        Args:
            what: What it is, such as ``estimator``, for messages.
            text: ``python:package.module:NAME``.
            kind: Word for the name in messages, such as ``Class``.

        Raises:
            ConfigError: The text has another form.
        """
        module, _, name = text.removeprefix(PREFIX).partition(":")
        if not (re.fullmatch(r"\w+(\.\w+)*", module) and name.isidentifier()):
            raise ConfigError(f"{what} {text!r}; expected {PREFIX}package.module:{kind}")
        return cls(what, module, name)

    def load(self) -> object:
        """Return the object, or None if the module has none of this name; the module is imported.

        Raises:
            ConfigError: The module cannot be imported.
        """
        search_here()
        try:
            module = importlib.import_module(self.module)
        except Exception as error:  # whatever the module of the user raises
            reason = f"{type(error).__name__}: {error}"
            raise ConfigError(
                f"{self.what} {self}: cannot import {self.module}: {reason}; expected a module that is installed or is"
                f" in {Path.cwd()}"
            ) from error
        return getattr(module, self.name, None)

    def __str__(self) -> str:
        """Return the text that names the object."""
        return f"{PREFIX}{self.module}:{self.name}"


def search_here() -> None:
    """Let modules of the current folder be found, after those that are installed, until the process ends."""
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)
    importlib.invalidate_caches()
