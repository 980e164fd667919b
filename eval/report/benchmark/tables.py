"""The results of a benchmark as tables: for the page, and as Markdown, LaTeX and CSV."""

import csv
import io
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

from dronevio.eval.benchmark.outcomes import MAX_SIGMAS
from dronevio.eval.benchmark.rows import Row
from dronevio.eval.benchmark.summary import ALL_SCENARIOS, Quartiles
from dronevio.eval.metrics.metric import DASH, Metric
from dronevio.eval.report.benchmark.model import BenchmarkResults, seed_ranges, value_of
from dronevio.eval.report.benchmark.overview import (
    consistency_table,
    loop_table,
    number_cell,
    start_table,
    summary_table,
)
from dronevio.eval.report.tables import Cell, Table, latex_table, latex_text, markdown_table

CSV_COLUMNS = (
    "scenario",
    "estimator",
    "measure",
    "unit",
    "runs",
    "failed",
    "median",
    "lower_quartile",
    "upper_quartile",
)
"""Columns of the CSV file, with a line for each scenario, estimator and measure; ``inf`` stands for a failed run."""
NOTE = (
    "Tables show medians over seeds with quartiles in parentheses, and the best estimator first; the best median of a"
    " row is highlighted. A failed run ranks behind all others; it is left out of times and memory."
)
"""Explanation of the tables."""
RUN_COLUMNS = ("ate_m", "rpe_m", "drift_percent", "coverage_percent", "nees_position", "cpu_ms_mean", "wall_s")
"""Columns of the list of all runs, beside the metrics of the user."""
TABLES = ("summary", "measures", "consistency", "starts", "loops", "runs", "outcomes", "losses", "failures")
"""Names of the tables of a report."""
DEFAULT_TABLES = ("measures", "outcomes", "failures")
"""Names of the tables in Markdown and LaTeX by default."""
_MAX_REASON_LENGTH = 300  # characters; the rows hold the whole reason


def measure_table(results: BenchmarkResults, metric: Metric) -> Table:
    """Return the quartiles of a measure by scenario and over all scenarios, with the best estimator's column first."""
    rows = tuple(_row(results, metric, scenario) for scenario in results.scenarios)
    total = _row(results, metric, None) if len(results.scenarios) > 1 else ()
    return Table(metric.heading, ("scenario", *results.ranking), rows, total)


def failure_table(results: BenchmarkResults) -> Table:
    """Return the runs that failed, with their reasons."""
    rows = tuple(
        (
            Cell(failure.estimator),
            Cell(failure.scenario),
            Cell(_shortened(failure.reason) or DASH, warning=failure.status),
            Cell(str(len(failure.seeds)), order=float(len(failure.seeds))),
            Cell(seed_ranges(failure.seeds)),
        )
        for failure in results.failures()
    )
    columns = ("estimator", "scenario", "reason", "runs", "seeds")
    return Table("Failed runs", columns, rows, text_columns=frozenset((1, 2, 4)))


def loss_table(results: BenchmarkResults) -> Table:
    """Return the runs that failed, diverged, left tracking, or erred by too many standard deviations while tracking."""
    columns = (
        "scenario",
        "seed",
        "estimator",
        "status",
        "longest loss [s]",
        "largest error while tracking [σ]",
        "coverage [%]",
        "ATE [% of path]",
    )
    rows = tuple(_loss_row(row) for row in results.rows if _is_loss(row))
    return Table("Runs with losses of tracking", columns, rows, text_columns=frozenset((2, 3)))


def outcome_table(results: BenchmarkResults) -> Table:
    """Return the runs with an expected outcome: what was expected, and whether each run has it."""
    verdicts = {verdict.row.identity: verdict for verdict in results.verdicts}
    runs = dict.fromkeys((verdict.row.scenario, verdict.row.seed) for verdict in results.verdicts)
    rows = []
    for scenario, seed in runs:
        cells = []
        for estimator in results.estimators:
            verdict = verdicts.get((scenario, seed, estimator))
            if verdict is None:
                cells.append(Cell(DASH))
            else:
                order = math.inf if verdict.error_ratio is None else verdict.error_ratio
                warning = "" if verdict.passed else "not as expected"
                cells.append(Cell(_shortened(verdict.outcome), warning=warning, order=order))
        text = results.expectations[scenario].text
        rows.append((Cell(scenario), Cell(DASH if seed is None else str(seed)), Cell(text), *cells))
    columns = ("scenario", "seed", "expected", *results.estimators)
    return Table("Outcomes", columns, tuple(rows), text_columns=frozenset(range(2, len(columns))))


def run_table(results: BenchmarkResults) -> Table:
    """Return the table of all runs."""
    shown = results.measures_named(RUN_COLUMNS)
    rows = []
    for row in results.rows:
        values = (value_of(metric, row) if row.status == "ok" else None for metric in shown)
        cells = (
            Cell(DASH, order=float("inf")) if value is None else Cell(metric.compared_text(value), order=value)
            for metric, value in zip(shown, values, strict=True)
        )
        rows.append((*_run_cells(row), *cells))
    columns = ("scenario", "seed", "estimator", "status", *(metric.heading for metric in shown))
    return Table("All runs", columns, tuple(rows), text_columns=frozenset((2, 3)))


def as_markdown(results: BenchmarkResults, measures: Sequence[Metric], names: Sequence[str] = DEFAULT_TABLES) -> str:
    """Return tables as Markdown.

    Args:
        results: The benchmark.
        measures: Measures with a table.
        names: Names of `TABLES`, in the order of the report.
    """
    return "\n".join([f"{NOTE}\n", *(markdown_table(table) for table in _tables(results, measures, names))])


def as_latex(results: BenchmarkResults, measures: Sequence[Metric], names: Sequence[str] = DEFAULT_TABLES) -> str:
    """Return tables as LaTeX, for a document that uses the package booktabs; see `as_markdown`."""
    tables = (latex_table(table) for table in _tables(results, measures, names))
    return "\n".join(["% \\usepackage{booktabs}", f"% {latex_text(NOTE)}", *tables])


def as_csv(results: BenchmarkResults, measures: Sequence[Metric]) -> str:
    """Return a line for each scenario, estimator and measure; see `CSV_COLUMNS`."""
    text = io.StringIO()
    writer = csv.DictWriter(text, CSV_COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(records(results, measures))
    return text.getvalue()


def records(results: BenchmarkResults, measures: Sequence[Metric]) -> Iterator[dict[str, str | int | float]]:
    """Yield the values of `CSV_COLUMNS` for each scenario, estimator and measure."""
    for scenario in results.scenarios:
        for estimator in results.estimators:
            for metric in measures:
                quartiles = results.quartiles(metric, estimator, scenario)
                if quartiles is not None:
                    yield {
                        "scenario": scenario,
                        "estimator": estimator,
                        "measure": metric.name,
                        "unit": metric.unit or DASH,
                        "runs": quartiles.runs,
                        "failed": quartiles.failed,
                        "median": quartiles.median,
                        "lower_quartile": quartiles.lower,
                        "upper_quartile": quartiles.upper,
                    }


def quartile_range(metric: Metric, quartiles: Quartiles) -> str:
    """Return lower and upper quartile in parentheses; empty for a single run, or if both fall on failed runs."""
    if quartiles.runs < 2 or (math.isinf(quartiles.lower) and math.isinf(quartiles.upper)):
        return ""
    return f"({metric.compared_text(quartiles.lower)}–{metric.compared_text(quartiles.upper)})"


def _shortened(reason: str) -> str:
    line = " ".join(reason.split())
    return line if len(line) <= _MAX_REASON_LENGTH else f"{line[: _MAX_REASON_LENGTH - 1]}…"


def _tables(results: BenchmarkResults, measures: Sequence[Metric], names: Sequence[str]) -> list[Table]:
    """Return the tables of some names that have rows."""
    makers: dict[str, Callable[[BenchmarkResults], Table]] = {
        "summary": summary_table,
        "consistency": consistency_table,
        "starts": start_table,
        "loops": loop_table,
        "runs": run_table,
        "outcomes": outcome_table,
        "losses": loss_table,
        "failures": failure_table,
    }
    tables: list[Table] = []
    for name in names:
        tables += [measure_table(results, m) for m in measures] if name == "measures" else [makers[name](results)]
    return [table for table in tables if table.rows]


def _run_cells(row: Row) -> tuple[Cell, Cell, Cell, Cell]:
    """Return the cells of scenario, seed, estimator and status of a run."""
    seed = Cell(DASH if row.seed is None else str(row.seed), order=-1.0 if row.seed is None else float(row.seed))
    is_ok = row.status == "ok"
    status = Cell("ok", warning="diverged" if row.diverged else "") if is_ok else Cell("", warning=row.status)
    return Cell(row.scenario), seed, Cell(row.estimator), status


def _is_loss(row: Row) -> bool:
    """Return whether a run failed, diverged, left tracking, or erred by too many standard deviations while tracking."""
    left_tracking = (row["longest_loss_s"] or 0.0) > 0.0
    return row.status != "ok" or row.diverged or left_tracking or (row["tracking_sigmas"] or 0.0) > MAX_SIGMAS


def _loss_row(row: Row) -> tuple[Cell, ...]:
    sigmas = number_cell(row["tracking_sigmas"], 1)
    return (
        *_run_cells(row),
        number_cell(row["longest_loss_s"], 2),
        replace(sigmas, warning="too large" if (row["tracking_sigmas"] or 0.0) > MAX_SIGMAS else ""),
        number_cell(row["coverage_percent"], 1),
        number_cell(row["ate_percent"]),
    )


def _row(results: BenchmarkResults, metric: Metric, scenario: str | None) -> tuple[Cell, ...]:
    best = results.best(metric, scenario)
    cells = (_cell(results, metric, name, scenario, name in best) for name in results.ranking)
    return (Cell(ALL_SCENARIOS if scenario is None else scenario), *cells)


def _cell(results: BenchmarkResults, metric: Metric, estimator: str, scenario: str | None, best: bool) -> Cell:
    quartiles = results.quartiles(metric, estimator, scenario)
    if quartiles is None:
        return Cell(DASH, order=math.inf)
    ending = "runs" if math.isinf(quartiles.median) else "failed"  # the value itself already says that it failed
    failed = f"{quartiles.failed} of {quartiles.runs} {ending}" if quartiles.failed else ""
    order = quartiles.median if metric.best == "any" else metric.ranking_key(quartiles.median)
    return Cell(metric.compared_text(quartiles.median), quartile_range(metric, quartiles), failed, best, order)
