"""Medians and quartiles over the runs of a benchmark, in which a failed run counts as the worst."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from dronevio.eval.benchmark.rows import Row, run_name

QUARTILES = (0.25, 0.5, 0.75)
"""Probabilities of the lower quartile, the median and the upper quartile."""


@dataclass(frozen=True)
class Quartiles:
    """Quartiles of a figure over several runs; infinite where they fall on a failed run."""

    lower: float
    """Lower quartile of the runs."""
    median: float
    """Median of the runs."""
    upper: float
    """Upper quartile of the runs."""
    runs: int
    """Number of runs, including those that failed."""
    failed: int
    """Number of runs that failed."""

    @classmethod
    def of(cls, values: Iterable[float], runs: int, failed: int) -> "Quartiles":
        """Return the quartiles of values; failed runs among them have the value ∞, or −∞ if large values are good."""
        ordered = sorted(values)
        lower, median, upper = (quantile(ordered, probability) for probability in QUARTILES)
        return cls(lower, median, upper, runs, failed)

    def text(self, with_quartiles: bool = True) -> str:
        """Return the median for a table, followed by the quartiles in parentheses if they are requested.

        A value that falls on a failed run is "failed"; quartiles that both do are left out.
        """
        lower, median, upper = (
            f"{value:.3g}" if math.isfinite(value) else "failed" for value in (self.lower, self.median, self.upper)
        )
        shown = with_quartiles and (math.isfinite(self.lower) or math.isfinite(self.upper))
        return f"{median} ({lower}–{upper})" if shown else median


def quartiles_of_errors(rows: Iterable[Row], column: str) -> Quartiles | None:
    """Return the quartiles of a column of errors; None if no run that is ok has a value."""
    rows = list(rows)
    scored = [row for row in rows if row.status == "ok"]
    values = [getattr(row, column) for row in scored if getattr(row, column) is not None]
    failed = len(rows) - len(scored)
    if not values and (scored or not failed):
        return None
    return Quartiles.of([*values, *[math.inf] * failed], len(rows), failed)


def quantile(ordered: Sequence[float], probability: float) -> float:
    """Return a quantile of ordered values.

    It is interpolated linearly between neighbours; if a value is infinite, it is the worse of the neighbours.
    """
    position = probability * (len(ordered) - 1)
    low, high = math.floor(position), math.ceil(position)
    if math.isinf(ordered[-1]):
        return ordered[high]
    if math.isinf(ordered[0]):
        return ordered[low]
    return ordered[low] + (position - low) * (ordered[high] - ordered[low])


@dataclass(frozen=True)
class RunGroup:
    """All runs of one estimator on one scenario."""

    scenario: str
    """Name of the scenario."""
    estimator: str
    """Label of the estimator."""
    rows: tuple[Row, ...]
    """Runs of all seeds."""

    @property
    def ok(self) -> int:
        """Number of runs that have scores."""
        return sum(row.status == "ok" for row in self.rows)


def run_groups(rows: Sequence[Row]) -> tuple[RunGroup, ...]:
    """Return the runs by scenario and estimator, in the order in which these first occur."""
    found: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        found.setdefault((row.scenario, row.estimator), []).append(row)
    return tuple(RunGroup(*names, tuple(members)) for names, members in found.items())


def failed_runs(rows: Sequence[Row]) -> tuple[tuple[str, str, str], ...]:
    """Return name, status and reason of each run that failed."""
    return tuple((run_name(row.identity), row.status, row.reason) for row in rows if row.status != "ok")
