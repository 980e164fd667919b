"""The page of a benchmark: who is best and how sure, then every scenario, every run, and what failed."""

from collections import Counter
from functools import partial
from html import escape
from pathlib import Path

from dronevio.eval.metrics import nees_bounds
from dronevio.eval.report.benchmark import plots as drawn
from dronevio.eval.report.benchmark.model import Benchmark, Measure, measure
from dronevio.eval.report.benchmark.tables import READING, failure_table, measure_table, spread_text
from dronevio.eval.report.tables import Cell, Table, html_table
from dronevio.eval.report.templating import (
    DASH,
    Tile,
    details,
    document,
    drawing,
    figures,
    folds,
    section,
    settings,
    tiles,
)

ATE, DRIFT, NEES = measure("ate_m"), measure("drift_percent"), measure("nees_position")
OPENED = ("ate_m", "drift_percent")  # tables that are not folded away
RUN_COLUMNS = ("ate_m", "rpe_m", "drift_percent", "coverage_percent", "nees_position", "cpu_ms_mean", "wall_s")
_MOST_RUNS = 2000  # in the list of all runs: a page of more would be slow
_GRAPH_IN, _ROW_IN, _FRAME_IN = 2.9, 0.15, 1.1  # heights: a drawing; one row of dots, and what is around the rows
_SCRIPT = Path(__file__).parents[1] / "templates" / "report.js"


def benchmark_page(benchmark: Benchmark) -> str:
    """Return the page as HTML."""
    return document(
        benchmark.title,
        _summary(benchmark),
        (
            section("", _verdict(benchmark)),
            section("By scenario", _measures(benchmark)),
            section("Every run", _runs(benchmark)),
            section("By length of the way", _lengths(benchmark)),
            section("Consistency", _consistency(benchmark)),
            section("Cost", _cost(benchmark)),
            section("Runs that failed", _failures(benchmark)),
            section("How it was made", _origin(benchmark)),
        ),
        script=_SCRIPT.read_text(encoding="utf-8"),
    )


def _summary(benchmark: Benchmark) -> str:
    """Return what was done, in a sentence."""
    seeds = {row.seed for row in benchmark.rows}
    parts = (
        _count(len(benchmark.scenarios), "scenario"),
        _count(len(benchmark.estimators), "estimator"),
        _count(len(seeds), "seed"),
    )
    statuses = Counter[str](row.status for row in benchmark.rows if row.status != "ok")
    ended = f"{len(benchmark.rows) - statuses.total()} gave a result"
    how = (("failed", "failed"), ("timeout", "timed out"), ("crashed", "crashed"))
    bad = [f"{statuses[status]} {words}" for status, words in how if statuses[status]]
    return f"{_count(len(benchmark.rows), 'run')}, {' × '.join(parts)}: {', '.join([ended, *bad])}."


def _verdict(benchmark: Benchmark) -> str:
    """Return a card for each estimator, and in words which is best."""
    wins = benchmark.wins(ATE)
    words = ""
    if wins:
        ranks = [f"{name} in {wins[name]}" for name in sorted(wins, key=lambda name: (-wins[name], name))]
        of = _count(len(benchmark.scenarios), "scenario")
        words = f"<p>Who has the smallest median ATE, of {of}: {escape(', '.join(ranks))}. {READING}</p>"
    cards = tiles((_card(benchmark, name) for name in benchmark.estimators), "cards")
    return cards + (words or f"<p>{READING}</p>")


def _card(benchmark: Benchmark, estimator: str) -> Tile:
    runs = benchmark.runs(estimator)
    scored = sum(row.status == "ok" for row in runs)
    notes = [f"{scored} of {_count(len(runs), 'run')} gave a result"]
    for what, text in (
        (DRIFT, "drift {} % of the way"),
        (measure("coverage_percent"), "coverage {} %"),
        (measure("cpu_ms_mean"), "{} ms a frame"),
    ):
        found = benchmark.spread(what, estimator)
        notes += [] if found is None else [text.format(what.text(found.median))]
    found = benchmark.spread(ATE, estimator)
    value = DASH if found is None else ATE.text(found.median)
    spread = "" if found is None else f" {spread_text(ATE, found)}"
    colour = drawn.colour_of(benchmark, estimator)
    return Tile(estimator, value, "m", "\n".join((f"median ATE{spread}", *notes)), colour)


def _measures(benchmark: Benchmark) -> str:
    """Return a table for each measure, the main ones open."""
    ordered = sorted(benchmark.measures, key=lambda what: what.column not in OPENED)
    return folds(
        details(what.heading, html_table(measure_table(benchmark, what)), opened=what.column in OPENED)
        for what in ordered
    )


def _runs(benchmark: Benchmark) -> str:
    """Return drawings with a dot for each run, and the list of runs."""
    shown = [what for what in (ATE, DRIFT) if what in benchmark.measures]
    dots = (_dots(benchmark, what, what.title) for what in shown)
    words = "<p>A dot is a run, a bar the median; runs that failed stand on the right.</p>" if shown else ""
    table = _run_table(benchmark)
    listed = (
        details(f"All {_count(len(benchmark.rows), 'run')}", html_table(table))
        if len(benchmark.rows) <= _MOST_RUNS
        else f"<p>The list of all {len(benchmark.rows)} runs is left out of this page.</p>"
    )
    return words + figures(dots) + listed


def _dots(benchmark: Benchmark, what: Measure, title: str, expected: tuple[float, float] | None = None) -> str:
    height = _FRAME_IN + _ROW_IN * len(benchmark.scenarios) * max(2, len(benchmark.estimators))
    draw = partial(drawn.draw_runs, benchmark=benchmark, measure=what, title=title, expected=expected)
    medians = ((name, benchmark.spread(what, name)) for name in benchmark.telling(what))
    alt = ", ".join(f"{name} {what.text(found.median)}" for name, found in medians if found is not None)
    return drawing(height, draw, f"{what.heading} of every run; medians {alt}")


def _lengths(benchmark: Benchmark) -> str:
    """Return errors by length of the way: over all scenarios, and folded away those of each."""
    if not any(row.length_m for row in benchmark.rows):
        return ""

    def pair(scenario: str | None) -> str:
        return figures(
            drawing(_GRAPH_IN, partial(drawn.draw_lengths, benchmark=benchmark, scenario=scenario, kind=kind))
            for kind in ("position", "orientation")
        )

    flown = [name for name in benchmark.scenarios if any(r.length_m for r in benchmark.rows if r.scenario == name)]
    words = (
        "<p>Each run gives one error (r.m.s.) for each length; boxes show the runs that gave a result: median,"
        " quartiles, and whiskers from the 5th to the 95th percentile.</p>"
    )
    each = folds(details(name, pair(name)) for name in flown) if len(benchmark.scenarios) > 1 else ""
    return words + pair(None) + each


def _consistency(benchmark: Benchmark) -> str:
    if NEES not in benchmark.measures:
        return ""
    low, high = nees_bounds(3)
    words = (
        "<p>Mean squared error in units of the covariance that the estimator claims (NEES). An honest one has 3; at one"
        f" instant, 95 % of runs lie between {low:.2f} and {high:.2f} (grey). More is overconfident.</p>"
    )
    return words + figures(
        _dots(benchmark, what, what.title, (low, high)) for what in benchmark.measures if what.column.startswith("nees")
    )


def _cost(benchmark: Benchmark) -> str:
    if all(row.cpu_ms_mean is None for row in benchmark.rows):
        return ""
    return figures(
        (
            drawing(_GRAPH_IN, partial(drawn.draw_costs, benchmark=benchmark)),
            drawing(_GRAPH_IN, partial(drawn.draw_cost_histogram, benchmark=benchmark)),
        )
    )


def _failures(benchmark: Benchmark) -> str:
    table = failure_table(benchmark)
    return html_table(table) if table.rows else "<p>None.</p>"


def _run_table(benchmark: Benchmark) -> Table:
    shown = [what for what in benchmark.measures if what.column in RUN_COLUMNS]
    rows = []
    for row in benchmark.rows:
        seed = Cell(DASH if row.seed is None else str(row.seed), order=-1.0 if row.seed is None else float(row.seed))
        status = Cell("ok") if row.status == "ok" else Cell("", warning=row.status)
        values = (what.of(row) if row.status == "ok" else None for what in shown)
        cells = (
            Cell(DASH, order=float("inf")) if v is None else Cell(what.text(v), order=v)
            for what, v in zip(shown, values, strict=True)
        )
        rows.append((Cell(row.scenario), seed, Cell(row.estimator), status, *cells))
    columns = ("scenario", "seed", "estimator", "status", *(what.heading for what in shown))
    return Table("All runs", columns, tuple(rows), words=frozenset((2, 3)))


def _origin(benchmark: Benchmark) -> str:
    """Return what the results depend on: settings, versions and machine of each estimator, and the recordings."""
    made = {}
    for estimator in benchmark.estimators:
        runs = benchmark.runs(estimator)
        made[estimator] = {
            "settings (hash)": sorted({row.config_hash for row in runs}),
            "versions": sorted({row.versions for row in runs}),
            "machine": sorted({row.machine for row in runs if row.machine}),
        }
    recordings = {row.recording for row in benchmark.rows if row.recording}
    worlds = sorted({row.world for row in benchmark.rows if row.world})
    flown = {"scenarios": benchmark.scenarios, "worlds": worlds, "recordings": f"{len(recordings)} different ones"}
    tables = {"Estimators": made, "Flights": flown}
    return "".join(details(title, settings(content), opened=title == "Estimators") for title, content in tables.items())


def _count(n: int, name: str) -> str:
    return f"{n} {name}{'' if n == 1 else 's'}"
