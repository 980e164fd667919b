"""Estimators that are classes of the user: ``python:package.module:Class``.

The module is imported from the installed packages or, if it is not there, from the current folder.
"""

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from dronevio.eval.benchmark.cache import code_hash
from dronevio.models.errors import ConfigError
from dronevio.models.protocols import Estimator
from dronevio.models.python_objects import PREFIX, PythonObject, search_here
from dronevio.models.rig import Rig

METHODS = ("add_imu", "add_frame")
"""Methods of `Estimator` that a benchmark calls."""


@dataclass(frozen=True)
class PythonEstimator:
    """A class, or another callable, that returns an estimator for a rig."""

    module: str
    """Dotted name of the module."""
    name: str
    """Name of the class in the module."""

    @classmethod
    def parse(cls, text: str) -> "PythonEstimator":
        """Return the class that a text names.

        Args:
            text: ``python:package.module:Class``.

        Raises:
            ConfigError: The text has another form.
        """
        named = PythonObject.parse("estimator", text, "Class")
        return cls(named.module, named.name)

    def load(self) -> Callable[[Rig], Estimator]:
        """Return the class; the module is imported.

        Raises:
            ConfigError: The module cannot be imported, or has no such class with the methods of an estimator.
        """
        factory = PythonObject("estimator", self.module, self.name).load()
        if not callable(factory):
            raise ConfigError(f"estimator {self}: {self.module} has no class {self.name}")
        if isinstance(factory, type):
            self._require_methods(factory)
        make: Callable[[Rig], Estimator] = factory
        return make

    def make(self, rig: Rig) -> Estimator:
        """Return an estimator for a rig.

        Raises:
            ConfigError: There is no such class, or it lacks a method.
        """
        estimator = self.load()(rig)
        self._require_methods(estimator)
        return estimator

    def source_hash(self) -> str:
        """Return the hash of the Python sources of the module's package, or of the module if it is in none.

        Raises:
            ConfigError: There is no such module.
        """
        top = self.module.partition(".")[0]
        search_here()
        spec = importlib.util.find_spec(top)
        if spec is None:
            raise ConfigError(f"estimator {self}: no module {top}; expected one that is installed or in {Path.cwd()}")
        if spec.submodule_search_locations:
            return code_hash(*map(Path, spec.submodule_search_locations))
        return code_hash(Path(spec.origin)) if spec.origin and Path(spec.origin).is_file() else ""

    def _require_methods(self, estimator: object) -> None:
        """Check that a class or an object has the methods of an estimator.

        Raises:
            ConfigError: It lacks one.
        """
        missing = [method for method in METHODS if not callable(getattr(estimator, method, None))]
        if missing:
            raise ConfigError(f"estimator {self} without {' and '.join(missing)}; expected the methods of Estimator")

    def __str__(self) -> str:
        """Return the text that names the class."""
        return f"{PREFIX}{self.module}:{self.name}"
