"""A benchmark as tables, to be read, put into a paper or counted with: Markdown, LaTeX and CSV."""

import csv
import io
import math
from collections.abc import Iterator, Sequence

from dronevio.eval.report.benchmark.model import Benchmark, Measure, Spread, seed_ranges
from dronevio.eval.report.tables import DASH, Cell, Table, latex_table, latex_text, markdown_table

ALL_SCENARIOS = "all scenarios"
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
"""Columns of the CSV: a line for each scenario, estimator and measure; ``inf`` where a failed run stands."""
READING = (
    "Medians over seeds, with quartiles; the best median of a row is marked. A failed run counts as worse than any"
    " other, but is left out of times and memory."
)
"""How to read the tables."""
_LONGEST_REASON = 300  # letters; the rows hold the whole


def measure_table(benchmark: Benchmark, measure: Measure) -> Table:
    """Return a measure of every estimator in every scenario, and over all of them."""
    rows = tuple(_row(benchmark, measure, scenario) for scenario in benchmark.scenarios)
    total = _row(benchmark, measure, None) if len(benchmark.scenarios) > 1 else ()
    return Table(measure.heading, ("scenario", *benchmark.estimators), rows, total)


def failure_table(benchmark: Benchmark) -> Table:
    """Return the runs that failed, and why."""
    rows = tuple(
        (
            Cell(failure.estimator),
            Cell(failure.scenario),
            Cell(_shortened(failure.reason) or DASH, warning=failure.status),
            Cell(str(len(failure.seeds)), order=float(len(failure.seeds))),
            Cell(seed_ranges(failure.seeds)),
        )
        for failure in benchmark.failures()
    )
    columns = ("estimator", "scenario", "why", "runs", "seeds")
    return Table("Runs that failed", columns, rows, words=frozenset((1, 2, 4)))


def as_markdown(benchmark: Benchmark, measures: Sequence[Measure]) -> str:
    """Return the tables as Markdown."""
    return "\n".join([f"{READING}\n", *(markdown_table(table) for table in _tables(benchmark, measures))])


def as_latex(benchmark: Benchmark, measures: Sequence[Measure]) -> str:
    """Return the tables as LaTeX, for a document that uses the package booktabs."""
    tables = (latex_table(table) for table in _tables(benchmark, measures))
    return "\n".join(["% \\usepackage{booktabs}", f"% {latex_text(READING)}", *tables])


def as_csv(benchmark: Benchmark, measures: Sequence[Measure]) -> str:
    """Return a line for each scenario, estimator and measure; see `CSV_COLUMNS`."""
    text = io.StringIO()
    writer = csv.DictWriter(text, CSV_COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(records(benchmark, measures))
    return text.getvalue()


def records(benchmark: Benchmark, measures: Sequence[Measure]) -> Iterator[dict[str, str | int | float]]:
    """Yield what is known of each scenario, estimator and measure, by `CSV_COLUMNS`."""
    for scenario in benchmark.scenarios:
        for estimator in benchmark.estimators:
            for measure in measures:
                found = benchmark.spread(measure, estimator, scenario)
                if found is not None:
                    yield {
                        "scenario": scenario,
                        "estimator": estimator,
                        "measure": measure.column,
                        "unit": measure.unit,
                        "runs": found.runs,
                        "failed": found.failed,
                        "median": found.median,
                        "lower_quartile": found.lower,
                        "upper_quartile": found.upper,
                    }


def spread_text(measure: Measure, spread: Spread) -> str:
    """Return the quartiles for people; nothing where there is but one run."""
    if spread.runs < 2 or (math.isinf(spread.lower) and math.isinf(spread.upper)):
        return ""
    return f"({measure.text(spread.lower)}–{measure.text(spread.upper)})"


def _shortened(reason: str) -> str:
    flat = " ".join(reason.split())
    return flat if len(flat) <= _LONGEST_REASON else f"{flat[: _LONGEST_REASON - 1]}…"


def _tables(benchmark: Benchmark, measures: Sequence[Measure]) -> list[Table]:
    tables = [measure_table(benchmark, measure) for measure in measures]
    failures = failure_table(benchmark)
    return [*tables, failures] if failures.rows else tables


def _row(benchmark: Benchmark, measure: Measure, scenario: str | None) -> tuple[Cell, ...]:
    best = benchmark.best(measure, scenario)
    cells = (_cell(benchmark, measure, name, scenario, name in best) for name in benchmark.estimators)
    return (Cell(ALL_SCENARIOS if scenario is None else scenario), *cells)


def _cell(benchmark: Benchmark, measure: Measure, estimator: str, scenario: str | None, best: bool) -> Cell:
    found = benchmark.spread(measure, estimator, scenario)
    if found is None:
        return Cell(DASH, order=math.inf)
    failed = f"{found.failed} of {found.runs} failed" if found.failed else ""
    text = measure.text(found.median)
    order = found.median if measure.best == "none" else measure.badness(found.median)
    return Cell(text, spread_text(measure, found), failed, best, order)
