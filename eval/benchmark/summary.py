"""A benchmark in a table: estimator × scenario, the median over seeds and how far they spread."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from dronevio.eval.benchmark.rows import Row, run_name


@dataclass(frozen=True)
class Spread:
    """The middle of several runs, and the quarter of them on either side. A failed run is the worst of all: ∞."""

    low: float
    """Lower quartile."""
    median: float
    """Median."""
    high: float
    """Upper quartile."""

    @classmethod
    def of(cls, rows: Iterable[Row], column: str) -> "Spread | None":
        """Return the spread of a column of errors; None where not one row that is ok tells it."""
        rows = list(rows)
        told = [getattr(row, column) for row in rows if row.status == "ok" and getattr(row, column) is not None]
        failed = [math.inf for row in rows if row.status != "ok"]
        if not told and not failed:
            return None
        # "higher": between a number and infinity there is nothing to interpolate.
        low, middle, high = np.quantile([*told, *failed], (0.25, 0.5, 0.75), method="higher" if failed else "linear")
        return cls(float(low), float(middle), float(high))

    def text(self, with_quartiles: bool = True) -> str:
        """Return it for a table."""
        low, middle, high = (
            f"{value:.3g}" if math.isfinite(value) else "∞" for value in (self.low, self.median, self.high)
        )
        return f"{middle}\n{low}–{high}" if with_quartiles else middle


@dataclass(frozen=True)
class Group:
    """All runs of one estimator on one scenario."""

    scenario: str
    """The scenario."""
    estimator: str
    """The estimator."""
    rows: tuple[Row, ...]
    """Its runs, one a seed."""

    @property
    def ok(self) -> int:
        """How many were scored."""
        return sum(row.status == "ok" for row in self.rows)


def groups(rows: Sequence[Row]) -> tuple[Group, ...]:
    """Return the runs by scenario and estimator, in the order in which these first occur."""
    found: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        found.setdefault((row.scenario, row.estimator), []).append(row)
    return tuple(Group(*names, tuple(members)) for names, members in found.items())


def failures(rows: Sequence[Row]) -> tuple[tuple[str, str, str], ...]:
    """Return what run it was, how it ended and why, for each that failed."""
    return tuple((run_name(row.identity), row.status, row.reason) for row in rows if row.status != "ok")
