"""Metrics of the user: ``python:package.module:NAME``."""

import math
from dataclasses import dataclass, fields
from typing import ClassVar

from dronevio.eval.benchmark.cache import code_hash
from dronevio.eval.benchmark.metrics import OwnMetric
from dronevio.eval.metrics import Metric, ScoredTrajectory
from dronevio.models.errors import EvaluationError
from dronevio.models.python_names import PythonName


@dataclass(frozen=True)
class PythonMetric(PythonName):
    """Name of a metric in a module."""

    what: ClassVar[str] = "metric"

    def load(self) -> OwnMetric:
        """Return the metric as it is stored; the module is imported.

        Raises:
            ConfigError: The module cannot be imported, or has no such metric.
        """
        metric = self.instance_of(Metric)
        form = {each.name: getattr(metric, each.name) for each in fields(Metric) if each.name not in ("name", "of")}
        return OwnMetric(**form, name=str(self), code_hash=code_hash(*self.sources()))

    def value(self, scored: ScoredTrajectory) -> float | None:
        """Return the value for a trajectory; None if it is not known or not finite.

        Raises:
            ConfigError: The module cannot be imported, or has no such metric.
            EvaluationError: The function of the metric raises an exception, or returns no number.
        """
        metric = self.instance_of(Metric)
        try:
            value = metric.of(scored)
            return float(value) if value is not None and math.isfinite(value) else None
        except Exception as error:  # whatever the function of the user raises
            raise EvaluationError(f"metric {self}: {type(error).__name__}: {error}") from error
