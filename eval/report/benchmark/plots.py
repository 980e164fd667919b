"""Pictures of a benchmark: every run as a dot, errors by length of the way, and what frames cost.

Each function draws into axes that it is given. Estimators are told apart by colour and by mark.
"""

import math
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from dronevio.eval import style as palette
from dronevio.eval.benchmark.rows import Row
from dronevio.eval.report.benchmark.model import FAILED, Benchmark, Measure
from dronevio.eval.report.figures import GRID, INK, Boxes, draw_boxes, set_log_scale

Array = npt.NDArray[np.float64]

MARKS = "os^DvpP"  # one more than colours: no two estimators have both in common
_LONGEST_NAME = 22  # letters that fit beside a drawing
_DECADES = 6.0  # that a logarithmic axis shows at most, below the largest value
_MOST_DOTS = 60  # runs of one estimator in one scenario: more than that are told by the quartiles
_WIDE_RANGE = 30.0  # largest over smallest from which on an axis is logarithmic


def colour_of(benchmark: Benchmark, estimator: str) -> str:
    """Return the colour of an estimator in all pictures of a benchmark."""
    return palette.ESTIMATORS[benchmark.estimators.index(estimator) % len(palette.ESTIMATORS)]


def mark_of(benchmark: Benchmark, estimator: str) -> str:
    """Return the mark of an estimator's runs in all pictures of a benchmark."""
    return MARKS[benchmark.estimators.index(estimator) % len(MARKS)]


def draw_runs(
    ax: Axes, benchmark: Benchmark, measure: Measure, title: str, expected: tuple[float, float] | None = None
) -> None:
    """Draw a dot for each run, a row for each scenario, a bar at the median; failed runs in a column of their own.

    Args:
        ax: Where to draw.
        benchmark: The runs.
        measure: What is drawn, on a logarithmic axis.
        title: Of the picture.
        expected: Between what runs are expected to be, if that is known.
    """
    low, high = _limits(benchmark, measure, expected or ())
    failed_at = high * (high / low) ** 0.06
    if expected is not None:
        ax.axvspan(*expected, color=palette.ROOM, alpha=0.18, linewidth=0.0)
        ax.axvline(3.0, color=INK, linewidth=0.8, linestyle="--")
    estimators = benchmark.telling(measure)
    step = 0.76 / max(len(estimators), 2)
    for i, estimator in enumerate(estimators):
        colour, mark = colour_of(benchmark, estimator), mark_of(benchmark, estimator)
        shift = (i - 0.5 * (len(estimators) - 1)) * step
        for k, scenario in enumerate(benchmark.scenarios):
            spread = benchmark.spread(measure, estimator, scenario)
            if spread is None:
                continue
            values = [v for row in benchmark.runs(estimator, scenario) if (v := measure.of(row)) is not None]
            _draw_dots(ax, k + shift, np.clip(values, low, None), failed_at, colour, mark, step)
            at = failed_at if math.isinf(spread.median) else max(spread.median, low)
            ax.plot([at, at], [k + shift - 0.4 * step, k + shift + 0.4 * step], color=INK, linewidth=1.4)
        ax.plot([], [], mark, color=colour, markersize=4.0, linestyle="none", label=_short(estimator))
    set_log_scale(ax, "x", low, high * (high / low) ** 0.12)
    _name_scenarios(ax, benchmark)
    if any(row.status != "ok" for row in benchmark.rows) and measure.counts_failed:
        ax.axvline(high * (high / low) ** 0.02, color=GRID, linewidth=1.2)
        ax.text(failed_at, -0.75, FAILED, ha="center", va="bottom", fontsize=8.0)
    ax.set_title(title)
    ax.set_xlabel(measure.heading)


def draw_lengths(ax: Axes, benchmark: Benchmark, scenario: str | None, kind: str) -> None:
    """Draw the errors of runs by length of sub-trajectories, a box for each estimator.

    Args:
        ax: Where to draw.
        benchmark: The runs; those without a result have nothing to show here.
        scenario: Which runs; None for those of all scenarios, by share of the way.
        kind: ``position``, in % of the length, or ``orientation``, in degrees.
    """
    runs = benchmark.rows if scenario is None else [r for r in benchmark.rows if r.scenario == scenario]
    places = sorted({place for row in runs for place in range(len(row.length_m))})
    boxes = [
        Boxes(
            _short(estimator),
            colour_of(benchmark, estimator),
            [np.array(list(_errors(benchmark.runs(estimator, scenario), place, kind))) for place in places],
        )
        for estimator in benchmark.estimators
    ]
    draw_boxes(ax, [_length_name(runs, place, scenario is None) for place in places], boxes)
    _spread_out(ax, boxes)
    where = "share of the way [%]" if scenario is None else "length of the sub-trajectory [m]"
    ax.set(xlabel=where, ylabel="error [% of the length]" if kind == "position" else "error [°]")
    ax.set_title(f"Relative {kind} error" + ("" if scenario is None else f", {_short(scenario)}"))


def draw_costs(ax: Axes, benchmark: Benchmark) -> None:
    """Draw how much processor time frames cost, over the runs of each estimator."""
    boxes = [
        Boxes(
            _short(estimator),
            colour_of(benchmark, estimator),
            [_known(runs, "cpu_ms_mean"), _known(runs, "cpu_ms_p99")],
        )
        for estimator in benchmark.estimators
        for runs in (benchmark.runs(estimator),)
    ]
    draw_boxes(ax, ("mean of a run", "99 % of its frames under"), boxes)
    _spread_out(ax, boxes)
    ax.set(title="Processor time a frame", ylabel="processor time [ms]")


def draw_cost_histogram(ax: Axes, benchmark: Benchmark) -> None:
    """Draw how many runs cost how much a frame."""
    costs = {estimator: _known(benchmark.runs(estimator), "cpu_ms_mean") for estimator in benchmark.estimators}
    every = np.concatenate(list(costs.values()))
    low, high = float(every.min()), float(every.max())
    wide = low > 0.0 and high > _WIDE_RANGE * low
    edges = np.geomspace(low, high * 1.001, 31) if wide else np.linspace(0.0, max(high, 1e-9) * 1.001, 31)
    for estimator, values in costs.items():
        colour = colour_of(benchmark, estimator)
        ax.hist(
            values,
            bins=edges.tolist(),
            color=f"{colour}66",
            edgecolor=colour,
            histtype="stepfilled",
            label=_short(estimator),
        )
    if wide:
        set_log_scale(ax, "x", 0.8 * low, 1.25 * high)
    ax.yaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set(title="Processor time: how often", xlabel="mean processor time a frame [ms]", ylabel="number of runs")


def _draw_dots(ax: Axes, y: float, values: Array, failed_at: float, colour: str, mark: str, step: float) -> None:
    """Draw runs around a height, spread a little so that equal ones do not hide each other."""
    ordered = np.sort(values)
    shown = ordered[np.unique(np.linspace(0, len(ordered) - 1, _MOST_DOTS).astype(int))] if len(ordered) else ordered
    sway = 0.22 * step * np.resize([-1.0, 0.0, 1.0], len(shown))
    failed = np.isinf(shown)
    style: dict[str, Any] = {
        "color": colour,
        "markersize": 3.4,
        "linestyle": "none",
        "markeredgewidth": 0.0,
        "alpha": 0.75,
    }
    ax.plot(shown[~failed], (y + sway)[~failed], mark, **style)
    ax.plot(np.full(failed.sum(), failed_at), (y + sway)[failed], "x", color=colour, markersize=3.6, linestyle="none")


def _spread_out(ax: Axes, boxes: Iterable[Boxes]) -> None:
    """Make the axis logarithmic where small boxes could not be told from nothing beside large ones."""
    drawn = [values for box in boxes for values in box.values if len(values)]
    low, high = (min((np.percentile(v, 5) for v in drawn), default=0.0), max((v.max() for v in drawn), default=0.0))
    if low > 0.0 and high > _WIDE_RANGE * low:
        set_log_scale(ax, "y", 0.8 * float(low), 1.25 * float(high))


def _limits(benchmark: Benchmark, measure: Measure, others: Iterable[float]) -> tuple[float, float]:
    """Return between what a logarithmic axis shows all runs that have a value above zero, and other values."""
    values = [v for row in benchmark.rows if (v := measure.of(row)) is not None and 0.0 < v < math.inf]
    values += others
    high = max(values, default=1.0)
    low = max(min(values, default=0.1), high * 10.0**-_DECADES)
    room = max((high / low) ** 0.04, 1.15)
    return low / room, high * room


def _name_scenarios(ax: Axes, benchmark: Benchmark) -> None:
    n = len(benchmark.scenarios)
    ax.set_yticks(range(n), [_short(scenario) for scenario in benchmark.scenarios])
    ax.set_ylim(n - 0.5, -0.5)
    ax.grid(visible=False, axis="y")
    for edge in range(1, n):
        ax.axhline(edge - 0.5, color=GRID, linewidth=0.6)


def _errors(runs: Iterable[Row], place: int, kind: str) -> Iterator[float]:
    """Yield the errors of runs at one of their lengths, where they have one."""
    for row in runs:
        values = row.rpe_len_m if kind == "position" else row.rpe_len_deg
        if row.status == "ok" and place < min(len(values), len(row.length_m)) and row.length_m[place] > 0.0:
            value = 100.0 * values[place] / row.length_m[place] if kind == "position" else values[place]
            if math.isfinite(value):
                yield value


def _length_name(runs: Iterable[Row], place: int, as_share: bool) -> str:
    """Return what to call one of the lengths: the median over runs, of metres or of the share of the way."""
    rows = [row for row in runs if place < len(row.length_m)]
    lengths = np.array([row.length_m[place] for row in rows])
    if as_share:
        ways = np.array([row.path_m or np.nan for row in rows])
        shares = 100.0 * (lengths / ways)[np.isfinite(ways)]
        return f"{np.median(shares):.0f}" if len(shares) else f"{place + 1}"
    return f"{np.median(lengths):.3g}"


def _known(runs: Iterable[Row], column: str) -> Array:
    values = (getattr(row, column) for row in runs)
    return np.array([value for value in values if value is not None and math.isfinite(value)], dtype=np.float64)


def _short(name: str) -> str:
    """Return a name that fits beside a drawing."""
    flat = "".join(letter for letter in " ".join(name.split()) if letter.isprintable())
    return flat if len(flat) <= _LONGEST_NAME else f"{flat[: _LONGEST_NAME - 1]}…"
