"""The section of a run's page about the map: its size, the scores of the corrected trajectories, and plots."""

from collections.abc import Iterator
from dataclasses import dataclass

from markupsafe import Markup

from dronevio.eval.map_results import MapResults, online_correction
from dronevio.eval.metrics import IDENTITY, ScoredTrajectory
from dronevio.eval.metrics.metric import DASH
from dronevio.eval.report import map_plots
from dronevio.eval.report.figures import svg_plot
from dronevio.eval.report.model import RunResults
from dronevio.eval.report.tables import Cell, Table
from dronevio.eval.report.templating import Tile, number

_GRAPH_HEIGHT_IN, _PLOT_HEIGHT_IN = 3.7, 2.7


@dataclass(frozen=True, eq=False)
class MapSection:
    """What the section shows."""

    tiles: tuple[Tile, ...]
    """Size of the map."""
    table: Table | None
    """Scores of the odometry and of the corrected trajectories; None without ground truth."""
    plots: tuple[Markup, ...]
    """Plots as SVG."""


def map_section(results: RunResults) -> MapSection | None:
    """Return the section about the map of a run; None without a map."""
    if (mapped := results.map) is None:
        return None
    table = None if results.scored is None else score_table(results.scored, mapped)
    return MapSection(tuple(_tiles(mapped)), table, tuple(_plots(results, mapped)))


def score_table(odometry: ScoredTrajectory, mapped: MapResults) -> Table:
    """Return the scores of the odometry, the online and the final path, with the ratio of each to the odometry."""
    rows = []
    for name, scored in (
        ("odometry", odometry),
        ("map, online", mapped.scored_online),
        ("map, final", mapped.scored_final),
    ):
        if scored is not None:
            scores, ate_m = scored.scores, scored.scores.ate_m.rmse
            ratio = ate_m / odometry.scores.ate_m.rmse if odometry.scores.ate_m.rmse > 0.0 else None
            rpe_m, rpe_deg = scores.rpe_m, scores.rpe_deg
            texts = (
                number(1e3 * ate_m, 1),
                number(ratio, 2),
                number(scores.ate_deg.rmse, 3),
                DASH if rpe_m is None else number(1e3 * rpe_m.rmse, 1),
                DASH if rpe_deg is None else number(rpe_deg.rmse, 3),
                number(scores.scale_error_percent, 2, sign=True),
            )
            rows.append((Cell(name), *(Cell(text) for text in texts)))
    columns = ("", "ATE [mm]", "ratio", "ATE [°]", "RPE 1 s [mm]", "RPE 1 s [°]", "scale error [%]")
    return Table("Scores of the odometry and of the corrected paths", columns, tuple(rows))


def _tiles(mapped: MapResults) -> Iterator[Tile]:
    """Yield the numbers of the section."""
    closed, rejected = len(mapped.map.closed), int(mapped.map.rejected.sum())
    yield Tile("Loops", str(closed), "", "relative poses of keyframes that see a place again")
    yield Tile("Rejected loops", str(rejected), "", "which contradict the others")
    yield Tile("Keyframes", str(len(mapped.map.t_ns)), "", "of the map")
    yield Tile("Points", str(len(mapped.map.points)), "", "of the map")
    if mapped.map.adjustment:
        outcome, _, reason = mapped.map.adjustment.partition(": ")
        yield Tile("Bundle adjustment", outcome, "", reason)


def _plots(results: RunResults, mapped: MapResults) -> Iterator[Markup]:
    """Yield the plots of the section."""
    slam_map, truth, origin_ns = mapped.map, results.recording.ground_truth, results.origin_ns
    before = IDENTITY if results.scored is None else results.scored.alignment
    after = mapped.final_alignment
    alt = f"{len(slam_map.t_ns)} keyframes, {len(slam_map.closed)} loops, {int(slam_map.rejected.sum())} rejected"
    yield svg_plot(_GRAPH_HEIGHT_IN, lambda ax: map_plots.draw_graph_before(ax, slam_map, before, truth), alt)
    yield svg_plot(_GRAPH_HEIGHT_IN, lambda ax: map_plots.draw_graph_after(ax, slam_map, after, truth), alt)
    if (scored := results.scored) is not None:
        yield svg_plot(_PLOT_HEIGHT_IN, lambda ax: map_plots.draw_map_errors(ax, scored, mapped, origin_ns))
    correction = online_correction(results.run.estimates)
    yield svg_plot(_PLOT_HEIGHT_IN, lambda ax: map_plots.draw_correction(ax, correction, slam_map, origin_ns))
    yield svg_plot(_PLOT_HEIGHT_IN, lambda ax: map_plots.draw_yaw_correction(ax, correction, slam_map, origin_ns))
    yield svg_plot(_PLOT_HEIGHT_IN, lambda ax: map_plots.draw_loop_count(ax, correction, origin_ns))
