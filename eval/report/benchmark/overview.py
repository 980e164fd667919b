"""Tables with a row for each scenario and estimator: summary, consistency, and initialization."""

import math
from collections.abc import Sequence
from dataclasses import replace

from dronevio.eval.benchmark.loop_summary import EQUAL_M, EQUAL_PERCENT, LARGE_ERROR_M, LoopSummary, PathSummary
from dronevio.eval.benchmark.outcomes import MAX_SIGMAS
from dronevio.eval.benchmark.rows import Row
from dronevio.eval.benchmark.summary import (
    AverageNees,
    RunGroup,
    all_runs,
    known_values,
    quartiles_of_errors,
    run_groups,
)
from dronevio.eval.metrics.metric import DASH, FAILED, significant
from dronevio.eval.report.benchmark.model import BenchmarkResults
from dronevio.eval.report.tables import Cell, Table

SUMMARY_NOTE = "A run has diverged if its coverage is below 99 % or its ATE above 1 % of the length of the path."
"""Explanation of the column ``diverged``."""
LOOP_NOTE = (
    "Errors are those of the position over the frames later than 2 s after the first revisit of the flight (all frames"
    f" without revisits). The ratios to the odometry are medians over the runs in which it errs by more than"
    f" {1e3 * LARGE_ERROR_M:.0f} mm; the difference from it is that of the worst of the other runs, where"
    f" {1e3 * EQUAL_M:.0f} mm or {EQUAL_PERCENT:.0f} % is no difference."
)
"""Explanation of the table of loops."""
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
        "longest loss [s]",
        "largest error while tracking [σ]",
        "ms per frame",
        "p99",
    )
    rows = tuple(_summary_row(group) for group in _groups(results.rows))
    return Table("Summary: medians over runs", columns, rows, text_columns=_TEXT_COLUMNS)


def consistency_table(results: BenchmarkResults) -> Table:
    """Return the ANEES of position, orientation and velocity of each scenario and estimator, and of all scenarios."""
    columns = ("scenario", "estimator", "runs", "position", "orientation", "velocity", "95 % bounds")
    averages = ((group, AverageNees.of(group.rows)) for group in _groups(results.rows))
    rows = tuple(_consistency_row(group, nees) for group, nees in averages if nees is not None)
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
    rows = tuple(_start_row(group) for group in _groups(results.rows) if known_values(group.rows, "start_s"))
    return Table("Initialization: medians over runs", columns, rows, text_columns=_TEXT_COLUMNS)


def loop_table(results: BenchmarkResults) -> Table:
    """Return what loops do to the accuracy after the first revisit, for each scenario and estimator, and for all."""
    columns = (
        "scenario",
        "estimator",
        "runs",
        "odometry [mm]",
        "online [mm]",
        "final [mm]",
        f"above {1e3 * LARGE_ERROR_M:.0f} mm",
        "online ratio",
        "final ratio",
        "others: online",
        "others: final",
        "loops",
        "wrong loops",
        "recall [%]",
        "smallest [%]",
    )
    summaries = ((group, LoopSummary.of(group.rows)) for group in _groups(results.rows))
    rows = tuple(_loop_row(group, summary) for group, summary in summaries if summary is not None)
    return Table("Loops: medians of errors after the first revisit", columns, rows, text_columns=_TEXT_COLUMNS)


def number_cell(value: float | None, decimals: int | None = None) -> Cell:
    """Return the cell of a number with some decimals, by default with three significant digits; a dash for None."""
    if value is None:
        return Cell(DASH, order=math.inf)
    if math.isinf(value):
        return Cell(FAILED, order=math.inf)
    text = significant(value) if decimals is None else f"{value:.{decimals}f}"
    return Cell(text.replace("-", "−"), order=value)


def _groups(rows: Sequence[Row]) -> tuple[RunGroup, ...]:
    """Return the runs by scenario and estimator, and then of all scenarios."""
    return (*run_groups(rows), *all_runs(rows))


def _summary_row(group: RunGroup) -> tuple[Cell, ...]:
    rows, failed, diverged = group.rows, len(group.rows) - group.ok, group.diverged
    percent = [math.inf if row.status != "ok" else row["ate_percent"] for row in rows]
    sigmas = max(known_values(rows, "tracking_sigmas"), default=None)
    return (
        *_names(group),
        _count(failed, "failed" if failed else ""),
        _count(diverged, "diverged" if diverged else ""),
        _median(rows, "ate_m"),
        _median(rows, "ate_percent"),
        number_cell(max((value for value in percent if value is not None), default=None)),
        _median(rows, "rpe_m"),
        _median(rows, "scale_error_percent"),
        number_cell(min(known_values(rows, "coverage_percent"), default=None), 1),
        number_cell(max(known_values(rows, "start_s"), default=None), 2),
        number_cell(max(known_values(rows, "longest_loss_s"), default=None), 2),
        replace(number_cell(sigmas, 1), warning="too large" if sigmas is not None and sigmas > MAX_SIGMAS else ""),
        _median([row for row in rows if row.status == "ok"], "cpu_ms_mean", 1),
        _median([row for row in rows if row.status == "ok"], "cpu_ms_p99", 1),
    )


def _consistency_row(group: RunGroup, nees: AverageNees) -> tuple[Cell, ...]:
    low, high = nees.bounds
    means = (number_cell(mean, 2) for mean in (nees.position, nees.orientation, nees.velocity))
    scenario, estimator, _ = _names(group)
    return scenario, estimator, _count(nees.runs), *means, Cell(f"{low:.2f}–{high:.2f}", order=low)


def _start_row(group: RunGroup) -> tuple[Cell, ...]:
    rows = group.rows
    started = known_values(rows, "start_s")
    scale = max((abs(value) for value in known_values(rows, "start_scale_error_percent")), default=None)
    return (
        *_names(group),
        _count(len(started), "" if len(started) == len(rows) else "not all"),
        number_cell(_middle(known_values(rows, "start_acceleration_m_s2")), 2),
        number_cell(_middle(started), 2),
        number_cell(max(started, default=None), 2),
        number_cell(_middle(known_values(rows, "start_velocity_error_m_s")), 3),
        number_cell(_middle(known_values(rows, "start_speed_m_s")), 2),
        _count(sum(row.started_accurately for row in rows)),
        number_cell(scale, 1),
        _median(rows, "ate_m"),
    )


def _loop_row(group: RunGroup, summary: LoopSummary) -> tuple[Cell, ...]:
    scenario, estimator, _ = _names(group)
    paths, failed = (summary.online, summary.final), len(group.rows) - group.ok
    return (
        scenario,
        estimator,
        _count(len(group.rows), f"{failed} failed" if failed else ""),
        _millimetres(summary.odometry_m),
        *(_millimetres(None if path is None else path.median_m) for path in paths),
        _count(summary.large),
        *(number_cell(None if path is None else path.ratio, 2) for path in paths),
        *(_excess(path) for path in paths),
        number_cell(summary.loops, 0),
        _count(summary.wrong_loops, "wrong") if summary.wrong_loops else number_cell(summary.wrong_loops, 0),
        number_cell(summary.recall_percent, 0),
        number_cell(summary.smallest_recall_percent, 0),
    )


def _millimetres(value_m: float | None) -> Cell:
    return number_cell(None if value_m is None else 1e3 * value_m, 1)


def _excess(path: PathSummary | None) -> Cell:
    """Return the worst difference from the odometry in mm and percent, with a warning if it is beyond both limits."""
    if path is None or path.worst is None:
        return Cell(DASH, order=math.inf)
    worst = path.worst
    text = f"{1e3 * worst.difference_m:+.1f} mm, {worst.percent:+.0f} %".replace("-", "−")
    return Cell(text, warning="worse" if worst.ratio_to_limit > 1.0 else "", order=worst.ratio_to_limit)


def _names(group: RunGroup) -> tuple[Cell, Cell, Cell]:
    """Return the cells of scenario, estimator, and number of runs."""
    return Cell(group.scenario), Cell(group.estimator), _count(len(group.rows))


def _middle(values: Sequence[float]) -> float | None:
    ordered = sorted(values)
    return (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2.0 if ordered else None


def _median(rows: Sequence[Row], column: str, decimals: int | None = None) -> Cell:
    """Return the median of a column, in which a failed run ranks behind all others."""
    quartiles = quartiles_of_errors(rows, column)
    return number_cell(None if quartiles is None else quartiles.median, decimals)


def _count(count: int, warning: str = "") -> Cell:
    return Cell(str(count), warning=warning, order=float(count))
