"""The results of a benchmark: medians and quartiles of every measure, estimator and scenario, with failed runs.

A failed run ranks behind all others in medians and quartiles, so that an estimator does not look better by failing.
A median that falls on a failed run is shown as "failed".
"""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Literal

from dronevio.eval.benchmark.outcomes import Expectation, Verdict, verdicts
from dronevio.eval.benchmark.rows import Row, read_rows
from dronevio.eval.benchmark.summary import Quartiles
from dronevio.models.errors import ConfigError, InputError

FAILED = "failed"
"""Text of a median that falls on a failed run."""


@dataclass(frozen=True)
class Measure:
    """A figure of a run by which estimators are compared."""

    column: str
    """Name of the column of `Row`."""
    title: str
    """Title for tables and plots."""
    unit: str
    """Unit of the values; a dash if they have none."""
    best: Literal["low", "high", "three", "none"] = "low"
    """Which value is best: the smallest, the largest, the one nearest to 3, or none."""
    counts_failed: bool = True
    """Whether a failed run counts as the worst value; otherwise it is left out."""
    decimals: int | None = None
    """Number of decimals; None for three significant digits."""

    @property
    def heading(self) -> str:
        """Title and unit."""
        return f"{self.title} [{self.unit}]"

    @property
    def worst(self) -> float:
        """The value of a failed run: ∞, or −∞ if large values are good."""
        return -math.inf if self.best == "high" else math.inf

    def of(self, row: Row) -> float | None:
        """Return the value of a run: `worst` if it failed and that counts, None if it has none."""
        if row.status != "ok" and self.counts_failed:
            return self.worst
        value: float | None = getattr(row, self.column)
        if value is None or not math.isfinite(value):
            return None
        return abs(value) if self.column == "scale_error_percent" else value

    def ranking_key(self, value: float) -> float:
        """Return the key by which values are ranked; the best value has the smallest key."""
        if self.best == "three":
            return abs(math.log(value / 3.0)) if 0.0 < value < math.inf else math.inf
        return {"low": value, "high": -value, "none": 0.0}[self.best]

    def text(self, value: float) -> str:
        """Return a value as text."""
        if math.isinf(value):
            return FAILED
        digits = f"{value:.{self.decimals}f}" if self.decimals is not None else significant(value)
        return digits.replace("-", "−")


MEASURES = (
    Measure("ate_m", "ATE, position", "m"),
    Measure("ate_percent", "ATE, position", "% of the path length"),
    Measure("max_error_m", "Largest position error", "m"),
    Measure("ate_deg", "ATE, orientation", "°"),
    Measure("rpe_m", "RPE over 1 s, position", "m"),
    Measure("rpe_deg", "RPE over 1 s, orientation", "°"),
    Measure("drift_percent", "Drift", "% of the path length"),
    Measure("scale_error_percent", "Absolute scale error", "%"),
    Measure("velocity_m_s", "Velocity error", "m/s"),
    Measure("coverage_percent", "Coverage", "% of the frames", best="high", decimals=1),
    Measure("first_pose_s", "Time of the first pose", "s"),
    Measure("nees_position", "NEES of the position, 3 expected", "–", best="three"),
    Measure("nees_orientation", "NEES of the orientation, 3 expected", "–", best="three"),
    Measure("nees_velocity", "NEES of the velocity, 3 expected", "–", best="three"),
    Measure("position_beyond_3_sigma_percent", "Position errors beyond 3σ, 0.27 expected", "%"),
    Measure("longest_gap_s", "Longest time between two poses", "s"),
    Measure("step_error_m", "Largest error of a step between poses", "m"),
    Measure("start_velocity_error_m_s", "Velocity error 2 s after the first pose", "m/s"),
    Measure("longest_loss_s", "Longest time without tracking", "s"),
    Measure("tracking_sigmas", "Largest position error while tracking", "σ"),
    Measure("rmse_after_revisit_m", "RMSE after the first revisit", "m"),
    Measure("final_after_revisit_m", "RMSE after the first revisit, final map", "m"),
    Measure("final_ate_m", "ATE, position, final map", "m"),
    Measure("recall_percent", "Recall of revisits", "%", best="high"),
    Measure("cpu_ms_mean", "Mean processor time per frame", "ms", counts_failed=False),
    Measure("cpu_ms_p99", "99th percentile of the processor time per frame", "ms", counts_failed=False),
    Measure("worker_cpu_ms", "Mean processor time of the map process per frame", "ms", counts_failed=False),
    Measure("cpu_growth", "Processor time, last / second quarter", "×", counts_failed=False),
    Measure("real_time_factor", "Flight / processor time", "×", best="high", counts_failed=False),
    Measure("peak_mb", "Peak memory", "MB", counts_failed=False),
    Measure("wall_s", "Elapsed time of the run", "s", best="none", counts_failed=False),
)
"""All measures; those that no run has are omitted from reports."""
MAIN_MEASURES = ("ate_m", "rpe_m", "drift_percent", "coverage_percent", "cpu_ms_mean")
"""Columns of the measures that Markdown and LaTeX tables show by default."""


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
        ate = find_measure("ate_m")
        found = {name: self.quartiles(ate, name) for name in self.estimators}
        keys = {name: (math.inf, math.inf) if q is None else (q.median, q.failed / q.runs) for name, q in found.items()}
        return tuple(sorted(self.estimators, key=lambda name: (found[name] is None, keys[name], name)))

    @cached_property
    def measures(self) -> tuple[Measure, ...]:
        """The measures that at least one run has."""
        scored = [row for row in self.rows if row.status == "ok"] or self.rows
        return tuple(m for m in MEASURES if any(getattr(row, m.column) is not None for row in scored))

    @cached_property
    def _rows_by_cell(self) -> dict[tuple[str, str], list[Row]]:
        cells: dict[tuple[str, str], list[Row]] = {}
        for row in self.rows:
            cells.setdefault((row.scenario, row.estimator), []).append(row)
        return cells

    @cached_property
    def _estimators_by_column(self) -> dict[str, frozenset[str]]:
        """The estimators of which a run has a value in a column, and those of which no run has scores at all."""
        found = {m.column: {r.estimator for r in self.rows if getattr(r, m.column) is not None} for m in MEASURES}
        unscored = frozenset(self.estimators) - {row.estimator for row in self.rows if row.status == "ok"}
        return {column: unscored | names for column, names in found.items()}

    def runs(self, estimator: str, scenario: str | None = None) -> list[Row]:
        """Return the runs of an estimator in one scenario, or in all if it is None."""
        chosen = self.scenarios if scenario is None else (scenario,)
        return [row for name in chosen for row in self._rows_by_cell.get((name, estimator), ())]

    def quartiles(self, measure: Measure, estimator: str, scenario: str | None = None) -> Quartiles | None:
        """Return the quartiles of a measure over an estimator's runs; None if it does not have the measure."""
        if estimator not in self._estimators_by_column[measure.column]:
            return None
        return measure_quartiles(measure, self.runs(estimator, scenario))

    def estimators_with(self, measure: Measure) -> tuple[str, ...]:
        """Return the estimators that have a measure, and those of which all runs failed."""
        return tuple(name for name in self.estimators if name in self._estimators_by_column[measure.column])

    def best(self, measure: Measure, scenario: str | None = None) -> frozenset[str]:
        """Return the estimators with the best median; none if all are equal."""
        found = {name: self.quartiles(measure, name, scenario) for name in self.estimators}
        keys = {name: measure.ranking_key(q.median) for name, q in found.items() if q is not None}
        smallest = min(keys.values(), default=math.inf)
        best = frozenset(name for name, key in keys.items() if key == smallest)
        return best if len(best) < len(keys) else frozenset()

    def wins(self, measure: Measure) -> Counter[str]:
        """Return the number of scenarios in which each estimator has the best median, ties included."""
        return Counter(name for scenario in self.scenarios for name in self.best(measure, scenario))

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


def find_measure(column: str) -> Measure:
    """Return the measure of a column.

    Raises:
        ConfigError: There is no such measure.
    """
    found = next((m for m in MEASURES if m.column == column), None)
    if found is None:
        known = ", ".join(m.column for m in MEASURES)
        raise ConfigError(f"unknown measure {column!r}; expected some of {known}")
    return found


def measure_quartiles(measure: Measure, rows: Sequence[Row]) -> Quartiles | None:
    """Return the quartiles of a measure over runs; None if no run that is ok has the measure."""
    scored = [row for row in rows if row.status == "ok"]
    values = [value for row in rows if (value := measure.of(row)) is not None]
    if not values or (scored and all(measure.of(row) is None for row in scored)):
        return None
    return Quartiles.of(values, len(rows), len(rows) - len(scored))


def significant(value: float, digits: int = 3) -> str:
    """Return a number with some significant digits, with an exponent only if it is very small or large."""
    if value and not 1e-4 <= abs(value) < 1e6:
        return f"{value:.{digits - 1}e}"
    if abs(value) >= 10**digits:
        return f"{value:.0f}"
    return f"{value:#.{digits}g}".removesuffix(".") if value else "0"


def seed_ranges(seeds: Iterable[int | None]) -> str:
    """Return ascending seeds as ranges, such as ``0–4, 7``."""
    found: list[list[int]] = []
    for seed in (seed for seed in seeds if seed is not None):
        if found and seed == found[-1][1] + 1:
            found[-1][1] = seed
        else:
            found.append([seed, seed])
    return ", ".join(f"{a}" if a == b else f"{a}–{b}" for a, b in found) or "–"


def _order(row: Row) -> tuple[str, str, int]:
    return row.scenario, row.estimator, -1 if row.seed is None else row.seed
