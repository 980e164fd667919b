"""The page of a benchmark: overview, results by scenario, all runs, consistency, cost, failures and provenance."""

import math
from collections import Counter
from functools import partial

from markupsafe import Markup

from dronevio.eval.benchmark.metrics import METRICS
from dronevio.eval.benchmark.outcomes import MAX_SIGMAS
from dronevio.eval.benchmark.summary import known_values
from dronevio.eval.metrics import nees_bounds
from dronevio.eval.metrics.metric import DASH, Metric
from dronevio.eval.report.benchmark import plots
from dronevio.eval.report.benchmark.model import BenchmarkResults
from dronevio.eval.report.benchmark.overview import (
    LOOP_NOTE,
    SUMMARY_NOTE,
    consistency_table,
    loop_table,
    start_table,
    summary_table,
)
from dronevio.eval.report.benchmark.tables import (
    NOTE,
    failure_table,
    loss_table,
    measure_table,
    outcome_table,
    quartile_range,
    run_table,
)
from dronevio.eval.report.figures import svg_plot
from dronevio.eval.report.tables import Table
from dronevio.eval.report.templating import Tile, render_page

ATE, DRIFT, NEES = METRICS["ate_m"], METRICS["drift_percent"], METRICS["nees_position"]
OPEN_MEASURES = ("ate_m", "drift_percent")
"""Names of the metrics whose tables are open when the page is loaded, beside those of the user."""
_MAX_NARROW_COLUMNS = 3  # estimators of a table that takes half of a wide page
_MAX_LISTED_RUNS = 2000  # a page with a longer list is slow
_PLOT_HEIGHT_IN = 2.9
_ROW_HEIGHT_IN, _ROW_MARGIN_IN = 0.15, 1.1  # of one row of dots, and around all rows


def benchmark_page(results: BenchmarkResults) -> str:
    """Return the page as HTML."""
    listed, losses = len(results.rows) <= _MAX_LISTED_RUNS, loss_table(results)
    return render_page(
        "benchmark.html.j2",
        results.title,
        _summary(results),
        script="report.js",
        cards=[_card(results, name) for name in results.ranking],
        wins=_wins(results),
        scenario_count=_count(len(results.scenarios), "scenario"),
        note=NOTE,
        outcomes=_outcomes(results),
        summary=summary_table(results),
        summary_note=SUMMARY_NOTE,
        starts=start_table(results),
        loops=loop_table(results) if known_values(results.rows, "loops") else None,
        loop_note=LOOP_NOTE,
        measures=_measure_tables(results),
        many_columns=len(results.estimators) > _MAX_NARROW_COLUMNS,
        run_plots=[_run_plot(results, m) for m in (ATE, DRIFT) if m in results.measures],
        run_count=_count(len(results.rows), "run"),
        run_table=run_table(results) if listed else None,
        sub_trajectory_plots=_sub_trajectory_plots(results, None),
        sub_trajectory_plots_by_scenario=_sub_trajectory_plots_by_scenario(results),
        consistency=_consistency(results),
        cost_plots=_cost_plots(results),
        losses=losses if len(losses.rows) <= _MAX_LISTED_RUNS else None,
        max_sigmas=f"{MAX_SIGMAS:g}",
        failures=failure_table(results),
        provenance=_provenance(results),
    )


def _summary(results: BenchmarkResults) -> str:
    """Return the numbers of runs, scenarios, estimators and seeds, and how the runs ended, as a sentence."""
    seeds = {row.seed for row in results.rows}
    factors = (
        _count(len(results.scenarios), "scenario"),
        _count(len(results.estimators), "estimator"),
        _count(len(seeds), "seed"),
    )
    statuses = Counter[str](row.status for row in results.rows if row.status != "ok")
    scored = f"{len(results.rows) - statuses.total()} with scores"
    endings = (("failed", "failed"), ("timeout", "timed out"), ("crashed", "crashed"))
    others = [f"{statuses[status]} {words}" for status, words in endings if statuses[status]]
    return f"{_count(len(results.rows), 'run')}, {' × '.join(factors)}: {', '.join([scored, *others])}."


def _outcomes(results: BenchmarkResults) -> dict[str, object] | None:
    """Return the table of expected outcomes with the number of runs that have them; None without expectations."""
    if not results.verdicts:
        return None
    passed = sum(verdict.passed for verdict in results.verdicts)
    return {"table": outcome_table(results), "passed": passed, "runs": len(results.verdicts), "sigmas": MAX_SIGMAS}


def _wins(results: BenchmarkResults) -> list[tuple[str, int]]:
    """Return each estimator with the number of scenarios in which it has the smallest median ATE, best first."""
    return sorted(results.wins(ATE).items(), key=lambda item: (-item[1], item[0]))


def _card(results: BenchmarkResults, estimator: str) -> Tile:
    """Return the main results of an estimator over all scenarios."""
    runs = results.runs(estimator)
    scored = sum(row.status == "ok" for row in runs)
    notes = [f"{scored} of {_count(len(runs), 'run')} with scores"]
    for metric, text in (
        (DRIFT, "drift {} % of the path length"),
        (METRICS["coverage_percent"], "coverage {} %"),
        (METRICS["cpu_ms_mean"], "{} ms per frame"),
    ):
        quartiles = results.quartiles(metric, estimator)
        notes += [] if quartiles is None else [text.format(metric.compared_text(quartiles.median))]
    quartiles = results.quartiles(ATE, estimator)
    value = DASH if quartiles is None else ATE.compared_text(quartiles.median)
    ate_range = "" if quartiles is None else f" {quartile_range(ATE, quartiles)}"
    colour = plots.colour_of(results, estimator)
    unit = ATE.unit if quartiles is not None and math.isfinite(quartiles.median) else ""
    return Tile(estimator, value, unit, "\n".join((f"median ATE{ate_range}", *notes)), colour)


def _measure_tables(results: BenchmarkResults) -> list[tuple[str, Table, bool]]:
    """Return heading and table of each measure, and whether it is open; open ones come first."""
    opened = results.measures_named(OPEN_MEASURES)
    closed = (metric for metric in results.measures if metric not in opened)
    return [(m.heading, measure_table(results, m), m in opened) for m in (*opened, *closed)]


def _run_plot(results: BenchmarkResults, metric: Metric, expected: tuple[float, float] | None = None) -> Markup:
    """Return a plot with a dot for each run, and with the medians as its description."""
    height = _ROW_MARGIN_IN + _ROW_HEIGHT_IN * len(results.scenarios) * max(2, len(results.estimators))
    draw = partial(plots.draw_runs, results=results, metric=metric, title=metric.compared_title, expected=expected)
    spreads = ((name, results.quartiles(metric, name)) for name in results.estimators_with(metric))
    medians = ", ".join(f"{name} {metric.compared_text(q.median)}" for name, q in spreads if q is not None)
    return svg_plot(height, draw, f"{metric.heading} of every run; medians {medians}")


def _sub_trajectory_plots(results: BenchmarkResults, scenario: str | None) -> list[Markup]:
    """Return plots of relative errors in one scenario, or in all if it is None; none if no run has such errors."""
    if not any(row.sub_trajectory_m for row in results.rows if scenario in (None, row.scenario)):
        return []
    kinds: tuple[plots.Kind, ...] = ("position", "orientation")
    return [
        svg_plot(
            _PLOT_HEIGHT_IN,
            partial(plots.draw_sub_trajectory_errors, results=results, scenario=scenario, kind=kind),
        )
        for kind in kinds
    ]


def _sub_trajectory_plots_by_scenario(results: BenchmarkResults) -> list[tuple[str, list[Markup]]]:
    """Return name and plots of each scenario that has such errors, if there are several scenarios."""
    scenarios = results.scenarios if len(results.scenarios) > 1 else ()
    plots_of = {name: _sub_trajectory_plots(results, name) for name in scenarios}
    return [(name, drawn) for name, drawn in plots_of.items() if drawn]


def _consistency(results: BenchmarkResults) -> dict[str, object] | None:
    """Return the bounds of the NEES and its plots; None if no run has a NEES."""
    if NEES not in results.measures:
        return None
    low, high = nees_bounds(3)
    measures = (metric for metric in results.measures if metric.name.startswith("nees"))
    table = consistency_table(results)
    return {
        "low": low,
        "high": high,
        "table": table,
        "plots": [_run_plot(results, metric, (low, high)) for metric in measures],
    }


def _cost_plots(results: BenchmarkResults) -> list[Markup]:
    if not known_values(results.rows, "cpu_ms_mean"):
        return []
    draw = (plots.draw_costs, plots.draw_cost_histogram)
    return [svg_plot(_PLOT_HEIGHT_IN, partial(function, results=results)) for function in draw]


def _provenance(results: BenchmarkResults) -> list[tuple[str, object, bool]]:
    """Return title and content of the tables on which the results depend, and whether each is open."""
    estimators = {}
    for estimator in results.estimators:
        runs = results.runs(estimator)
        estimators[estimator] = {
            "settings (hash)": sorted({row.config_hash for row in runs}),
            "versions": sorted({row.versions for row in runs}),
            "machine": sorted({row.machine for row in runs if row.machine}),
        }
    recordings = {row.recording_hash for row in results.rows if row.recording_hash}
    worlds = sorted({row.world for row in results.rows if row.world})
    flights = {"scenarios": results.scenarios, "worlds": worlds, "recordings": f"{len(recordings)} different ones"}
    return [("Estimators", estimators, True), ("Flights", flights, False)]


def _count(n: int, name: str) -> str:
    return f"{n} {name}{'' if n == 1 else 's'}"
