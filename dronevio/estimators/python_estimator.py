"""Estimators that are classes of the user: ``python:package.module:Class``.

The module is imported from the installed packages or, if it is not there, from the current folder.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from dronevio.models.errors import ConfigError
from dronevio.models.protocols import Estimator
from dronevio.models.python_names import PythonName
from dronevio.models.rig import Rig

METHODS = ("add_imu", "add_frame")
"""Methods of `Estimator` that a benchmark calls."""


@dataclass(frozen=True)
class PythonEstimator(PythonName):
    """A class, or another callable, that returns an estimator for a rig."""

    what: ClassVar[str] = "estimator"
    form: ClassVar[str] = "Class"

    def load(self) -> Callable[[Rig], Estimator]:
        """Return the class; the module is imported.

        Raises:
            ConfigError: The module cannot be imported, or has no such class with the methods of an estimator.
        """
        module = self.imported_module()
        factory = getattr(module, self.name, None)
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

    def _require_methods(self, estimator: object) -> None:
        """Check that a class or an object has the methods of an estimator.

        Raises:
            ConfigError: It lacks one.
        """
        missing = [method for method in METHODS if not callable(getattr(estimator, method, None))]
        if missing:
            raise ConfigError(f"estimator {self} without {' and '.join(missing)}; expected the methods of Estimator")
