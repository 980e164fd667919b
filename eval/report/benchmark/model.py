"""What a benchmark says: medians and spreads of every estimator in every scenario, the failed runs included.

A run that failed is worse than any that did not, so an estimator cannot look good by giving up: it takes its place at
the bad end when medians and quartiles are taken, and a median reads "failed" where it falls on such a run.
"""

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

from dronevio.eval.benchmark.rows import Row, read_rows
from dronevio.models.errors import ConfigError, InputError

FAILED = "failed"
"""What stands where a median falls on a failed run."""
QUARTILES = (0.25, 0.5, 0.75)


@dataclass(frozen=True)
class Measure:
    """One number of a run, by which estimators are compared."""

    column: str
    """Its name in the rows."""
    title: str
    """What it is called."""
    unit: str
    """Its unit; a dash where it has none."""
    best: Literal["low", "high", "three", "none"] = "low"
    """Which value is best: the smallest, the largest, the one nearest to 3; or none is better than another."""
    counts_failed: bool = True
    """Whether a failed run counts as the worst; if not, it is left out, because it says nothing."""
    decimals: int | None = None
    """Digits behind the point; None for three digits in all."""

    @property
    def heading(self) -> str:
        """The title with its unit."""
        return f"{self.title} [{self.unit}]"

    @property
    def worst(self) -> float:
        """What a failed run counts as."""
        return -math.inf if self.best == "high" else math.inf

    def of(self, row: Row) -> float | None:
        """Return the value of a run: `worst` if it failed and that counts, None if there is none."""
        if row.status != "ok" and self.counts_failed:
            return self.worst
        value: float | None = getattr(row, self.column)
        if value is None or not math.isfinite(value):
            return None
        return abs(value) if self.column == "scale_error_percent" else value

    def badness(self, value: float) -> float:
        """Return how bad a value is; the best has the smallest."""
        if self.best == "three":
            return abs(math.log(value / 3.0)) if 0.0 < value < math.inf else math.inf
        return {"low": value, "high": -value, "none": 0.0}[self.best]

    def text(self, value: float) -> str:
        """Return a value for people."""
        if math.isinf(value):
            return FAILED
        digits = f"{value:.{self.decimals}f}" if self.decimals is not None else significant(value)
        return digits.replace("-", "−")


MEASURES = (
    Measure("ate_m", "ATE, position", "m"),
    Measure("ate_deg", "ATE, orientation", "°"),
    Measure("rpe_m", "RPE over 1 s, position", "m"),
    Measure("rpe_deg", "RPE over 1 s, orientation", "°"),
    Measure("drift_percent", "Drift", "% of the way"),
    Measure("scale_error_percent", "Scale error, size", "%"),
    Measure("velocity_m_s", "Velocity error", "m/s"),
    Measure("coverage_percent", "Coverage", "% of the frames", best="high", decimals=1),
    Measure("first_s", "Time to the first pose", "s"),
    Measure("nees_position", "NEES, position, 3 expected", "–", best="three"),
    Measure("nees_orientation", "NEES, orientation, 3 expected", "–", best="three"),
    Measure("beyond_3_sigma_percent", "Beyond 3σ, 0.27 expected", "% of the errors"),
    Measure("cpu_ms_mean", "Processor time a frame, mean", "ms", counts_failed=False),
    Measure("cpu_ms_p99", "Processor time a frame, 99 % under", "ms", counts_failed=False),
    Measure("real_time_factor", "Real-time factor", "×", best="high", counts_failed=False),
    Measure("peak_mb", "Memory", "MB", counts_failed=False),
    Measure("wall_s", "Time of the whole run", "s", best="none", counts_failed=False),
)
"""All that is compared; what no run has is left out."""
MAIN_MEASURES = ("ate_m", "rpe_m", "drift_percent", "coverage_percent", "cpu_ms_mean")
"""Columns of what tables for reading show unless told otherwise."""


@dataclass(frozen=True)
class Spread:
    """What many runs say of one measure, failed runs at the bad end."""

    median: float
    """Their median; infinite where it falls on a failed run."""
    lower: float
    """Lower quartile."""
    upper: float
    """Upper quartile."""
    runs: int
    """How many runs there are."""
    failed: int
    """How many of them failed."""


@dataclass(frozen=True)
class Failure:
    """Runs that failed in the same way."""

    estimator: str
    """Who estimated."""
    scenario: str
    """What was flown."""
    status: str
    """How they ended."""
    reason: str
    """Why."""
    seeds: tuple[int | None, ...]
    """Seeds of the runs, in order; None for recordings from elsewhere."""


@dataclass(frozen=True)
class Benchmark:
    """The runs of a benchmark, by scenario and estimator."""

    title: str
    """What to call it."""
    rows: tuple[Row, ...]
    """All runs."""

    @cached_property
    def scenarios(self) -> tuple[str, ...]:
        """What was flown, by name."""
        return tuple(sorted({row.scenario for row in self.rows}))

    @cached_property
    def estimators(self) -> tuple[str, ...]:
        """Who estimated, by name."""
        return tuple(sorted({row.estimator for row in self.rows}))

    @cached_property
    def measures(self) -> tuple[Measure, ...]:
        """What at least one run has been measured by."""
        scored = [row for row in self.rows if row.status == "ok"] or self.rows
        return tuple(m for m in MEASURES if any(getattr(row, m.column) is not None for row in scored))

    @cached_property
    def _by_cell(self) -> dict[tuple[str, str], list[Row]]:
        cells: dict[tuple[str, str], list[Row]] = {}
        for row in self.rows:
            cells.setdefault((row.scenario, row.estimator), []).append(row)
        return cells

    @cached_property
    def _who_tells(self) -> dict[str, frozenset[str]]:
        told = {m.column: {r.estimator for r in self.rows if getattr(r, m.column) is not None} for m in MEASURES}
        silent = frozenset(self.estimators) - {row.estimator for row in self.rows if row.status == "ok"}
        return {column: silent | names for column, names in told.items()}

    def runs(self, estimator: str, scenario: str | None = None) -> list[Row]:
        """Return the runs of an estimator, in one scenario or in all."""
        chosen = self.scenarios if scenario is None else (scenario,)
        return [row for name in chosen for row in self._by_cell.get((name, estimator), ())]

    def spread(self, measure: Measure, estimator: str, scenario: str | None = None) -> Spread | None:
        """Return what an estimator's runs say of a measure; None where they say nothing, or it never tells it."""
        if estimator not in self._who_tells[measure.column]:
            return None
        return spread(measure, self.runs(estimator, scenario))

    def telling(self, measure: Measure) -> tuple[str, ...]:
        """Return the estimators that have been measured by something, or might have been, had not all runs failed."""
        return tuple(name for name in self.estimators if name in self._who_tells[measure.column])

    def best(self, measure: Measure, scenario: str | None = None) -> frozenset[str]:
        """Return the estimators with the best median; none where none is better than another."""
        spreads = {name: self.spread(measure, name, scenario) for name in self.estimators}
        badness = {name: measure.badness(s.median) for name, s in spreads.items() if s is not None}
        least = min(badness.values(), default=math.inf)
        found = frozenset(name for name, value in badness.items() if value == least)
        return found if len(found) < len(badness) else frozenset()

    def wins(self, measure: Measure) -> Counter[str]:
        """Return in how many scenarios each estimator is the best, or one of them."""
        return Counter(name for scenario in self.scenarios for name in self.best(measure, scenario))

    def failures(self) -> tuple[Failure, ...]:
        """Return the runs that failed, those that did so in the same way together."""
        groups: dict[tuple[str, str, str, str], list[int | None]] = {}
        for row in self.rows:
            if row.status != "ok":
                groups.setdefault((row.estimator, row.scenario, row.status, row.reason), []).append(row.seed)
        return tuple(
            Failure(*group, tuple(sorted(seeds, key=lambda seed: -1 if seed is None else seed)))
            for group, seeds in sorted(groups.items())
        )


def read_benchmark(path: Path) -> Benchmark:
    """Read the results of a benchmark.

    Args:
        path: A Parquet file, or a benchmark's folder.

    Raises:
        InputError: It is missing, damaged, no benchmark's, or holds no run.
    """
    rows = read_rows(path)
    if not rows:
        raise InputError(path, "no runs", "one at least")
    name = path.resolve()
    title = name.name if name.is_dir() else name.parent.name if name.stem == "results" else name.stem
    return Benchmark(title, tuple(sorted(rows, key=_order)))


def measure(column: str) -> Measure:
    """Return the measure of that column.

    Raises:
        ConfigError: There is none.
    """
    found = next((m for m in MEASURES if m.column == column), None)
    if found is None:
        known = ", ".join(m.column for m in MEASURES)
        raise ConfigError(f"unknown measure {column!r}; expected some of {known}")
    return found


def spread(what: Measure, rows: Sequence[Row]) -> Spread | None:
    """Return what runs say of a measure; None if none of those that ended well says anything."""
    scored = [row for row in rows if row.status == "ok"]
    values = sorted(value for row in rows if (value := what.of(row)) is not None)
    if not values or (scored and all(what.of(row) is None for row in scored)):
        return None
    lower, median, upper = (quantile(values, share) for share in QUARTILES)
    return Spread(median, lower, upper, len(rows), len(rows) - len(scored))


def quantile(ordered: Sequence[float], share: float) -> float:
    """Return a quantile of ordered values: linear between neighbours, or the worse of them where a run failed."""
    place = share * (len(ordered) - 1)
    low, high = math.floor(place), math.ceil(place)
    if math.isinf(ordered[-1]):
        return ordered[high]
    if math.isinf(ordered[0]):
        return ordered[low]
    return ordered[low] + (place - low) * (ordered[high] - ordered[low])


def significant(value: float, digits: int = 3) -> str:
    """Return a number with so many digits, without an exponent where that can be read."""
    if value and not 1e-4 <= abs(value) < 1e6:
        return f"{value:.{digits - 1}e}"
    if abs(value) >= 10**digits:
        return f"{value:.0f}"
    return f"{value:#.{digits}g}".removesuffix(".") if value else "0"


def seed_ranges(seeds: Iterable[int | None]) -> str:
    """Return seeds in order as ranges: ``0–4, 7``."""
    found: list[list[int]] = []
    for seed in (seed for seed in seeds if seed is not None):
        if found and seed == found[-1][1] + 1:
            found[-1][1] = seed
        else:
            found.append([seed, seed])
    return ", ".join(f"{a}" if a == b else f"{a}–{b}" for a, b in found) or "–"


def _order(row: Row) -> tuple[str, str, int]:
    return row.scenario, row.estimator, -1 if row.seed is None else row.seed
