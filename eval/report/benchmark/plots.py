"""Plots of a benchmark: one dot per run, errors by sub-trajectory length, and processor time per frame.

Each function draws into axes that it is given. Estimators differ in colour and in marker.
"""

import math
from collections.abc import Iterable, Iterator
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from dronevio.eval import colours
from dronevio.eval.benchmark.rows import Row
from dronevio.eval.benchmark.summary import known_values
from dronevio.eval.metrics.metric import FAILED, Metric
from dronevio.eval.report.benchmark.model import BenchmarkResults, value_of
from dronevio.eval.report.figures import GRID, INK, Boxes, draw_boxes, set_log_scale
from dronevio.models.arrays import Array

Kind = Literal["position", "orientation"]
"""Kind of relative errors."""

MARKERS = "os^DvpP"  # one more than colours: no two estimators share both
_MAX_NAME_LENGTH = 22  # characters that fit beside a plot
_MAX_DECADES = 6.0  # of a logarithmic axis, below the largest value
_MAX_DOTS = 60  # of one estimator in one scenario; of more runs, evenly spaced quantiles are drawn
_WIDE_RANGE = 30.0  # largest over smallest value from which on an axis is logarithmic


def colour_of(results: BenchmarkResults, estimator: str) -> str:
    """Return the colour of an estimator in all plots of a benchmark."""
    return colours.ESTIMATORS[results.estimators.index(estimator) % len(colours.ESTIMATORS)]


def marker_of(results: BenchmarkResults, estimator: str) -> str:
    """Return the marker of an estimator in all plots of a benchmark."""
    return MARKERS[results.estimators.index(estimator) % len(MARKERS)]


def draw_runs(
    ax: Axes, results: BenchmarkResults, metric: Metric, title: str, expected: tuple[float, float] | None = None
) -> None:
    """Draw a dot for each run and a bar at each median, with a row per scenario and a column for failed runs.

    Args:
        ax: Axes to draw into.
        results: The runs.
        metric: The figure on the logarithmic x axis.
        title: Title of the plot.
        expected: Range in which runs are expected, drawn as a band; None for none.
    """
    low, high = _limits(results, metric, expected or ())
    failed_x = high * (high / low) ** 0.06
    if expected is not None:
        ax.axvspan(*expected, color=colours.SURROUNDINGS, alpha=0.18, linewidth=0.0)
        ax.axvline(3.0, color=INK, linewidth=0.8, linestyle="--")
    estimators = results.estimators_with(metric)
    step = 0.76 / max(len(estimators), 2)
    for i, estimator in enumerate(estimators):
        colour, marker = colour_of(results, estimator), marker_of(results, estimator)
        offset = (i - 0.5 * (len(estimators) - 1)) * step
        for k, scenario in enumerate(results.scenarios):
            quartiles = results.quartiles(metric, estimator, scenario)
            if quartiles is None:
                continue
            values = [v for row in results.runs(estimator, scenario) if (v := value_of(metric, row)) is not None]
            _draw_dots(ax, k + offset, np.clip(values, low, None), failed_x, colour, marker, step)
            x = failed_x if math.isinf(quartiles.median) else max(quartiles.median, low)
            ax.plot([x, x], [k + offset - 0.4 * step, k + offset + 0.4 * step], color=INK, linewidth=1.4)
        ax.plot([], [], marker, color=colour, markersize=4.0, linestyle="none", label=_shortened(estimator))
    set_log_scale(ax, "x", low, high * (high / low) ** 0.12)
    _label_scenarios(ax, results)
    if any(row.status != "ok" for row in results.rows) and metric.counts_failed:
        ax.axvline(high * (high / low) ** 0.02, color=GRID, linewidth=1.2)
        ax.text(failed_x, -0.75, FAILED, ha="center", va="bottom", fontsize=8.0)
    ax.set_title(title)
    ax.set_xlabel(metric.heading)


def draw_sub_trajectory_errors(ax: Axes, results: BenchmarkResults, scenario: str | None, kind: Kind) -> None:
    """Draw the relative errors of runs by sub-trajectory length, with a box per estimator.

    Args:
        ax: Axes to draw into.
        results: The runs; those without scores are left out.
        scenario: Scenario of the runs; None for all scenarios, with lengths as shares of the path.
        kind: Errors of the position in % of the length, or of the orientation in degrees.
    """
    runs = results.rows if scenario is None else [r for r in results.rows if r.scenario == scenario]
    indices = sorted({index for row in runs for index in range(len(row.sub_trajectory_m))})
    boxes = [
        Boxes(
            _shortened(estimator),
            colour_of(results, estimator),
            [np.array(list(_errors(results.runs(estimator, scenario), index, kind))) for index in indices],
        )
        for estimator in results.estimators
    ]
    draw_boxes(ax, [_length_label(runs, index, scenario is None) for index in indices], boxes)
    _use_log_scale_if_wide(ax, boxes)
    lengths = "share of the path length [%]" if scenario is None else "length of the sub-trajectory [m]"
    ax.set(xlabel=lengths, ylabel="error [% of the length]" if kind == "position" else "error [°]")
    ax.set_title(f"Relative {kind} error" + ("" if scenario is None else f", {_shortened(scenario)}"))


def draw_costs(ax: Axes, results: BenchmarkResults) -> None:
    """Draw mean and 99th percentile of the processor time per frame over the runs of each estimator."""
    boxes = [
        Boxes(
            _shortened(estimator),
            colour_of(results, estimator),
            [_finite_values(runs, "cpu_ms_mean"), _finite_values(runs, "cpu_ms_p99")],
        )
        for estimator in results.estimators
        for runs in (results.runs(estimator),)
    ]
    draw_boxes(ax, ("mean of a run", "99th percentile of a run"), boxes)
    _use_log_scale_if_wide(ax, boxes)
    ax.set(title="Processor time per frame", ylabel="processor time [ms]")


def draw_cost_histogram(ax: Axes, results: BenchmarkResults) -> None:
    """Draw a histogram of the mean processor time per frame over runs."""
    costs = {estimator: _finite_values(results.runs(estimator), "cpu_ms_mean") for estimator in results.estimators}
    every = np.concatenate(list(costs.values()))
    low, high = float(every.min()), float(every.max())
    wide = low > 0.0 and high > _WIDE_RANGE * low
    edges = np.geomspace(low, high * 1.001, 31) if wide else np.linspace(0.0, max(high, 1e-9) * 1.001, 31)
    for estimator, values in costs.items():
        colour = colour_of(results, estimator)
        ax.hist(
            values,
            bins=edges.tolist(),
            color=f"{colour}66",
            edgecolor=colour,
            histtype="stepfilled",
            label=_shortened(estimator),
        )
    if wide:
        set_log_scale(ax, "x", 0.8 * low, 1.25 * high)
    ax.yaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set(
        title="Distribution of the processor time", xlabel="mean processor time per frame [ms]", ylabel="number of runs"
    )


def _draw_dots(ax: Axes, y: float, values: Array, failed_x: float, colour: str, marker: str, step: float) -> None:
    """Draw runs around a height, alternately shifted so that equal values do not cover each other."""
    ordered = np.sort(values)
    shown = ordered[np.unique(np.linspace(0, len(ordered) - 1, _MAX_DOTS).astype(int))] if len(ordered) else ordered
    shift = 0.22 * step * np.resize([-1.0, 0.0, 1.0], len(shown))
    failed = np.isinf(shown)
    style: dict[str, Any] = {
        "color": colour,
        "markersize": 3.4,
        "linestyle": "none",
        "markeredgewidth": 0.0,
        "alpha": 0.75,
    }
    ax.plot(shown[~failed], (y + shift)[~failed], marker, **style)
    ax.plot(np.full(failed.sum(), failed_x), (y + shift)[failed], "x", color=colour, markersize=3.6, linestyle="none")


def _use_log_scale_if_wide(ax: Axes, boxes: Iterable[Boxes]) -> None:
    """Make the y axis logarithmic if small boxes would vanish beside large ones."""
    drawn = [values for box in boxes for values in box.values if len(values)]
    low, high = (min((np.percentile(v, 5) for v in drawn), default=0.0), max((v.max() for v in drawn), default=0.0))
    if low > 0.0 and high > _WIDE_RANGE * low:
        set_log_scale(ax, "y", 0.8 * float(low), 1.25 * float(high))


def _limits(results: BenchmarkResults, metric: Metric, others: Iterable[float]) -> tuple[float, float]:
    """Return the limits of a logarithmic axis for all positive values of a metric, and for other values."""
    values = [v for row in results.rows if (v := value_of(metric, row)) is not None and 0.0 < v < math.inf]
    values += others
    high = max(values, default=1.0)
    low = max(min(values, default=0.1), high * 10.0**-_MAX_DECADES)
    margin = max((high / low) ** 0.04, 1.15)
    return low / margin, high * margin


def _label_scenarios(ax: Axes, results: BenchmarkResults) -> None:
    """Label the rows of a plot with the scenarios, from top to bottom."""
    n = len(results.scenarios)
    ax.set_yticks(range(n), [_shortened(scenario) for scenario in results.scenarios])
    ax.set_ylim(n - 0.5, -0.5)
    ax.grid(visible=False, axis="y")
    for edge in range(1, n):
        ax.axhline(edge - 0.5, color=GRID, linewidth=0.6)


def _errors(runs: Iterable[Row], index: int, kind: Kind) -> Iterator[float]:
    """Yield the errors of runs at one of their sub-trajectory lengths, of those runs that have it."""
    for row in runs:
        lengths_m = row.sub_trajectory_m
        values = row.sub_trajectory_rpe_m if kind == "position" else row.sub_trajectory_rpe_deg
        if row.status == "ok" and index < min(len(values), len(lengths_m)) and lengths_m[index] > 0.0:
            value = 100.0 * values[index] / lengths_m[index] if kind == "position" else values[index]
            if math.isfinite(value):
                yield value


def _length_label(runs: Iterable[Row], index: int, as_share: bool) -> str:
    """Return the label of a sub-trajectory length: the median over runs, in metres or as a share of the path [%]."""
    rows = [row for row in runs if index < len(row.sub_trajectory_m)]
    lengths_m = np.array([row.sub_trajectory_m[index] for row in rows])
    if as_share:
        paths_m = np.array([row["path_m"] or np.nan for row in rows])
        shares = 100.0 * (lengths_m / paths_m)[np.isfinite(paths_m)]
        return f"{np.median(shares):.0f}" if len(shares) else f"{index + 1}"
    return f"{np.median(lengths_m):.3g}"


def _finite_values(runs: Iterable[Row], metric: str) -> Array:
    values = np.array(known_values(runs, metric), dtype=np.float64)
    return values[np.isfinite(values)]


def _shortened(name: str) -> str:
    """Return a name on one line that fits beside a plot."""
    line = "".join(letter for letter in " ".join(name.split()) if letter.isprintable())
    return line if len(line) <= _MAX_NAME_LENGTH else f"{line[: _MAX_NAME_LENGTH - 1]}…"
