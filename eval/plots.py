"""Pictures of a flight: paths, errors and speed, in one style, for people with any colour vision.

Each function draws into axes that it is given; `figure` makes them, `as_svg` and `save_png` turn the figure into
something to look at. Nothing touches matplotlib's global state but the style, and that only while a figure is drawn.
"""

import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from dronevio.eval import palette
from dronevio.eval.metrics import ScoredTrajectory
from dronevio.eval.runs import EstimatorRun
from dronevio.models.state import Trajectory

Array = npt.NDArray[np.float64]

INK = "#1f2328"
"""Colour of text and axes; an SVG's reader may replace it, for a dark page."""
GRID = "#d0d7de"
"""Colour of grid lines; likewise."""

_MOST_POINTS = 1500  # of one line: more than that no screen shows
_STYLE: dict[Any, Any] = {
    "axes.edgecolor": GRID,
    "axes.grid": True,
    "axes.labelcolor": INK,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlecolor": INK,
    "axes.titlelocation": "left",
    "axes.titlesize": 10.0,
    "axes.titleweight": "bold",
    "axes.axisbelow": True,
    "font.size": 9.0,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.4,
    "lines.solid_capstyle": "round",
    "svg.fonttype": "none",
    "svg.hashsalt": "dronevio",  # same data, same bytes
    "text.color": INK,
    "xtick.color": GRID,
    "xtick.labelcolor": INK,
    "ytick.color": GRID,
    "ytick.labelcolor": INK,
}


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


@contextmanager
def figure(width_in: float, height_in: float, columns: int = 1) -> Iterator[tuple[Figure, Sequence[Axes]]]:
    """Make a figure with axes side by side, in the house's style; draw while the context lasts.

    The legend of the first axes stands below them all, where it hides nothing.
    """
    with mpl.rc_context(_STYLE):
        fig = Figure(figsize=(width_in, height_in), layout="constrained")
        axes = list(np.atleast_1d(fig.subplots(1, columns)))
        yield fig, axes
        handles, labels = axes[0].get_legend_handles_labels()
        if handles:
            fig.legend(handles, labels, loc="outside lower center", ncols=4)


def as_svg(fig: Figure) -> str:
    """Return a figure as an ``<svg>`` element, without a background, to be put into a page."""
    buffer = io.StringIO()
    with mpl.rc_context(_STYLE):
        fig.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    text = buffer.getvalue()
    return re.sub(r"<metadata>.*?</metadata>", "", text[text.index("<svg") :], flags=re.DOTALL)


def save_png(fig: Figure, path: Path, dpi: int = 160) -> None:
    """Write a figure as a PNG on white."""
    with mpl.rc_context(_STYLE):
        fig.savefig(path, dpi=dpi, facecolor="white")


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
        _draw_line(ax, truth.p_world_imu[:, axes], color=palette.TRUTH, linewidth=2.6, alpha=0.75, label="truth")
    _draw_line(ax, estimate.p_world_imu[:, axes], color=palette.ESTIMATE, linewidth=1.2, label="estimate")
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
        _draw_band(ax, stated.t_ns - origin_ns, stated.position_error_m, stated.position_sigma_m)
    _draw_aligned(ax, scored.truth.t_ns - origin_ns, scored.translation_error_m)
    _label_times(ax, "Position error over time", "m")


def draw_orientation_error(ax: Axes, scored: ScoredTrajectory, origin_ns: int) -> None:
    """Draw the orientation error over time: after alignment, and tied at the first pose with its 3σ band."""
    stated = scored.consistency
    if stated is not None:
        sigma = np.degrees(stated.orientation_sigma_rad)
        _draw_band(ax, stated.t_ns - origin_ns, np.degrees(stated.orientation_error_rad), sigma)
    _draw_aligned(ax, scored.truth.t_ns - origin_ns, np.degrees(scored.rotation_error_rad))
    _label_times(ax, "Orientation error over time", "°")


def draw_speed(ax: Axes, estimate: Trajectory, truth: Trajectory | None, origin_ns: int) -> None:
    """Draw the true and the estimated speed over time."""
    for trajectory, label, colour, width in (
        (truth, "truth", palette.TRUTH, 2.6),
        (estimate, "estimate", palette.ESTIMATE, 1.2),
    ):
        if trajectory is not None and trajectory.velocity_m_s is not None:
            speed = np.linalg.norm(trajectory.velocity_m_s, axis=1)
            seconds = (trajectory.t_ns - origin_ns) * 1e-9
            _draw_line(ax, np.stack([seconds, speed], axis=1), color=colour, linewidth=width, label=label)
    ax.set_ylim(bottom=0.0)
    _label_times(ax, "Speed over time", "m/s")


def draw_cost(ax: Axes, run: EstimatorRun, origin_ns: int, frame_interval_ms: float) -> None:
    """Draw what each frame cost, and what it may cost to keep up with the camera on one core."""
    seconds = (run.t_ns - origin_ns) * 1e-9
    ax.plot(seconds, run.cpu_ms, ".", color=palette.BAND, markersize=2.5)
    if np.max(run.cpu_ms, initial=0.0) > 0.3 * frame_interval_ms:
        ax.axhline(frame_interval_ms, color=INK, linewidth=0.8, linestyle="--", label="time between frames")
    ax.set_ylim(bottom=0.0)
    _label_times(ax, "Processor time a frame", "ms")


def _draw_line(ax: Axes, points: Array, **style: Any) -> None:
    """Draw a line through points (N, 2), leaving out what nobody could see."""
    step = max(1, len(points) // _MOST_POINTS)
    kept = np.concatenate([points[::step], points[-1:]])
    ax.plot(kept[:, 0], kept[:, 1], **style)


def _draw_aligned(ax: Axes, t_ns: npt.NDArray[np.int64], error: Array) -> None:
    ax.plot(t_ns * 1e-9, error, color=palette.ESTIMATE, label="aligned")


def _draw_band(ax: Axes, t_ns: npt.NDArray[np.int64], error: Array, sigma: Array) -> None:
    """Draw the size of errors (N, 3) with three times the size that the estimator expects of them."""
    seconds = t_ns * 1e-9
    band = 3.0 * np.linalg.norm(sigma, axis=1)
    ax.fill_between(seconds, 0.0, band, color=palette.BAND, alpha=0.25, linewidth=0.0, label="3σ, as claimed")
    ax.plot(seconds, np.linalg.norm(error, axis=1), color=INK, linewidth=0.9, label="tied at the first pose")


def _label_times(ax: Axes, title: str, unit: str) -> None:
    ax.set(title=title, xlabel="time [s]", ylabel=f"[{unit}]")
    ax.set_ylim(bottom=0.0)
    ax.margins(x=0.01)
