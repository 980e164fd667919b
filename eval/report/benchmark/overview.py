"""Tables with a row for each scenario and estimator: summary, consistency, and initialization."""

import math
from collections.abc import Iterable, Sequence

from dronevio.eval.benchmark.rows import Row
from dronevio.eval.benchmark.summary import AverageNees, RunGroup, all_runs, quartiles_of_errors, run_groups
from dronevio.eval.report.benchmark.model import FAILED, BenchmarkResults, significant
from dronevio.eval.report.tables import DASH, Cell, Table

SUMMARY_NOTE = "A run has diverged if its coverage is below 99 % or its ATE above 1 % of the length of the path."
"""Explanation of the column ``diverged``."""
_TEXT_COLUMNS = frozenset((1,))  # the estimator


def summary_table(results: BenchmarkResults) -> Table:
    """Return errors, failures and processor time of each scenario and estimator, and of all scenarios."""
    columns = (
        "scenario",
        "estimator",
        "runs",
        "failed",
        "diverged",
        "ATE [m]",
        "ATE [% of path]",
        "largest [%]",
        "RPE 1 s [m]",
        "scale [%]",
        "smallest coverage [%]",
        "latest first pose [s]",
        "ms per frame",
        "p99",
    )
    rows = tuple(_summary_row(group) for group in _groups(results.rows))
    return Table("Summary: medians over runs", columns, rows, text_columns=_TEXT_COLUMNS)


def consistency_table(results: BenchmarkResults) -> Table:
    """Return the ANEES of position, orientation and velocity of each scenario and estimator, and of all scenarios."""
    columns = ("scenario", "estimator", "runs", "position", "orientation", "velocity", "95 % bounds")
    found = ((group, AverageNees.of(group.rows)) for group in _groups(results.rows))
    rows = tuple(_consistency_row(group, nees) for group, nees in found if nees is not None)
    return Table("Average NEES (ANEES), 3 expected", columns, rows, text_columns=_TEXT_COLUMNS)


def start_table(results: BenchmarkResults) -> Table:
    """Return how each estimator was initialized in each scenario: when, and how exactly."""
    columns = (
        "scenario",
        "estimator",
        "runs",
        "started",
        "acceleration [m/s²]",
        "first pose [s]",
        "latest [s]",
        "velocity error after 2 s [m/s]",
        "of speed [m/s]",
        "within 5 % or 3 cm/s",
        "largest scale error [%]",
        "ATE [m]",
    )
    rows = tuple(_start_row(group) for group in _groups(results.rows) if any(r.start_s is not None for r in group.rows))
    return Table("Initialization: medians over runs", columns, rows, text_columns=_TEXT_COLUMNS)


def _groups(rows: Sequence[Row]) -> tuple[RunGroup, ...]:
    """Return the runs by scenario and estimator, and then of all scenarios."""
    return (*run_groups(rows), *all_runs(rows))


def _summary_row(group: RunGroup) -> tuple[Cell, ...]:
    rows, failed, diverged = group.rows, len(group.rows) - group.ok, group.diverged
    percent = [math.inf if row.status != "ok" else row.ate_percent for row in rows]
    return (
        *_names(group),
        _count(failed, "failed" if failed else ""),
        _count(diverged, "diverged" if diverged else ""),
        _median(rows, "ate_m"),
        _median(rows, "ate_percent"),
        _number(max((value for value in percent if value is not None), default=None)),
        _median(rows, "rpe_m"),
        _median(rows, "scale_error_percent"),
        _number(min(_known(rows, "coverage_percent"), default=None), 1),
        _number(max(_known(rows, "start_s"), default=None), 2),
        _median([row for row in rows if row.status == "ok"], "cpu_ms_mean", 1),
        _median([row for row in rows if row.status == "ok"], "cpu_ms_p99", 1),
    )


def _consistency_row(group: RunGroup, nees: AverageNees) -> tuple[Cell, ...]:
    low, high = nees.bounds
    means = (_number(mean, 2) for mean in (nees.position, nees.orientation, nees.velocity))
    scenario, estimator, _ = _names(group)
    return scenario, estimator, _count(nees.runs), *means, Cell(f"{low:.2f}–{high:.2f}", order=low)


def _start_row(group: RunGroup) -> tuple[Cell, ...]:
    rows = group.rows
    started = _known(rows, "start_s")
    scale = max((abs(value) for value in _known(rows, "start_scale_error_percent")), default=None)
    return (
        *_names(group),
        _count(len(started), "" if len(started) == len(rows) else "not all"),
        _number(_middle(_known(rows, "start_acceleration_m_s2")), 2),
        _number(_middle(started), 2),
        _number(max(started, default=None), 2),
        _number(_middle(_known(rows, "start_velocity_error_m_s")), 3),
        _number(_middle(_known(rows, "start_speed_m_s")), 2),
        _count(sum(row.started_accurately for row in rows)),
        _number(scale, 1),
        _median(rows, "ate_m"),
    )


def _names(group: RunGroup) -> tuple[Cell, Cell, Cell]:
    """Return the cells of scenario, estimator, and number of runs."""
    return Cell(group.scenario), Cell(group.estimator), _count(len(group.rows))


def _known(rows: Iterable[Row], column: str) -> list[float]:
    """Return the values of a column in the runs that have one."""
    return [value for row in rows if (value := getattr(row, column)) is not None]


def _middle(values: Sequence[float]) -> float | None:
    ordered = sorted(values)
    return (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2.0 if ordered else None


def _median(rows: Sequence[Row], column: str, decimals: int | None = None) -> Cell:
    """Return the median of a column, in which a failed run ranks behind all others."""
    quartiles = quartiles_of_errors(rows, column)
    return _number(None if quartiles is None else quartiles.median, decimals)


def _number(value: float | None, decimals: int | None = None) -> Cell:
    if value is None:
        return Cell(DASH, order=math.inf)
    if math.isinf(value):
        return Cell(FAILED, order=math.inf)
    text = significant(value) if decimals is None else f"{value:.{decimals}f}"
    return Cell(text.replace("-", "−"), order=value)


def _count(count: int, warning: str = "") -> Cell:
    return Cell(str(count), warning=warning, order=float(count))
