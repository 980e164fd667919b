"""The results of a benchmark: medians and quartiles of every metric, estimator and scenario, with failed runs.

A failed run ranks behind all others in medians and quartiles, so that an estimator does not look better by failing.
A median that falls on a failed run is shown as "failed".
"""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from dronevio.eval.benchmark.metrics import METRICS, OwnMetric
from dronevio.eval.benchmark.outcomes import Expectation, Verdict, verdicts
from dronevio.eval.benchmark.rows import Row, own_metrics, read_rows
from dronevio.eval.benchmark.summary import Quartiles, known_values
from dronevio.eval.metrics.metric import Metric
from dronevio.models.errors import InputError

MAIN_MEASURES = ("ate_m", "rpe_m", "drift_percent", "coverage_percent", "cpu_ms_mean")
"""Names of the metrics that Markdown and LaTeX tables show by default, beside those of the user."""


@dataclass(frozen=True)
class FailureGroup:
    """Runs of one estimator on one scenario that failed for the same reason."""

    estimator: str
    """Label of the estimator."""
    scenario: str
    """Name of the scenario."""
    status: str
    """How the runs ended."""
    reason: str
    """Why the runs failed."""
    seeds: tuple[int | None, ...]
    """Seeds of the runs in ascending order; None for existing recordings."""


@dataclass(frozen=True)
class BenchmarkResults:
    """The runs of a benchmark, by scenario and estimator."""

    title: str
    """Title of the report."""
    rows: tuple[Row, ...]
    """All runs of the benchmark."""
    expectations: Mapping[str, Expectation] = field(default_factory=dict)
    """Expected outcomes by name of the scenario, of those scenarios that have one."""

    @cached_property
    def scenarios(self) -> tuple[str, ...]:
        """Names of the scenarios, sorted."""
        return tuple(sorted({row.scenario for row in self.rows}))

    @cached_property
    def estimators(self) -> tuple[str, ...]:
        """Labels of the estimators, sorted."""
        return tuple(sorted({row.estimator for row in self.rows}))

    @cached_property
    def ranking(self) -> tuple[str, ...]:
        """Labels of the estimators by their median ATE over all runs, the best first.

        Of estimators whose median run failed, those with fewer failed runs come first; then those without an ATE.
        """
        ate = {name: self.quartiles(METRICS["ate_m"], name) for name in self.estimators}
        keys = {name: (math.inf, math.inf) if q is None else (q.median, q.failed / q.runs) for name, q in ate.items()}
        return tuple(sorted(self.estimators, key=lambda name: (ate[name] is None, keys[name], name)))

    @cached_property
    def own_metrics(self) -> tuple[OwnMetric, ...]:
        """The metrics of the user."""
        return own_metrics(self.rows)

    @cached_property
    def measures(self) -> tuple[Metric, ...]:
        """The metrics by which estimators are compared, and which at least one run has."""
        scored = [row for row in self.rows if row.status == "ok"] or self.rows
        compared = (metric for metric in (*METRICS.values(), *self.own_metrics) if metric.best is not None)
        return tuple(metric for metric in compared if known_values(scored, metric.name))

    def measures_named(self, names: Iterable[str]) -> tuple[Metric, ...]:
        """Return the measures of some names, and those of the user."""
        chosen = {*names, *(metric.name for metric in self.own_metrics)}
        return tuple(metric for metric in self.measures if metric.name in chosen)

    @cached_property
    def _rows_by_cell(self) -> dict[tuple[str, str], list[Row]]:
        cells: dict[tuple[str, str], list[Row]] = {}
        for row in self.rows:
            cells.setdefault((row.scenario, row.estimator), []).append(row)
        return cells

    @cached_property
    def _estimators_by_metric(self) -> dict[str, frozenset[str]]:
        """The estimators of which a run has a value of a metric, and those of which no run has scores at all."""
        unscored = frozenset(self.estimators) - {row.estimator for row in self.rows if row.status == "ok"}
        names = (*METRICS, *(metric.name for metric in self.own_metrics))
        return {name: unscored | {row.estimator for row in self.rows if row[name] is not None} for name in names}

    def runs(self, estimator: str, scenario: str | None = None) -> list[Row]:
        """Return the runs of an estimator in one scenario, or in all if it is None."""
        chosen = self.scenarios if scenario is None else (scenario,)
        return [row for name in chosen for row in self._rows_by_cell.get((name, estimator), ())]

    def quartiles(self, metric: Metric, estimator: str, scenario: str | None = None) -> Quartiles | None:
        """Return the quartiles of a metric over an estimator's runs; None if it does not have the metric."""
        if estimator not in self._estimators_by_metric[metric.name]:
            return None
        return metric_quartiles(metric, self.runs(estimator, scenario))

    def estimators_with(self, metric: Metric) -> tuple[str, ...]:
        """Return the estimators that have a metric, and those of which all runs failed."""
        return tuple(name for name in self.estimators if name in self._estimators_by_metric[metric.name])

    def best(self, metric: Metric, scenario: str | None = None) -> frozenset[str]:
        """Return the estimators with the best median; none if all are equal."""
        spreads = {name: self.quartiles(metric, name, scenario) for name in self.estimators}
        keys = {name: metric.ranking_key(q.median) for name, q in spreads.items() if q is not None}
        smallest = min(keys.values(), default=math.inf)
        best = frozenset(name for name, key in keys.items() if key == smallest)
        return best if len(best) < len(keys) else frozenset()

    def wins(self, metric: Metric) -> Counter[str]:
        """Return the number of scenarios in which each estimator has the best median, ties included."""
        return Counter(name for scenario in self.scenarios for name in self.best(metric, scenario))

    @cached_property
    def verdicts(self) -> tuple[Verdict, ...]:
        """Whether the runs have their expected outcomes, of those runs that have one."""
        return verdicts(self.rows, self.expectations)

    def failures(self) -> tuple[FailureGroup, ...]:
        """Return the runs that failed, grouped by estimator, scenario, status and reason."""
        groups: dict[tuple[str, str, str, str], list[int | None]] = {}
        for row in self.rows:
            if row.status != "ok":
                groups.setdefault((row.estimator, row.scenario, row.status, row.reason), []).append(row.seed)
        return tuple(
            FailureGroup(*group, tuple(sorted(seeds, key=lambda seed: -1 if seed is None else seed)))
            for group, seeds in sorted(groups.items())
        )


def read_benchmark(path: Path) -> BenchmarkResults:
    """Read the results of a benchmark.

    Args:
        path: A Parquet file, or the folder of a benchmark.

    Raises:
        InputError: The file is missing, damaged, not that of a benchmark, or holds no run.
    """
    rows = read_rows(path)
    if not rows:
        raise InputError(path, "no runs", "at least one")
    whole = path.resolve()
    title = whole.name if whole.is_dir() else whole.parent.name if whole.stem == "results" else whole.stem
    return BenchmarkResults(title, tuple(sorted(rows, key=_order)))


def value_of(metric: Metric, row: Row) -> float | None:
    """Return the value of a run for comparison: the worst if it failed and that counts, None if it has none.

    Of errors with a sign, it is the magnitude.
    """
    if row.status != "ok" and metric.counts_failed:
        return metric.worst
    value = row[metric.name]
    if value is None or not math.isfinite(value):
        return None
    return abs(value) if metric.signed else value


def metric_quartiles(metric: Metric, rows: Sequence[Row]) -> Quartiles | None:
    """Return the quartiles of a metric over runs; None if no run that is ok has the metric."""
    scored = [row for row in rows if row.status == "ok"]
    values = [value for row in rows if (value := value_of(metric, row)) is not None]
    if not values or (scored and all(value_of(metric, row) is None for row in scored)):
        return None
    return Quartiles.of(values, len(rows), len(rows) - len(scored))


def seed_ranges(seeds: Iterable[int | None]) -> str:
    """Return ascending seeds as ranges, such as ``0–4, 7``."""
    ranges: list[list[int]] = []
    for seed in (seed for seed in seeds if seed is not None):
        if ranges and seed == ranges[-1][1] + 1:
            ranges[-1][1] = seed
        else:
            ranges.append([seed, seed])
    return ", ".join(f"{a}" if a == b else f"{a}–{b}" for a, b in ranges) or "–"


def _order(row: Row) -> tuple[str, str, int]:
    return row.scenario, row.estimator, -1 if row.seed is None else row.seed
