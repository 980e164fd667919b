"""Medians and quartiles over the runs of a benchmark, in which a failed run counts as the worst."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from dronevio.eval.benchmark.rows import VARIANT_SIGN, Row, run_name

ALL_SCENARIOS = "all scenarios"
"""Name of the runs of all scenarios in tables."""
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


def quartiles_of_errors(rows: Iterable[Row], metric: str) -> Quartiles | None:
    """Return the quartiles of a metric; None if no run that is ok has a value."""
    rows = list(rows)
    scored = [row for row in rows if row.status == "ok"]
    values = known_values(scored, metric)
    failed = len(rows) - len(scored)
    if not values and (scored or not failed):
        return None
    return Quartiles.of([*values, *[math.inf] * failed], len(rows), failed)


def known_values(rows: Iterable[Row], metric: str) -> list[float]:
    """Return the values of a metric in the runs that have one."""
    return [value for row in rows if (value := row[metric]) is not None]


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

    @property
    def diverged(self) -> int:
        """Number of runs with scores that have diverged, see `Row.diverged`."""
        return sum(row.diverged for row in self.rows)


def run_groups(rows: Sequence[Row]) -> tuple[RunGroup, ...]:
    """Return the runs by scenario and estimator, in the order in which these first occur."""
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row.scenario, row.estimator), []).append(row)
    return tuple(RunGroup(*names, tuple(members)) for names, members in groups.items())


def all_runs(rows: Sequence[Row]) -> tuple[RunGroup, ...]:
    """Return the runs of all scenarios by variant and estimator; none where that is a single scenario."""
    members: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        variant = row.scenario.partition(VARIANT_SIGN)[2]
        members.setdefault((f"{ALL_SCENARIOS}{variant and f', {variant}'}", row.estimator), []).append(row)
    groups = (RunGroup(*names, tuple(runs)) for names, runs in members.items())
    return tuple(group for group in groups if len({row.scenario for row in group.rows}) > 1)


@dataclass(frozen=True)
class AverageNees:
    """The average NEES (ANEES) of runs: the mean over the runs with scores of the mean over time of each run."""

    runs: int
    """Number of runs with a NEES."""
    position: float | None
    """ANEES of the position, 3 expected; None without covariances."""
    orientation: float | None
    """ANEES of the orientation, 3 expected."""
    velocity: float | None
    """ANEES of the velocity, 3 expected; None without velocities."""
    bounds: tuple[float, float]
    """Two-sided 95 % bounds of the mean over so many runs at one instant, if the covariances are correct. Means over
    time vary less, so that a mean outside the bounds is so with more than 95 % confidence."""

    @classmethod
    def of(cls, rows: Iterable[Row]) -> "AverageNees | None":
        """Return the ANEES of runs; None if none of them has a NEES."""
        from dronevio.eval.metrics.consistency import nees_bounds

        scored = [row for row in rows if row.status == "ok"]
        runs = sum(row["nees_position"] is not None for row in scored)
        if not runs:
            return None
        return cls(
            runs,
            _mean(known_values(scored, "nees_position")),
            _mean(known_values(scored, "nees_orientation")),
            _mean(known_values(scored, "nees_velocity")),
            nees_bounds(3, runs),
        )


def _mean(values: Sequence[float]) -> float | None:
    """Return the mean of values; None if there are none."""
    return math.fsum(values) / len(values) if values else None


def failed_runs(rows: Sequence[Row]) -> tuple[tuple[str, str, str], ...]:
    """Return name, status and reason of each run that failed."""
    return tuple((run_name(row.identity), row.status, row.reason) for row in rows if row.status != "ok")
