"""The page of a benchmark: who is best and how sure, then every scenario, every run, and what failed."""

from collections import Counter
from functools import partial

from markupsafe import Markup

from dronevio.eval.metrics import nees_bounds
from dronevio.eval.report.benchmark import plots as drawn
from dronevio.eval.report.benchmark.model import Benchmark, Measure, measure
from dronevio.eval.report.benchmark.tables import READING, failure_table, measure_table, spread_text
from dronevio.eval.report.figures import drawing
from dronevio.eval.report.tables import DASH, Cell, Table
from dronevio.eval.report.templating import Tile, render_page

ATE, DRIFT, NEES = measure("ate_m"), measure("drift_percent"), measure("nees_position")
OPENED = ("ate_m", "drift_percent")  # tables that are not folded away
RUN_COLUMNS = ("ate_m", "rpe_m", "drift_percent", "coverage_percent", "nees_position", "cpu_ms_mean", "wall_s")
_MOST_RUNS = 2000  # in the list of all runs: a page of more would be slow
_GRAPH_IN, _ROW_IN, _FRAME_IN = 2.9, 0.15, 1.1  # heights: a drawing; one row of dots, and what is around the rows


def benchmark_page(benchmark: Benchmark) -> str:
    """Return the page as HTML."""
    listed = len(benchmark.rows) <= _MOST_RUNS
    return render_page(
        "benchmark.html.j2",
        benchmark.title,
        _summary(benchmark),
        script="report.js",
        cards=[_card(benchmark, name) for name in benchmark.estimators],
        ranking=_ranking(benchmark),
        scenario_count=_count(len(benchmark.scenarios), "scenario"),
        reading=READING,
        measures=_measures(benchmark),
        dots=[_dots(benchmark, what, what.title) for what in (ATE, DRIFT) if what in benchmark.measures],
        run_count=_count(len(benchmark.rows), "run"),
        run_table=_run_table(benchmark) if listed else None,
        lengths=_length_drawings(benchmark, None),
        lengths_by_scenario=_lengths_by_scenario(benchmark),
        consistency=_consistency(benchmark),
        cost=_cost_drawings(benchmark),
        failures=failure_table(benchmark),
        provenance=_provenance(benchmark),
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


def _ranking(benchmark: Benchmark) -> str:
    """Return in how many scenarios each estimator is the best, in words."""
    wins = benchmark.wins(ATE)
    return ", ".join(f"{name} in {wins[name]}" for name in sorted(wins, key=lambda name: (-wins[name], name)))


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


def _measures(benchmark: Benchmark) -> list[tuple[str, Table, bool]]:
    """Return heading and table of each measure, and whether it is opened: the main ones."""
    ordered = sorted(benchmark.measures, key=lambda what: what.column not in OPENED)
    return [(what.heading, measure_table(benchmark, what), what.column in OPENED) for what in ordered]


def _dots(benchmark: Benchmark, what: Measure, title: str, expected: tuple[float, float] | None = None) -> Markup:
    height = _FRAME_IN + _ROW_IN * len(benchmark.scenarios) * max(2, len(benchmark.estimators))
    draw = partial(drawn.draw_runs, benchmark=benchmark, measure=what, title=title, expected=expected)
    medians = ((name, benchmark.spread(what, name)) for name in benchmark.telling(what))
    alt = ", ".join(f"{name} {what.text(found.median)}" for name, found in medians if found is not None)
    return drawing(height, draw, f"{what.heading} of every run; medians {alt}")


def _length_drawings(benchmark: Benchmark, scenario: str | None) -> list[Markup]:
    """Return the errors by length of the way in one scenario or over all; none where no run has any."""
    if not any(row.length_m for row in benchmark.rows if scenario in (None, row.scenario)):
        return []
    return [
        drawing(_GRAPH_IN, partial(drawn.draw_lengths, benchmark=benchmark, scenario=scenario, kind=kind))
        for kind in ("position", "orientation")
    ]


def _lengths_by_scenario(benchmark: Benchmark) -> list[tuple[str, list[Markup]]]:
    """Return the errors by length of the way in each scenario, where there are several."""
    scenarios = benchmark.scenarios if len(benchmark.scenarios) > 1 else ()
    drawings = ((name, _length_drawings(benchmark, name)) for name in scenarios)
    return [(name, found) for name, found in drawings if found]


def _consistency(benchmark: Benchmark) -> dict[str, object] | None:
    """Return the NEES of every run as drawings, and its bounds; None where no run has any."""
    if NEES not in benchmark.measures:
        return None
    low, high = nees_bounds(3)
    measures = (what for what in benchmark.measures if what.column.startswith("nees"))
    return {
        "low": low,
        "high": high,
        "drawings": [_dots(benchmark, what, what.title, (low, high)) for what in measures],
    }


def _cost_drawings(benchmark: Benchmark) -> list[Markup]:
    if all(row.cpu_ms_mean is None for row in benchmark.rows):
        return []
    return [
        drawing(_GRAPH_IN, partial(draw, benchmark=benchmark)) for draw in (drawn.draw_costs, drawn.draw_cost_histogram)
    ]


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


def _provenance(benchmark: Benchmark) -> list[tuple[str, object, bool]]:
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
    return [("Estimators", made, True), ("Flights", flown, False)]


def _count(n: int, name: str) -> str:
    return f"{n} {name}{'' if n == 1 else 's'}"
