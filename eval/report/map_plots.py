"""Plots of a map: the pose graph before and after the optimization, the errors, and the correction over time.

Each function draws into axes that it is given.
"""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from dronevio.eval import colours
from dronevio.eval.map_results import MapResults, OnlineCorrection
from dronevio.eval.metrics import Alignment, ScoredTrajectory
from dronevio.eval.report.figures import INK, draw_line
from dronevio.eval.report.plots import TOP_VIEW
from dronevio.models.arrays import Array
from dronevio.models.imu import Times
from dronevio.models.slam_map import SlamMap
from dronevio.models.state import Trajectory

MIN_SHOWN_MM, MIN_SHOWN_DEG = 0.1, 0.01
"""Corrections up to which the axes of their plots reach at least, in position [mm] and yaw [°]."""
_AXES = [TOP_VIEW.horizontal, TOP_VIEW.vertical]
_MAX_DRAWN_POINTS = 1000  # of the map, so that the page stays small
_POINT_PERCENTILES = (2.0, 98.0)  # of the coordinates of points that determine the limits of a plot


def draw_graph_before(ax: Axes, slam_map: SlamMap, alignment: Alignment, truth: Trajectory | None) -> None:
    """Draw the keyframes as the odometry has them, with all loops; a loop of an odometry without drift has length zero.

    Args:
        ax: Axes to draw into.
        slam_map: The map.
        alignment: Alignment of the odometry with the ground truth.
        truth: The true trajectory; None if it is not known.
    """
    _draw_graph(ax, slam_map, alignment.positions(slam_map.Ts_odom_imu[:, :3, 3]), colours.ESTIMATE, truth, "odometry")
    _label(ax, "Pose graph before the optimization")


def draw_graph_after(ax: Axes, slam_map: SlamMap, alignment: Alignment, truth: Trajectory | None) -> None:
    """Draw the optimized keyframes with all loops, and the points of the map.

    Args:
        ax: Axes to draw into.
        slam_map: The map.
        alignment: Alignment of the map with the ground truth.
        truth: The true trajectory; None if it is not known.
    """
    points = alignment.positions(slam_map.points)[:: max(1, len(slam_map.points) // _MAX_DRAWN_POINTS), :]
    p = alignment.positions(slam_map.Ts_map_imu[:, :3, 3])
    _draw_graph(ax, slam_map, p, colours.CORRECTED, truth, "map")
    if len(points):
        low, high = np.percentile(points, _POINT_PERCENTILES, axis=0)
        shown = points[np.all((points >= low) & (points <= high), axis=1)][:, _AXES]
        ax.plot(*shown.T, ".", color=colours.SURROUNDINGS, markersize=1.5, alpha=0.6, label="points", zorder=0)
    _label(ax, "Pose graph after the optimization")


def draw_map_errors(ax: Axes, odometry: ScoredTrajectory, results: MapResults, origin_ns: int) -> None:
    """Draw the position errors of the odometry and of the corrected trajectories over time."""
    for scored, label, colour, width in (
        (odometry, "odometry", colours.ESTIMATE, 1.4),
        (results.scored_online, "map, online", INK, 0.9),
        (results.scored_final, "map, final", colours.CORRECTED, 1.4),
    ):
        if scored is not None:
            points = np.stack([_seconds(scored.truth.t_ns, origin_ns), 1e3 * scored.translation_error_m], axis=1)
            draw_line(ax, points, color=colour, linewidth=width, label=label)
    ax.set(title="Position error with and without map", xlabel="time [s]", ylabel="position error [mm]")
    ax.set_ylim(bottom=0.0)
    ax.margins(x=0.01)


def draw_correction(ax: Axes, correction: OnlineCorrection, final: SlamMap, origin_ns: int) -> None:
    """Draw the position of the odometry frame in the map frame over time, online and by the final map (pale)."""
    final_mm = 1e3 * final.correction.Ts_map_odom[:, :3, 3]
    for axis, colour, pale in zip(range(3), colours.AXES, colours.AXES_PALE, strict=True):
        points = np.stack([_seconds(final.t_ns, origin_ns), final_mm[:, axis]], axis=1)
        draw_line(ax, points, color=pale, linewidth=1.0)
        points = np.stack([_seconds(correction.t_ns, origin_ns), 1e3 * correction.position_m[:, axis]], axis=1)
        draw_line(ax, points, color=colour, label="xyz"[axis], drawstyle="steps-post")
    ax.set(title="Correction of the position (pale: final)", xlabel="time [s]", ylabel="T_map_odom, position [mm]")
    _show_at_least(ax, MIN_SHOWN_MM)
    ax.margins(x=0.01)


def draw_yaw_correction(ax: Axes, correction: OnlineCorrection, final: SlamMap, origin_ns: int) -> None:
    """Draw the yaw of the odometry frame in the map frame over time, online and by the final map."""
    R = final.correction.Ts_map_odom[:, :3, :3]
    final_deg = np.degrees(np.arctan2(R[:, 1, 0], R[:, 0, 0]))
    points = np.stack([_seconds(final.t_ns, origin_ns), final_deg], axis=1)
    draw_line(ax, points, color=colours.CORRECTED, linewidth=1.0, label="final")
    points = np.stack([_seconds(correction.t_ns, origin_ns), correction.yaw_deg], axis=1)
    draw_line(ax, points, color=INK, label="online", drawstyle="steps-post")
    ax.set(title="Correction of the yaw", xlabel="time [s]", ylabel="T_map_odom, yaw [°]")
    _show_at_least(ax, MIN_SHOWN_DEG)
    ax.margins(x=0.01)


def _show_at_least(ax: Axes, value: float) -> None:
    """Extend the vertical axis to a value in both directions, so that rounding errors do not look like a correction."""
    low, high = ax.get_ylim()
    ax.set_ylim(min(low, -value), max(high, value))


def draw_loop_count(ax: Axes, correction: OnlineCorrection, origin_ns: int) -> None:
    """Draw the number of loops that have been closed over time."""
    points = np.stack([_seconds(correction.t_ns, origin_ns), correction.loops], axis=1)
    draw_line(ax, points, color=colours.LOOP, drawstyle="steps-post")
    ax.set(title="Closed loops over time", xlabel="time [s]", ylabel="number of loops")
    ax.set_ylim(bottom=0.0)
    ax.margins(x=0.01)


def _draw_graph(ax: Axes, slam_map: SlamMap, p: Array, colour: str, truth: Trajectory | None, label: str) -> None:
    """Draw keyframes at positions (K, 3) [m], and the loops between them."""
    if truth is not None:
        style = {"color": colours.TRUTH, "linewidth": 2.6, "alpha": 0.5}
        draw_line(ax, truth.p_world_imu[:, _AXES], label="truth", **style)
    draw_line(ax, p[:, _AXES], color=colour, linewidth=0.8, marker=".", markersize=3.0, label=label)
    for rows, shade, name in (
        (slam_map.closed, colours.LOOP, "loop"),
        (slam_map.loops[slam_map.rejected], colours.REJECTED_LOOP, "rejected loop"),
    ):
        if len(rows):
            lines = LineCollection(list(p[rows][:, :, _AXES]), colors=shade, linewidths=1.2, label=name, zorder=3)
            ax.add_collection(lines)
    ax.set_aspect("equal", adjustable="datalim")
    ax.autoscale_view()


def _label(ax: Axes, title: str) -> None:
    ax.set(title=title, xlabel="x [m]", ylabel="y [m]")


def _seconds(t_ns: Times, origin_ns: int) -> Array:
    return np.asarray((t_ns - origin_ns) * 1e-9)
