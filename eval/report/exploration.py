"""The report of a flight through an unknown world: map, path, plans, decisions and costs.

``report.json`` holds the following keys:

    format         "dronevio-exploration-report/1"
    title, command, open_command               as in `RunInfo`
    scenario, seed, world, pad_m, goal_m       what was flown
    outcome, …                                 the scores, and `outcome_text`, what the drone did
    plans                                      number of plans
    coverage                                   times and shares of the reachable places known to be free
    costs                                      of depth, map and plan: declared latency, and processor times; of the
                                               flight: processor time of all but rendering, per second of flight
    decisions                                  time of the flight, text and place in the world
    configuration, versions, machine           as in `RunInfo`
"""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path

from dronevio.eval.exploration import ExplorationScores, ExploredFlight
from dronevio.eval.metrics.metric import DASH
from dronevio.eval.provenance import RunInfo
from dronevio.eval.report.exploration_plots import (
    plot_coverage,
    plot_error,
    plot_goal_distance,
    plot_heights,
    plot_map,
    plot_speed,
)
from dronevio.eval.report.tables import Cell, Table
from dronevio.eval.report.templating import Tile, number, render_page
from dronevio.models.recordings.files import write_text

FORMAT = "dronevio-exploration-report/1"


def score_rows(scores: ExplorationScores) -> tuple[tuple[str, str, str], ...]:
    """Return names, values and units of the scores for a table."""
    has_path = scores.shortest_m is not None and scores.shortest_m < float("inf")
    of_goal = (
        ("distance to the goal at the end", number(scores.distance_to_goal_m, 2), "m"),
        ("shortest path on the true map", number(scores.shortest_m, 1) if has_path else DASH, "m" if has_path else ""),
    )
    return (
        *(of_goal if scores.distance_to_goal_m is not None else ()),
        ("length of the path after take-off and turns", f"{scores.path_m:.1f}", "m"),
        ("duration", f"{scores.time_s:.1f}", "s"),
        ("median speed while it moves", f"{scores.median_speed_m_s:.2f}", "m/s"),
        ("share of the reachable places that is known to be free", f"{100.0 * scores.covered_share:.1f}", "%"),
        ("ATE of the odometry", DASH if scores.ate_m is None else f"{scores.ate_m:.3f}", "m"),
    )


def cost_rows(flight: ExploredFlight) -> tuple[tuple[str, str, str, str, str], ...]:
    """Return stages, declared latencies, numbers, means and 99th percentiles of the processor times [ms]."""
    return tuple(
        (each.name, f"{each.latency_ms:.0f}", f"{len(each.cpu_ms)}", number(each.mean_ms, 1), number(each.p99_ms, 1))
        for each in flight.stages
    )


def cost_note(flight: ExploredFlight) -> str:
    """Return a sentence on the processor time of the whole flight."""
    return f"All but rendering takes {flight.cpu_per_s:.2f} s of processor time per second of flight."


COST_COLUMNS = ("stage", "declared latency [ms]", "number", "processor time, mean [ms]", "99th percentile [ms]")
"""Headings of `cost_rows`."""


def write_exploration_report(folder: Path, info: RunInfo, flight: ExploredFlight, values: Mapping[str, object]) -> None:
    """Write ``report.html`` and ``report.json``.

    Args:
        folder: Folder for the files.
        info: Provenance of the flight.
        flight: The flight.
        values: Figures of the flight for ``report.json``, of types that JSON can represent.

    Raises:
        InputError: A file cannot be written.
    """
    document = {
        "format": FORMAT,
        "title": info.title,
        "command": info.command,
        "open_command": info.open_command,
        **values,
        "configuration": info.configuration,
        "versions": info.versions,
        "machine": info.machine,
    }
    write_text(folder / "report.json", json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False) + "\n")
    write_text(folder / "report.html", _page(info, flight))


def _page(info: RunInfo, flight: ExploredFlight) -> str:
    """Return the page."""
    scores = tuple((Cell(name), Cell(f"{value} {unit}".strip())) for name, value, unit in score_rows(flight.scores))
    costs = tuple(tuple(Cell(text) for text in row) for row in cost_rows(flight))
    progress = plot_coverage(flight) if flight.goal_m is None else plot_goal_distance(flight, flight.goal_m)
    return render_page(
        "exploration.html.j2",
        info.title,
        f"The drone {flight.collision or flight.outcome}.",
        tiles=list(_tiles(flight.scores)),
        map=None if flight.occupancy is None else plot_map(flight, flight.occupancy),
        plots=[plot_heights(flight), plot_speed(flight), progress, plot_error(flight)],
        decisions=_decisions(flight),
        cost_note=cost_note(flight),
        costs=Table("Costs", COST_COLUMNS, costs),
        scores=Table("Scores", ("quantity", "value"), scores),
        open_command=info.open_command,
        provenance=info.sections,
    )


def _decisions(flight: ExploredFlight) -> Table:
    """Return the decisions as a table, with the numbers that mark them in the map."""
    rows = []
    for i, each in enumerate(flight.decisions, start=1):
        t_s = 1e-9 * (each.t_ns - flight.origin_ns)
        where = ", ".join(number(v, 1) for v in each.position_m)
        rows.append((Cell(f"{i}", order=i), Cell(f"{t_s:.2f}", order=t_s), Cell(each.what), Cell(where)))
    columns = ("number", "time [s]", "decision", "position [m]")
    return Table("Decisions", columns, tuple(rows), text_columns=frozenset({2}))


def _tiles(scores: ExplorationScores) -> Iterator[Tile]:
    """Yield the numbers at the top of the page."""
    covered = Tile("Covered", number(100.0 * scores.covered_share, 1), "%", "of the reachable places known to be free")
    if scores.distance_to_goal_m is None or scores.shortest_m is None:
        yield covered
        yield Tile("Path", number(scores.path_m, 1), "m", "after take-off and turns")
    else:
        has_path = scores.shortest_m < float("inf")
        shortest = f"shortest on the true map: {scores.shortest_m:.1f} m" if has_path else "no path on the true map"
        yield Tile("Distance to the goal", number(scores.distance_to_goal_m, 2), "m", "at the end, by the truth")
        yield Tile("Path", number(scores.path_m, 1), "m", f"after take-off and turns; {shortest}")
    yield Tile("Duration", number(scores.time_s, 1), "s", f"median speed {scores.median_speed_m_s:.2f} m/s")
    yield Tile("ATE", number(scores.ate_m, 3), "m", "of the odometry, after alignment")
