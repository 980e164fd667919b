"""Plots of a flight through an unknown world: the map from above, and height, speed and distance over time."""

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.patches import Rectangle

from dronevio.eval import colours
from dronevio.eval.exploration import ExploredFlight, TimedDecision
from dronevio.eval.report.figures import INK, draw_line, svg_plot
from dronevio.eval.report.map_pictures import STATE_COLOURS
from dronevio.models.arrays import Array
from dronevio.models.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, States
from dronevio.models.state import Trajectory

_BAND_M = 0.2  # above and below the height of the flight, as high as the body of the drone
_MARGIN_M = 0.5  # around what is drawn
_PLACE_M = 0.3  # between decisions that have one label
_PALE, _DARK = "#ffffff", "#1f2329"  # of marks in the map, in the light and the dark mode of the page
_WIDTH_IN, _MAX_HEIGHT_IN = 8.5, 8.0
_TIME_SIZE_IN = 4.8, 2.7
_MAP_TITLE = "The map at the height of the flight, from above"


def plot_map(flight: ExploredFlight, grid: OccupancyGrid) -> Markup:
    """Return the map from above in a band of heights around that of the flight, with paths, plans and decisions."""
    z_m = float(np.median(flight.under_way.p_world_imu[:, 2]))
    states, low_m = layer_in_world(flight, grid, z_m)
    picture = np.zeros((*states.shape, 4), np.uint8)
    for state, colour in STATE_COLOURS.items():
        picture[states == state] = (*colours.rgb(colour), 255)
    high_m = low_m + grid.cell_m * np.array(states.shape)
    limits = np.stack([low_m, high_m])

    def draw(ax: Axes) -> None:
        extent = (float(low_m[0]), float(high_m[0]), float(low_m[1]), float(high_m[1]))
        ax.imshow(picture.transpose(1, 0, 2), origin="lower", extent=extent, interpolation="nearest")
        ax.grid(visible=False)
        _draw_true_walls(ax, flight.true_map, z_m)
        plans = LineCollection([plan.positions_m[:, :2] for plan in flight.plans], colors=colours.PLAN, linewidths=0.7)
        plans.set(alpha=0.8, label="plans")
        ax.add_collection(plans)
        routes = [plan.route_m for plan in flight.plans if len(plan.route_m)]
        if routes:
            ax.plot(*routes[-1][:, :2].T, color=colours.ROUTE, linewidth=1.4, linestyle="--", label="last route")
        truth, estimate = flight.truth.p_world_imu[:, :2], flight.estimate.p_world_imu[:, :2]
        draw_line(ax, truth, color=colours.TRUTH, linewidth=2.4, label="true path")
        if len(estimate):
            draw_line(ax, estimate, color=colours.ESTIMATE, linewidth=1.0, label="estimated path")
        _draw_places(ax, flight)
        for state, name in ((FREE, "free"), (OCCUPIED, "occupied"), (UNKNOWN, "unknown")):
            ax.add_patch(Rectangle((0, 0), 0, 0, facecolor=STATE_COLOURS[state], label=name))
        ax.set(xlim=limits[:, 0], ylim=limits[:, 1], title=_MAP_TITLE, xlabel="x [m]", ylabel="y [m]")

    height_in = 1.5 + _WIDTH_IN * states.shape[1] / states.shape[0]
    alt = f"what is free, occupied and unknown within {_BAND_M:g} m of z = {z_m:.2f} m, with true path and plans"
    return svg_plot(min(_MAX_HEIGHT_IN, height_in), draw, alt, _WIDTH_IN)


def layer_in_world(flight: ExploredFlight, grid: OccupancyGrid, z_m: float) -> tuple[States, Array]:
    """Return the states (A, B) of a map in a band of heights along the axes of the world, and their lower corner (2,).

    A place is occupied if any of its cells within `_BAND_M` of the height z [m] is, free if all are, otherwise unknown.
    The layer contains all that is known there, and paths, plans and goal.
    """
    known = grid.centres(np.argwhere(grid.states != UNKNOWN)) @ flight.T_world_map[:3, :3].T
    known = known + flight.T_world_map[:3, 3]
    near = known[np.abs(known[:, 2] - z_m) < _BAND_M + grid.cell_m]
    shown = [near, flight.truth.p_world_imu, flight.estimate.p_world_imu, flight.pad_m[None], flight.goals_m]
    xy = np.concatenate(shown)[:, :2]
    low_m = np.floor((xy.min(axis=0) - _MARGIN_M) / grid.cell_m) * grid.cell_m
    counts = np.ceil((xy.max(axis=0) + _MARGIN_M - low_m) / grid.cell_m).astype(int)
    x, y = (low_m[axis] + grid.cell_m * (np.arange(counts[axis]) + 0.5) for axis in range(2))
    z = z_m + np.arange(-_BAND_M, _BAND_M + 0.5 * grid.cell_m, grid.cell_m)
    points = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1)
    states = grid.at(points @ flight.T_map_world[:3, :3].T + flight.T_map_world[:3, 3])
    layer = np.full(states.shape[:2], UNKNOWN, np.uint8)
    layer[(states == FREE).all(axis=2)] = FREE
    layer[(states == OCCUPIED).any(axis=2)] = OCCUPIED
    return layer, low_m


def plot_heights(flight: ExploredFlight) -> Markup:
    """Return the heights over time: true, estimated and those between which routes are."""

    def draw(ax: Axes) -> None:
        ax.axhspan(*flight.heights_m, color=colours.SURROUNDINGS, alpha=0.15, linewidth=0.0, label="heights of routes")
        for _, _, z in flight.goals_m:
            ax.axhline(z, color=INK, linewidth=0.8, linestyle="--", label="goal")
        for trajectory, label, colour, width in _both(flight):
            _draw_over_time(ax, flight, trajectory, trajectory.p_world_imu[:, 2], label, colour, width)
        _finish(ax, flight, "Height over time", "z [m]")

    return svg_plot(_TIME_SIZE_IN[1], draw, "true and estimated height, with the heights of routes", _TIME_SIZE_IN[0])


def plot_speed(flight: ExploredFlight) -> Markup:
    """Return the true and the estimated speed over time, with the limit of plans."""

    def draw(ax: Axes) -> None:
        ax.axhline(flight.speed_limit_m_s, color=INK, linewidth=0.8, linestyle="--", label="limit")
        for trajectory, label, colour, width in _both(flight):
            if trajectory.velocity_m_s is not None:
                speed = np.linalg.norm(trajectory.velocity_m_s, axis=1)
                _draw_over_time(ax, flight, trajectory, speed, label, colour, width)
        _finish(ax, flight, "Speed over time", "speed [m/s]")

    return svg_plot(_TIME_SIZE_IN[1], draw, "true and estimated speed, with the limit", _TIME_SIZE_IN[0])


def plot_coverage(flight: ExploredFlight) -> Markup:
    """Return the share of the reachable places that is known to be free over time."""

    def draw(ax: Axes) -> None:
        draw_line(ax, flight.coverage * [1.0, 100.0], color=colours.ESTIMATE, linewidth=1.6, label="known to be free")
        _finish(ax, flight, "Coverage over time", "of the reachable places [%]")

    return svg_plot(_TIME_SIZE_IN[1], draw, "share of the reachable places that is known", _TIME_SIZE_IN[0])


def plot_goal_distance(flight: ExploredFlight, goal_m: Array) -> Markup:
    """Return the true and the estimated distance to a goal (3,) over time."""

    def draw(ax: Axes) -> None:
        for trajectory, label, colour, width in _both(flight):
            distance = np.linalg.norm(trajectory.p_world_imu - goal_m, axis=1)
            _draw_over_time(ax, flight, trajectory, distance, label, colour, width)
        _finish(ax, flight, "Distance to the goal over time", "distance [m]")

    return svg_plot(_TIME_SIZE_IN[1], draw, "true and estimated distance in a straight line", _TIME_SIZE_IN[0])


def _draw_true_walls(ax: Axes, grid: OccupancyGrid, z_m: float) -> None:
    """Draw the outlines of what is occupied in truth in the band of heights."""
    heights = grid.low_m[2] + grid.cell_m * (np.arange(grid.states.shape[2]) + 0.5)
    occupied = (grid.states[:, :, np.abs(heights - z_m) < _BAND_M] == OCCUPIED).any(axis=2)
    if min(occupied.shape) > 1 and occupied.any():
        x, y = (grid.low_m[axis] + grid.cell_m * (np.arange(occupied.shape[axis]) + 0.5) for axis in range(2))
        ax.contour(x, y, occupied.T.astype(float), levels=[0.5], colors=_PALE, linewidths=0.6, alpha=0.7)


def plot_error(flight: ExploredFlight) -> Markup:
    """Return the distance of the estimated from the true position over time, both in the frame of the world."""

    def draw(ax: Axes) -> None:
        estimate, truth = flight.estimate, flight.truth
        if len(estimate):
            true = [np.interp(estimate.t_ns, truth.t_ns, axis) for axis in truth.p_world_imu.T]
            error_m = np.linalg.norm(estimate.p_world_imu - np.stack(true, axis=1), axis=1)
            _draw_over_time(ax, flight, estimate, error_m, "estimate", colours.ESTIMATE, 1.2)
        _finish(ax, flight, "Error of the estimated position over time", "error [m]")

    return svg_plot(_TIME_SIZE_IN[1], draw, "distance of estimated and true position", _TIME_SIZE_IN[0])


def _draw_places(ax: Axes, flight: ExploredFlight) -> None:
    """Draw pad, goal and the numbered places of the decisions."""
    goals = [(goal, "*", 13.0, "goal") for goal in flight.goals_m]
    for (x, y, _), marker, size, label in ((flight.pad_m, "s", 8.0, "pad"), *goals):
        ax.plot(x, y, marker, color=_DARK, markersize=size, markeredgecolor=_PALE, linestyle="none", label=label)
    box = {"boxstyle": "round,pad=0.2,rounding_size=0.6", "facecolor": _PALE, "edgecolor": _DARK, "linewidth": 0.5}
    for text, (x, y, _) in decision_labels(flight.decisions):
        offset = (5.0, 5.0)
        ax.annotate(text, (x, y), offset, textcoords="offset points", fontsize=6.5, color=_DARK, bbox=box)


def decision_labels(decisions: Sequence[TimedDecision]) -> list[tuple[str, tuple[float, float, float]]]:
    """Return labels and places of decisions: their numbers, from the first to the last of those at one place."""
    groups: list[list[int]] = []
    for i, each in enumerate(decisions):
        is_same = groups and np.hypot(*np.subtract(each.position_m, decisions[groups[-1][0]].position_m)[:2]) < _PLACE_M
        if is_same:
            groups[-1].append(i)
        else:
            groups.append([i])
    names = [f"{g[0] + 1}" if len(g) == 1 else f"{g[0] + 1}–{g[-1] + 1}" for g in groups]
    return [(name, decisions[g[0]].position_m) for name, g in zip(names, groups, strict=True)]


def _both(flight: ExploredFlight) -> tuple[tuple[Trajectory, str, str, float], ...]:
    """Return truth and estimate, if there is one, with their names, colours and widths of lines."""
    truth = (flight.truth, "truth", colours.TRUTH, 2.4)
    return (truth, (flight.estimate, "estimate", colours.ESTIMATE, 1.0)) if len(flight.estimate) else (truth,)


def _draw_over_time(
    ax: Axes, flight: ExploredFlight, trajectory: Trajectory, values: Array, label: str, colour: str, width: float
) -> None:
    """Draw values (N,) of a trajectory over the time of the flight."""
    seconds = 1e-9 * (trajectory.t_ns - flight.origin_ns)
    draw_line(ax, np.stack([seconds, values], axis=1), color=colour, linewidth=width, label=label)


def _finish(ax: Axes, flight: ExploredFlight, title: str, axis: str) -> None:
    """Mark the decisions below a plot over time, and label its axes."""
    ax.set(title=title, xlabel="time [s]", ylabel=axis)
    ax.set_ylim(bottom=0.0)
    ax.set_xlim(0.0, 1e-9 * float(flight.truth.t_ns[-1] - flight.origin_ns))
    if flight.decisions:
        seconds = [1e-9 * (each.t_ns - flight.origin_ns) for each in flight.decisions]
        below = ax.get_xaxis_transform()
        zero = np.zeros(len(seconds))
        ax.plot(
            seconds,
            zero,
            "^",
            transform=below,
            color=INK,
            markersize=4.5,
            linestyle="none",
            clip_on=False,
            label="decisions",
        )
