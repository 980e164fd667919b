"""``dronevio report``: the results of a benchmark as a page or as tables."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from dronevio.cli.terminal import parse

if TYPE_CHECKING:
    from dronevio.eval.report.benchmark.model import BenchmarkResults


@dataclass(frozen=True)
class ReportCommand:
    """Write the results of a benchmark as an HTML page, or as tables in Markdown, LaTeX or CSV.

    The page is a single file that needs no network. Tables have medians over seeds with quartiles; a failed run counts
    as an infinite error. CSV has one row per scenario, estimator and measure.

    Examples:
      dronevio report benchmarks/room
      dronevio report benchmarks/room/results.parquet --format markdown
      dronevio report benchmarks/room/results.parquet --format markdown --tables summary consistency
      dronevio report benchmarks/room/results.parquet --format latex --measures ate_m drift_percent --out table.tex
      dronevio report benchmarks/room/results.parquet --format csv > results.csv
    """

    results: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RESULTS")]
    """Folder of a benchmark, or its results.parquet."""
    format: Literal["html", "markdown", "latex", "csv"] = "html"
    """Format of the report."""
    out: Path | None = None
    """File to write. By default, a page is report.html beside the results and tables go to standard output."""
    title: str | None = None
    """Title of the report; the name of the benchmark's folder by default."""
    tables: tuple[
        Literal["summary", "measures", "consistency", "starts", "loops", "runs", "outcomes", "losses", "failures"], ...
    ] = ()
    """Tables in Markdown and LaTeX: a summary of each scenario and estimator, a table for each measure, the average
    NEES of position, orientation and velocity, the initialization, loops with the errors after the first revisit, all
    runs, expected outcomes, the runs that failed, diverged or left tracking, and failed runs with their reasons. By
    default measures, outcomes and failures. Tables without rows are left out."""
    measures: tuple[str, ...] = ()
    """Columns of the results that get a table. By default these are the main ones, and all of them for CSV. The page
    has all columns."""


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    command = parse(ReportCommand, arguments, "report")

    from dronevio.benchmark.expectations import EXPECTATIONS
    from dronevio.eval.report.benchmark.model import read_benchmark
    from dronevio.models.recordings.files import write_text

    benchmark = replace(read_benchmark(command.results), expectations=EXPECTATIONS)
    if command.title is not None:
        benchmark = replace(benchmark, title=command.title)
    text = _document(benchmark, command)
    folder = command.results if command.results.is_dir() else command.results.parent
    out = command.out or (folder / "report.html" if command.format == "html" else None)
    if out is None:
        print(text, end="")
        return 0
    write_text(out, text)
    print(f"report:  {out}")
    return 0


def _document(benchmark: "BenchmarkResults", command: ReportCommand) -> str:
    """Return the benchmark in the format that is asked for."""
    if command.format == "html":
        from dronevio.eval.report.benchmark.page import benchmark_page

        return benchmark_page(benchmark)

    from dronevio.eval.benchmark.metrics import metric_named
    from dronevio.eval.report.benchmark.model import MAIN_MEASURES
    from dronevio.eval.report.benchmark.tables import DEFAULT_TABLES, as_csv, as_latex, as_markdown

    chosen = tuple(metric_named(name, benchmark.own_metrics) for name in command.measures)
    default = benchmark.measures if command.format == "csv" else benchmark.measures_named(MAIN_MEASURES)
    if command.format == "csv":
        return as_csv(benchmark, chosen or default)
    render = {"markdown": as_markdown, "latex": as_latex}[command.format]
    return render(benchmark, chosen or default, command.tables or DEFAULT_TABLES)
