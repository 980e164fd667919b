"""Names of objects in Python modules of the user: ``python:package.module:NAME``.

The module is imported from the installed packages or, if it is not there, from the current folder.
"""

import importlib
import importlib.util
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import ClassVar, Self, TypeVar

from dronevio.models.errors import ConfigError

Kind = TypeVar("Kind")

PREFIX = "python:"
"""Prefix of a name of an object of the user."""


@dataclass(frozen=True)
class PythonName:
    """Name of an object in a module."""

    what: ClassVar[str] = "object"
    """What the object is, for error messages."""
    form: ClassVar[str] = "NAME"
    """Placeholder for the name in the module, for error messages."""

    module: str
    """Dotted name of the module."""
    name: str
    """Name of the object in the module."""

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return the name in a text.

        Args:
            text: ``python:package.module:NAME``.

        Raises:
            ConfigError: The text has another form.
        """
        module, _, name = text.removeprefix(PREFIX).partition(":")
        if not (re.fullmatch(r"\w+(\.\w+)*", module) and name.isidentifier()):
            raise ConfigError(f"{cls.what} {text!r}; expected {PREFIX}package.module:{cls.form}")
        return cls(module, name)

    def imported_module(self) -> ModuleType:
        """Return the module, which is imported.

        Raises:
            ConfigError: It cannot be imported.
        """
        search_here()
        try:
            return importlib.import_module(self.module)
        except Exception as error:  # whatever the module of the user raises
            reason = f"{type(error).__name__}: {error}"
            raise ConfigError(
                f"{self.what} {self}: cannot import {self.module}: {reason}; expected a module that is installed or is"
                f" in {Path.cwd()}"
            ) from error

    def instance_of(self, kind: type[Kind]) -> Kind:
        """Return the object; its module is imported.

        Args:
            kind: Class of the object.

        Raises:
            ConfigError: The module cannot be imported, or has no such object.
        """
        found = getattr(self.imported_module(), self.name, None)
        if isinstance(found, kind):
            return found
        problem = "no such name" if found is None else f"an object of type {type(found).__name__}"
        public = ".".join(kind.__module__.split(".")[:2])
        raise ConfigError(f"{self.what} {self}: {problem}; expected an instance of {public}.{kind.__name__}")

    def sources(self) -> tuple[Path, ...]:
        """Return the folders of the module's package, or the file of the module if it is in none.

        Raises:
            ConfigError: There is no such module.
        """
        top = self.module.partition(".")[0]
        search_here()
        spec = importlib.util.find_spec(top)
        if spec is None:
            raise ConfigError(f"{self.what} {self}: no module {top}; expected one that is installed or in {Path.cwd()}")
        if spec.submodule_search_locations:
            return tuple(map(Path, spec.submodule_search_locations))
        return (Path(spec.origin),) if spec.origin and Path(spec.origin).is_file() else ()

    def __str__(self) -> str:
        """Return the text that names the object."""
        return f"{PREFIX}{self.module}:{self.name}"


def search_here() -> None:
    """Let modules of the current folder be found, after those that are installed, until the process ends."""
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)
    importlib.invalidate_caches()
