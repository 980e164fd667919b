"""The declaration of a metric: its name, unit, form in tables, and how it is computed.

A metric of a trajectory is a field of `Scores`, declared by `computed`; other metrics of a benchmark are
entries of `dronevio.eval.benchmark.metrics`. Scores, columns of benchmarks, tables and units follow from it.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal

from dronevio.eval.metrics.errors import Statistics

Best = Literal["low", "high", "three", "any"]
"""Which value is best: the smallest, the largest, the one nearest to 3, or none of them."""
DASH = "–"
"""Text of an unknown value."""
FAILED = "failed"
"""Text of a value that falls on a failed run."""


def _figure(value: float | Statistics) -> float:
    return value.rmse if isinstance(value, Statistics) else value


@dataclass(frozen=True)
class Metric:
    """A figure by which estimates are judged."""

    title: str
    """What it is, for tables and plots; ``{interval}`` stands for the distance between the poses of relative errors."""
    unit: str
    """Unit of the values; empty if they have none."""
    decimals: int
    """Number of decimals in the tables of a run; 0 for whole numbers."""
    best: Best | None = "low"
    """Which value is best; None if estimators are not compared by it, because it describes the flight or explains other
    metrics."""
    name: str = ""
    """Name in benchmarks; empty for that of the field of `Scores`."""
    of: Callable[[Any], float | None] = _figure
    """Computes the figure from an `EvaluatedRun`, or from the value of the field of `Scores`: by default that value, or
    the root mean square of statistics. None where it is not known."""
    signed: bool = False
    """Whether it is an error with a direction: over many runs, magnitudes are compared."""
    counts_failed: bool = True
    """Whether a failed run counts as the worst value; otherwise it is left out."""

    @property
    def heading(self) -> str:
        """Title and unit, over the values of many runs."""
        return f"{self.compared_title} [{self.unit or DASH}]"

    @property
    def compared_title(self) -> str:
        """Title over the values of many runs, whose relative errors are those over 1 s."""
        title = self.title.format(interval="1 s")
        return f"Absolute {title.lower()}" if self.signed else title

    @property
    def worst(self) -> float:
        """The value of a failed run: ∞, or −∞ if large values are good."""
        return -math.inf if self.best == "high" else math.inf

    def label(self, interval: str) -> str:
        """Return the title in a list, given the distance between the poses of relative errors, such as ``1 s``."""
        title = self.title.format(interval=interval)
        return title if title[:2].isupper() else title[0].lower() + title[1:]

    def text(self, value: float | None) -> str:
        """Return the value of one run as text; a dash if it is not known."""
        return DASH if value is None else f"{value:{'+' if self.signed else ''}.{self.decimals}f}".replace("-", "−")

    def compared_text(self, value: float) -> str:
        """Return a value over many runs as text, with three significant digits."""
        return FAILED if math.isinf(value) else significant(value).replace("-", "−")

    def ranking_key(self, value: float) -> float:
        """Return the key by which values are ranked; the best value has the smallest key."""
        if self.best == "three":
            return abs(math.log(value / 3.0)) if 0.0 < value < math.inf else math.inf
        return value if self.best == "low" else -value if self.best == "high" else 0.0


def computed(of: Callable[[Any], object], *metrics: Metric) -> Any:
    """Declare a field of a dataclass: how it is computed, and the metrics that are taken from its value."""
    return field(metadata={"of": of, "metrics": metrics})


def computed_values(kind: type[Any], source: object) -> dict[str, Any]:
    """Return the values of the fields of such a dataclass, computed from an object."""
    return {each.name: each.metadata["of"](source) for each in fields(kind)}


def declared(kind: type[Any]) -> Iterator[tuple[str, Metric]]:
    """Yield the metrics of such a dataclass as they are declared, each with the name of its field."""
    for each in fields(kind):
        for metric in each.metadata["metrics"]:
            yield each.name, metric


def metrics_of(kind: type[Any]) -> dict[str, Metric]:
    """Return the metrics of such a dataclass by name, computed from an instance of it."""
    named = (_of_field(metric, name) for name, metric in declared(kind))
    return {metric.name: metric for metric in named}


def significant(number: float, digits: int = 3) -> str:
    """Return a number with some significant digits, with an exponent only if it is very small or large."""
    if number and not 1e-4 <= abs(number) < 1e6:
        return f"{number:.{digits - 1}e}"
    if abs(number) >= 10**digits:
        return f"{number:.0f}"
    return f"{number:#.{digits}g}".removesuffix(".") if number else "0"


def _of_field(metric: Metric, name: str) -> Metric:
    def of(source: Any) -> float | None:
        value = getattr(source, name)
        return None if value is None else metric.of(value)

    return replace(metric, name=metric.name or name, of=of)
