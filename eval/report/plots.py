"""Plots of one run: path, errors with estimated uncertainty, consistency and cost.

Each function draws into axes that it is given.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from dronevio.eval import colours
from dronevio.eval.metrics import ScoredTrajectory, nees_bounds, relative_errors
from dronevio.eval.metrics.lengths import pairs_of_length
from dronevio.eval.report.figures import INK, Boxes, draw_boxes, draw_line, figure, save_png, set_log_scale
from dronevio.eval.run import EstimatorRun
from dronevio.models.arrays import Array
from dronevio.models.imu import Times
from dronevio.models.recordings.files import check_output_path
from dronevio.models.state import Trajectory

_MIN_NEES, _MAX_NEES = 1e-2, 1e4  # values beyond are drawn at these limits
_HISTOGRAM_BINS = 40


@dataclass(frozen=True)
class PathView:
    """An orthographic view of a path along an axis of the world frame."""

    title: str
    """Title of the plot."""
    horizontal: int
    """Index of the world axis on the x axis of the plot."""
    vertical: int
    """Index of the world axis on the y axis of the plot."""


TOP_VIEW = PathView("Path from above", 0, 1)
SIDE_VIEW = PathView("Path from the side", 0, 2)


def draw_path(
    ax: Axes,
    view: PathView,
    estimate: Trajectory,
    truth: Trajectory | None,
    outline: Array,
    corrected: Trajectory | None = None,
) -> None:
    """Draw the estimated and the true path to scale, with a ring at the start and a square at the end.

    Args:
        ax: Axes to draw into.
        view: Direction of view.
        estimate: The estimated trajectory, in the world frame of the ground truth.
        truth: The true trajectory; None if it is not known.
        outline: (L, 2, 3) Line segments of the surroundings in the same frame [m].
        corrected: The trajectory corrected by a map, in the same frame; None without a map.
    """
    axes = [view.horizontal, view.vertical]
    ax.add_collection(LineCollection(list(outline[:, :, axes]), colors=colours.SURROUNDINGS, linewidths=0.8, alpha=0.6))
    if truth is not None:
        draw_line(ax, truth.p_world_imu[:, axes], color=colours.TRUTH, linewidth=2.6, alpha=0.75, label="truth")
    draw_line(ax, estimate.p_world_imu[:, axes], color=colours.ESTIMATE, linewidth=1.2, label="estimate")
    if corrected is not None:
        draw_line(ax, corrected.p_world_imu[:, axes], color=colours.CORRECTED, linewidth=1.0, label="map")
    _finish_path(ax, view, estimate if truth is None else truth)


def draw_paths(ax: Axes, view: PathView, paths: Mapping[str, Trajectory]) -> None:
    """Draw several paths to scale, with a ring at the start of the first and a square at its end.

    Args:
        ax: Axes to draw into.
        view: Direction of view.
        paths: The trajectories by their names in the legend, in one world frame.
    """
    for i, (name, path) in enumerate(paths.items()):
        points = path.p_world_imu[:, [view.horizontal, view.vertical]]
        draw_line(ax, points, color=colours.ESTIMATORS[i % len(colours.ESTIMATORS)], linewidth=1.2, label=name)
    _finish_path(ax, view, next(iter(paths.values())))


def _finish_path(ax: Axes, view: PathView, marked: Trajectory) -> None:
    """Mark the start and the end of a path, and label the axes."""
    if len(marked):
        for row, marker, label in ((0, "o", "start"), (-1, "s", "end")):
            x, y = marked.p_world_imu[row, [view.horizontal, view.vertical]]
            ax.plot(x, y, marker, color=INK, markerfacecolor="none", markersize=7, linestyle="none", label=label)
    ax.set_aspect("equal", adjustable="datalim")
    ax.autoscale_view()
    ax.set(title=view.title, xlabel=f"{'xyz'[view.horizontal]} [m]", ylabel=f"{'xyz'[view.vertical]} [m]")


def draw_position_error(ax: Axes, scored: ScoredTrajectory, origin_ns: int) -> None:
    """Draw the position error over time: after alignment, and anchored at the first pose with its 3σ band."""
    consistency = scored.consistency
    if consistency is not None:
        t_ns, error = consistency.t_ns - origin_ns, consistency.position_error_m
        _draw_with_band(ax, t_ns, error, consistency.position_sigma_m, label="anchored at the first pose")
    _draw_aligned(ax, scored.truth.t_ns - origin_ns, scored.translation_error_m)
    _label_time_axes(ax, "Position error over time", "position error [m]")


def draw_orientation_error(ax: Axes, scored: ScoredTrajectory, origin_ns: int) -> None:
    """Draw the orientation error over time: after alignment, and anchored at the first pose with its 3σ band."""
    consistency = scored.consistency
    if consistency is not None:
        t_ns, error = consistency.t_ns - origin_ns, np.degrees(consistency.orientation_error_rad)
        sigma = np.degrees(consistency.orientation_sigma_rad)
        _draw_with_band(ax, t_ns, error, sigma, label="anchored at the first pose")
    _draw_aligned(ax, scored.truth.t_ns - origin_ns, np.degrees(scored.rotation_error_rad))
    _label_time_axes(ax, "Orientation error over time", "orientation error [°]")


def draw_speed(ax: Axes, estimate: Trajectory, truth: Trajectory | None, origin_ns: int) -> None:
    """Draw the true and the estimated speed over time."""
    for trajectory, label, colour, width in (
        (truth, "truth", colours.TRUTH, 2.6),
        (estimate, "estimate", colours.ESTIMATE, 1.2),
    ):
        if trajectory is not None and trajectory.velocity_m_s is not None:
            speed = np.linalg.norm(trajectory.velocity_m_s, axis=1)
            seconds = (trajectory.t_ns - origin_ns) * 1e-9
            draw_line(ax, np.stack([seconds, speed], axis=1), color=colour, linewidth=width, label=label)
    _label_time_axes(ax, "Speed over time", "speed [m/s]")


@dataclass(frozen=True)
class StateError:
    """The error of a part of the state besides the pose."""

    title: str
    """Title of the plot."""
    axis: str
    """Label of the y axis, with the unit."""
    first_row: int
    """Index of its first row in the covariance matrix."""
    of: Callable[[Trajectory], Array | None]
    """Returns this part of the state (N, 3) of a trajectory, or None if the trajectory does not have it."""
    factor: float = 1.0
    """Factor from SI units to the unit of the plot."""

    def is_known(self, scored: ScoredTrajectory) -> bool:
        """Return whether both truth and estimate have this part of the state."""
        return self.of(scored.truth) is not None and self.of(scored.estimate) is not None


STATE_ERRORS = (
    StateError("Velocity error over time", "velocity error [m/s]", 6, lambda t: t.velocity_m_s),
    StateError(
        "Gyroscope bias error over time", "bias error [°/s]", 9, lambda t: t.gyro_bias_rad_s, float(np.degrees(1.0))
    ),
    StateError("Accelerometer bias error over time", "bias error [m/s²]", 12, lambda t: t.accel_bias_m_s2),
)
"""Errors of velocity and biases."""


def draw_state_error(ax: Axes, quantity: StateError, scored: ScoredTrajectory, origin_ns: int) -> None:
    """Draw the norm of an error that is known over time, with its 3σ band if there are covariances."""
    true, estimated = quantity.of(scored.truth), quantity.of(scored.estimate)
    assert true is not None and estimated is not None
    t_ns, error = scored.truth.t_ns - origin_ns, quantity.factor * (true - estimated)
    covariance = scored.estimate.covariance
    if covariance is None:
        _draw_aligned(ax, t_ns, np.linalg.norm(error, axis=1))
    else:
        variance = np.diagonal(covariance, axis1=1, axis2=2)[:, quantity.first_row : quantity.first_row + 3]
        sigma = quantity.factor * np.sqrt(variance)
        _draw_with_band(ax, t_ns, error, sigma, label="aligned", colour=colours.ESTIMATE)
    _label_time_axes(ax, quantity.title, quantity.axis)


def draw_nees(ax: Axes, scored: ScoredTrajectory, origin_ns: int) -> None:
    """Draw the NEES of position and orientation over time, with the two-sided 95 % bounds of a consistent estimator."""
    consistency = scored.consistency
    assert consistency is not None
    seconds = (consistency.t_ns - origin_ns) * 1e-9
    low, high = nees_bounds(3)
    label = "95 % of χ², 3 degrees of freedom"
    ax.axhspan(low, high, color=colours.SURROUNDINGS, alpha=0.18, linewidth=0.0, label=label)
    ax.axhline(3.0, color=INK, linewidth=0.8, linestyle="--")
    for values, colour, label in (
        (consistency.position_nees, colours.ESTIMATE, "position"),
        (consistency.orientation_nees, colours.SECOND, "orientation"),
    ):
        clipped = np.clip(values, _MIN_NEES, _MAX_NEES)
        draw_line(ax, np.stack([seconds, clipped], axis=1), color=colour, linewidth=1.0, label=label)
    largest = max(consistency.position_nees.max(), consistency.orientation_nees.max(), high)
    set_log_scale(ax, "y", _MIN_NEES, min(2.0 * float(largest), _MAX_NEES))
    ax.set(title="Consistency: NEES over time", xlabel="time [s]", ylabel="NEES [–], 3 expected")
    ax.margins(x=0.01)


class LengthErrorSamples(NamedTuple):
    """Errors of all sub-trajectories of several lengths."""

    labels: tuple[str, ...]
    """(L) The lengths as text [m]."""
    translation_percent: tuple[Array, ...]
    """(L) Relative position errors (M,) of each length [% of the length]."""
    rotation_deg: tuple[Array, ...]
    """(L) Relative orientation errors (M,) of each length [°]."""


def length_errors(scored: ScoredTrajectory) -> LengthErrorSamples:
    """Return the errors behind the statistics by sub-trajectory length in the scores."""
    truth, estimate = scored.truth, scored.estimate
    poses = truth.p_world_imu, truth.quat_wxyz, estimate.p_world_imu, estimate.quat_wxyz
    translation, rotation = [], []
    lengths_m = [errors.length_m for errors in scored.scores.lengths]
    for length_m in lengths_m:
        errors_m, errors_rad = relative_errors(*poses, pairs_of_length(truth.p_world_imu, length_m))
        translation.append(100.0 / length_m * errors_m)
        rotation.append(np.degrees(errors_rad))
    labels = tuple(f"{length_m:.3g}" for length_m in lengths_m)
    return LengthErrorSamples(labels, tuple(translation), tuple(rotation))


def draw_length_errors(ax: Axes, labels: tuple[str, ...], values: tuple[Array, ...], title: str, axis: str) -> None:
    """Draw a box plot of errors for each sub-trajectory length."""
    draw_boxes(ax, labels, [Boxes("estimate", colours.ESTIMATE, values)])
    ax.set(title=title, xlabel="length of the sub-trajectory [m]", ylabel=axis)


def draw_cost(ax: Axes, run: EstimatorRun, origin_ns: int, frame_interval_ms: float) -> None:
    """Draw the processor time of each frame, with the frame interval as the limit of real time on one core."""
    seconds = (run.t_ns - origin_ns) * 1e-9
    ax.plot(seconds, run.cpu_ms, ".", color=colours.SIGMA, markersize=2.5)
    if np.max(run.cpu_ms, initial=0.0) > 0.3 * frame_interval_ms:
        ax.axhline(frame_interval_ms, color=INK, linewidth=0.8, linestyle="--", label="frame interval")
    _label_time_axes(ax, "Processor time per frame", "processor time [ms]")


def draw_cost_histogram(ax: Axes, run: EstimatorRun) -> None:
    """Draw a histogram of the processor time per frame, with its mean and 99th percentile."""
    mean, percentile = float(run.cpu_ms.mean()), float(np.percentile(run.cpu_ms, 99))
    ax.hist(run.cpu_ms, bins=_HISTOGRAM_BINS, color=colours.SIGMA, linewidth=0.0)
    ax.axvline(mean, color=INK, linewidth=1.0, label=f"mean, {mean:.1f} ms")
    ax.axvline(percentile, color=INK, linewidth=1.0, linestyle="--", label=f"99th percentile, {percentile:.1f} ms")
    ax.set(
        title="Distribution of the processor time", xlabel="processor time per frame [ms]", ylabel="number of frames"
    )
    ax.set_xlim(left=0.0)


def _draw_aligned(ax: Axes, t_ns: Times, error: Array) -> None:
    ax.plot(t_ns * 1e-9, error, color=colours.ESTIMATE, label="aligned")


def _draw_with_band(ax: Axes, t_ns: Times, error: Array, sigma: Array, label: str, colour: str = INK) -> None:
    """Draw the norm of errors (N, 3) and a band up to three times the norm of their standard deviations (N, 3)."""
    seconds = t_ns * 1e-9
    band = 3.0 * np.linalg.norm(sigma, axis=1)
    ax.fill_between(seconds, 0.0, band, color=colours.SIGMA, alpha=0.25, linewidth=0.0, label="3σ, estimated")
    ax.plot(seconds, np.linalg.norm(error, axis=1), color=colour, linewidth=0.9, label=label)


def _label_time_axes(ax: Axes, title: str, axis: str) -> None:
    ax.set(title=title, xlabel="time [s]", ylabel=axis)
    ax.set_ylim(bottom=0.0)
    ax.margins(x=0.01)


def write_score_plot(path: Path, scored: ScoredTrajectory) -> None:
    """Write a PNG file with path, position error and orientation error of a scored estimate.

    Args:
        path: File to write; missing folders are made.
        scored: The estimated trajectory with its errors.

    Raises:
        InputError: The path is a folder, or one of its folders is a file.
    """
    check_output_path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    origin_ns = int(scored.truth.t_ns[0])
    with figure(14.0, 4.6, columns=3) as (fig, axes):
        draw_path(axes[0], TOP_VIEW, scored.estimate, scored.truth, np.zeros((0, 2, 3)))
        draw_position_error(axes[1], scored, origin_ns)
        draw_orientation_error(axes[2], scored, origin_ns)
    save_png(fig, path)
