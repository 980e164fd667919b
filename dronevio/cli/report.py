"""``dronevio report``: a benchmark's results as a page or as tables."""

import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from dronevio.cli.terminal import parse
from dronevio.models.errors import InputError

if TYPE_CHECKING:
    from dronevio.eval.report.benchmark.model import Benchmark


@dataclass(frozen=True)
class ReportCommand:
    """Show the results of a benchmark: as a page for a browser, or as tables for a text, a paper or a program.

    The page is one file that needs nothing else, no network either. Tables show medians over seeds and quartiles; a run
    that failed counts as worse than any other. CSV has a line for each scenario, estimator and measure.

    For example:
      dronevio report runs/benchmark
      dronevio report results.parquet --format markdown
      dronevio report results.parquet --format latex --measures ate_m drift_percent --out table.tex
      dronevio report results.parquet --format csv > results.csv
    """

    results: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RESULTS")]
    """Folder of a benchmark, or its results.parquet."""
    format: Literal["html", "markdown", "latex", "csv"] = "html"
    """What to make."""
    out: Path | None = None
    """File to write; report.html beside the results for a page, standard output for tables."""
    title: str | None = None
    """What to call the benchmark; the name of its folder by default."""
    measures: tuple[str, ...] = ()
    """Columns of the results to make tables of; the main ones by default, all of them for CSV. The page has all."""


def main(arguments: Sequence[str]) -> int:
    """Run the command."""
    command = parse(ReportCommand, arguments, "report")

    from dronevio.eval.report.benchmark.model import read_benchmark

    benchmark = read_benchmark(command.results)
    if command.title is not None:
        benchmark = replace(benchmark, title=command.title)
    text = _document(benchmark, command)
    folder = command.results if command.results.is_dir() else command.results.parent
    out = command.out or (folder / "report.html" if command.format == "html" else None)
    if out is None:
        print(text, end="")
        return 0
    _write_whole(out, text)
    print(f"report:  {out}")
    return 0


def _document(benchmark: "Benchmark", command: ReportCommand) -> str:
    """Return the benchmark in the format that is wanted."""
    if command.format == "html":
        from dronevio.eval.report.benchmark.page import benchmark_page

        return benchmark_page(benchmark)

    from dronevio.eval.report.benchmark.model import MAIN_MEASURES, measure
    from dronevio.eval.report.benchmark.tables import as_csv, as_latex, as_markdown

    render = {"markdown": as_markdown, "latex": as_latex, "csv": as_csv}[command.format]
    chosen = tuple(map(measure, command.measures))
    usual = tuple(m for m in benchmark.measures if command.format == "csv" or m.column in MAIN_MEASURES)
    return render(benchmark, chosen or usual)


def _write_whole(path: Path, text: str) -> None:
    """Write a file that is there whole or not at all.

    Raises:
        InputError: It cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, beside = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        try:
            with os.fdopen(handle, "w", encoding="utf-8", newline="") as file:
                file.write(text)
            Path(beside).chmod(0o644)
            Path(beside).replace(path)
        except BaseException:
            Path(beside).unlink(missing_ok=True)
            raise
    except OSError as error:
        raise InputError(path, f"it cannot be written ({error.strerror})", "the name of a file to make") from error
