"""Pictures of one run: paths, errors against what was claimed, consistency and cost, for any colour vision.

Each function draws into axes that it is given.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from dronevio.eval import style as palette
from dronevio.eval.metrics import ScoredTrajectory, nees_bounds, pairs_after_distance, relative_errors
from dronevio.eval.report.figures import INK, Boxes, draw_boxes, draw_line, figure, save_png, set_log_scale
from dronevio.eval.run import EstimatorRun
from dronevio.models.imu import Times
from dronevio.models.recordings.files import check_output_path
from dronevio.models.state import Trajectory

Array = npt.NDArray[np.float64]

_LENGTH_TOLERANCE = 0.2  # by what share of its length a sub-trajectory may miss it, as in the metrics
_NEES_LEAST, _NEES_MOST = 1e-2, 1e4  # what lies beyond is drawn there
_HISTOGRAM_BINS = 40


@dataclass(frozen=True)
class Side:
    """A direction to look at a path from."""

    title: str
    """What a picture from there is called."""
    across: int
    """Axis of the world, 0 to 2, that runs to the right."""
    up: int
    """Axis of the world that runs upwards."""


ABOVE = Side("Path from above", 0, 1)
FRONT = Side("Path from the side", 0, 2)


def draw_path(ax: Axes, side: Side, estimate: Trajectory, truth: Trajectory | None, outline: Array) -> None:
    """Draw a path beside the true one, to scale; a ring where the truth starts, a square where it ends.

    Args:
        ax: Where to draw.
        side: From where to look.
        estimate: The estimated path, in the truth's world.
        truth: The true path, where it is known.
        outline: (L, 2, 3) Line segments of the surroundings [m].
    """
    axes = [side.across, side.up]
    ax.add_collection(LineCollection(list(outline[:, :, axes]), colors=palette.ROOM, linewidths=0.8, alpha=0.6))
    if truth is not None:
        draw_line(ax, truth.p_world_imu[:, axes], color=palette.TRUTH, linewidth=2.6, alpha=0.75, label="truth")
    draw_line(ax, estimate.p_world_imu[:, axes], color=palette.ESTIMATE, linewidth=1.2, label="estimate")
    flown = estimate if truth is None else truth
    if len(flown):
        for row, marker, label in ((0, "o", "start"), (-1, "s", "end")):
            x, y = flown.p_world_imu[row, axes]
            ax.plot(x, y, marker, color=INK, markerfacecolor="none", markersize=7, linestyle="none", label=label)
    ax.set_aspect("equal", adjustable="datalim")
    ax.autoscale_view()
    ax.set(title=side.title, xlabel=f"{'xyz'[side.across]} [m]", ylabel=f"{'xyz'[side.up]} [m]")


def draw_position_error(ax: Axes, scored: ScoredTrajectory, origin_ns: int) -> None:
    """Draw the position error over time: after alignment, and tied at the first pose with its 3σ band."""
    stated = scored.consistency
    if stated is not None:
        t_ns, error = stated.t_ns - origin_ns, stated.position_error_m
        _draw_band(ax, t_ns, error, stated.position_sigma_m, label="tied at the first pose")
    _draw_aligned(ax, scored.truth.t_ns - origin_ns, scored.translation_error_m)
    _label_times(ax, "Position error over time", "position error [m]")


def draw_orientation_error(ax: Axes, scored: ScoredTrajectory, origin_ns: int) -> None:
    """Draw the orientation error over time: after alignment, and tied at the first pose with its 3σ band."""
    stated = scored.consistency
    if stated is not None:
        t_ns, error = stated.t_ns - origin_ns, np.degrees(stated.orientation_error_rad)
        _draw_band(ax, t_ns, error, np.degrees(stated.orientation_sigma_rad), label="tied at the first pose")
    _draw_aligned(ax, scored.truth.t_ns - origin_ns, np.degrees(scored.rotation_error_rad))
    _label_times(ax, "Orientation error over time", "orientation error [°]")


def draw_speed(ax: Axes, estimate: Trajectory, truth: Trajectory | None, origin_ns: int) -> None:
    """Draw the true and the estimated speed over time."""
    for trajectory, label, colour, width in (
        (truth, "truth", palette.TRUTH, 2.6),
        (estimate, "estimate", palette.ESTIMATE, 1.2),
    ):
        if trajectory is not None and trajectory.velocity_m_s is not None:
            speed = np.linalg.norm(trajectory.velocity_m_s, axis=1)
            seconds = (trajectory.t_ns - origin_ns) * 1e-9
            draw_line(ax, np.stack([seconds, speed], axis=1), color=colour, linewidth=width, label=label)
    _label_times(ax, "Speed over time", "speed [m/s]")


@dataclass(frozen=True)
class StateError:
    """A part of the state besides the pose, of which the truth may be known."""

    title: str
    """What a picture of its error is called."""
    axis: str
    """What stands at its axis, with the unit."""
    first: int
    """Where its three entries of the covariance begin."""
    of: Callable[[Trajectory], Array | None]
    """Picks it (N, 3) from a trajectory."""
    factor: float = 1.0
    """From SI units to those of the picture."""

    def known(self, scored: ScoredTrajectory) -> bool:
        """Say whether both truth and estimate have it."""
        return self.of(scored.truth) is not None and self.of(scored.estimate) is not None


STATE_ERRORS = (
    StateError("Velocity error over time", "velocity error [m/s]", 6, lambda t: t.velocity_m_s),
    StateError(
        "Gyroscope bias error over time", "bias error [°/s]", 9, lambda t: t.gyro_bias_rad_s, float(np.degrees(1.0))
    ),
    StateError("Accelerometer bias error over time", "bias error [m/s²]", 12, lambda t: t.accel_bias_m_s2),
)
"""What else than the pose an estimator estimates."""


def draw_state_error(ax: Axes, what: StateError, scored: ScoredTrajectory, origin_ns: int) -> None:
    """Draw the size of an error over time, where it is `StateError.known`, with its 3σ band where one is claimed."""
    true, estimated = what.of(scored.truth), what.of(scored.estimate)
    assert true is not None and estimated is not None
    t_ns, error = scored.truth.t_ns - origin_ns, what.factor * (true - estimated)
    covariance = scored.estimate.covariance
    if covariance is None:
        _draw_aligned(ax, t_ns, np.linalg.norm(error, axis=1))
    else:
        variance = np.diagonal(covariance, axis1=1, axis2=2)[:, what.first : what.first + 3]
        _draw_band(ax, t_ns, error, what.factor * np.sqrt(variance), label="aligned", colour=palette.ESTIMATE)
    _label_times(ax, what.title, what.axis)


def draw_nees(ax: Axes, scored: ScoredTrajectory, origin_ns: int) -> None:
    """Draw the NEES of position and orientation over time, with the bounds that 95 % of honest poses keep."""
    stated = scored.consistency
    assert stated is not None
    seconds = (stated.t_ns - origin_ns) * 1e-9
    low, high = nees_bounds(3)
    ax.axhspan(low, high, color=palette.ROOM, alpha=0.18, linewidth=0.0, label="95 % of χ², 3 degrees of freedom")
    ax.axhline(3.0, color=INK, linewidth=0.8, linestyle="--")
    for values, colour, label in (
        (stated.position_nees, palette.ESTIMATE, "position"),
        (stated.orientation_nees, palette.CLAIM, "orientation"),
    ):
        shown = np.clip(values, _NEES_LEAST, _NEES_MOST)
        draw_line(ax, np.stack([seconds, shown], axis=1), color=colour, linewidth=1.0, label=label)
    most = max(stated.position_nees.max(), stated.orientation_nees.max(), high)
    set_log_scale(ax, "y", _NEES_LEAST, min(2.0 * float(most), _NEES_MOST))
    ax.set(title="Consistency: NEES over time", xlabel="time [s]", ylabel="NEES [–], 3 expected")
    ax.margins(x=0.01)


class ErrorsByLength(NamedTuple):
    """Errors of all sub-trajectories of each of some lengths."""

    labels: tuple[str, ...]
    """The lengths, for people."""
    translation_percent: tuple[Array, ...]
    """(M,) for each: relative errors of position [% of the length]."""
    rotation_deg: tuple[Array, ...]
    """(M,) for each: relative errors of orientation [°]."""


def errors_by_length(scored: ScoredTrajectory) -> ErrorsByLength:
    """Return the errors behind the lengths in the scores, those that occur on the path."""
    truth, estimate = scored.truth, scored.estimate
    poses = truth.p_world_imu, truth.quat_wxyz, estimate.p_world_imu, estimate.quat_wxyz
    translation, rotation = [], []
    lengths_m = [errors.length_m for errors in scored.scores.lengths]
    for length_m in lengths_m:
        pairs = pairs_after_distance(truth.p_world_imu, length_m, _LENGTH_TOLERANCE * length_m)
        errors_m, errors_rad = relative_errors(*poses, pairs)
        translation.append(100.0 / length_m * errors_m)
        rotation.append(np.degrees(errors_rad))
    return ErrorsByLength(tuple(f"{length_m:.3g}" for length_m in lengths_m), tuple(translation), tuple(rotation))


def draw_length_errors(ax: Axes, labels: tuple[str, ...], values: tuple[Array, ...], title: str, axis: str) -> None:
    """Draw a box of errors for each length of sub-trajectories."""
    draw_boxes(ax, labels, [Boxes("estimate", palette.ESTIMATE, values)])
    ax.set(title=title, xlabel="length of the sub-trajectory [m]", ylabel=axis)


def draw_cost(ax: Axes, run: EstimatorRun, origin_ns: int, frame_interval_ms: float) -> None:
    """Draw what each frame cost, and what it may cost to keep up with the camera on one core."""
    seconds = (run.t_ns - origin_ns) * 1e-9
    ax.plot(seconds, run.cpu_ms, ".", color=palette.BAND, markersize=2.5)
    if np.max(run.cpu_ms, initial=0.0) > 0.3 * frame_interval_ms:
        ax.axhline(frame_interval_ms, color=INK, linewidth=0.8, linestyle="--", label="time between frames")
    _label_times(ax, "Processor time a frame", "processor time [ms]")


def draw_cost_histogram(ax: Axes, run: EstimatorRun) -> None:
    """Draw how many frames cost how much, with the mean and what 99 % of them stay under."""
    mean, most = float(run.cpu_ms.mean()), float(np.percentile(run.cpu_ms, 99))
    ax.hist(run.cpu_ms, bins=_HISTOGRAM_BINS, color=palette.BAND, linewidth=0.0)
    ax.axvline(mean, color=INK, linewidth=1.0, label=f"mean, {mean:.1f} ms")
    ax.axvline(most, color=INK, linewidth=1.0, linestyle="--", label=f"99 % are under {most:.1f} ms")
    ax.set(title="Processor time: how often", xlabel="processor time a frame [ms]", ylabel="number of frames")
    ax.set_xlim(left=0.0)


def _draw_aligned(ax: Axes, t_ns: Times, error: Array) -> None:
    ax.plot(t_ns * 1e-9, error, color=palette.ESTIMATE, label="aligned")


def _draw_band(ax: Axes, t_ns: Times, error: Array, sigma: Array, label: str, colour: str = INK) -> None:
    """Draw the size of errors (N, 3) with three times the size that the estimator expects of them."""
    seconds = t_ns * 1e-9
    band = 3.0 * np.linalg.norm(sigma, axis=1)
    ax.fill_between(seconds, 0.0, band, color=palette.BAND, alpha=0.25, linewidth=0.0, label="3σ, as claimed")
    ax.plot(seconds, np.linalg.norm(error, axis=1), color=colour, linewidth=0.9, label=label)


def _label_times(ax: Axes, title: str, axis: str) -> None:
    ax.set(title=title, xlabel="time [s]", ylabel=axis)
    ax.set_ylim(bottom=0.0)
    ax.margins(x=0.01)


def write_score_plot(path: Path, scored: ScoredTrajectory) -> None:
    """Draw an estimate beside the truth into a PNG file.

    Args:
        path: Where to; folders that are missing on the way are made.
        scored: The estimate beside the truth.

    Raises:
        InputError: A folder is there, or a file where one of its folders should be.
    """
    check_output_path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    origin_ns = int(scored.truth.t_ns[0])
    with figure(14.0, 4.6, columns=3) as (fig, axes):
        draw_path(axes[0], ABOVE, scored.estimate, scored.truth, np.zeros((0, 2, 3)))
        draw_position_error(axes[1], scored, origin_ns)
        draw_orientation_error(axes[2], scored, origin_ns)
    save_png(fig, path)
