"""Plots of a reconstruction: reprojection errors, tracks, residual fields, matches, and positions.

Each function draws into axes that it is given.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm
from matplotlib.ticker import FuncFormatter, MaxNLocator

from dronevio.eval import colours
from dronevio.eval.metrics.reconstruction import PositionComparison, ResidualField
from dronevio.eval.report.figures import INK, set_log_scale
from dronevio.eval.scene import round_down
from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel

Indices = npt.NDArray[np.int64]

_LARGEST_ERROR_PERCENT = 99.5  # percentile at which the histogram of errors ends
_HISTOGRAM_BINS = 60
_MAX_TRACK_LENGTH = 40  # longer tracks are drawn together
_MIN_TRACK_AXIS = 6  # smallest end of the axis of track lengths
_MAX_LABELLED_IMAGES = 12  # of a matrix whose cells bear numbers
_ARROW_CELLS = 1.2  # length of an arrow at the 95th percentile, in cells


def draw_error_histogram(ax: Axes, errors_px: Array) -> None:
    """Draw a histogram of the reprojection errors (E,), E > 0, with their median and 95th percentile."""
    median, percentile, last = np.percentile(errors_px, [50.0, 95.0, _LARGEST_ERROR_PERCENT]).tolist()
    beyond = int(np.sum(errors_px > last))
    ax.hist(errors_px[errors_px <= last], bins=_HISTOGRAM_BINS, color=colours.SIGMA, linewidth=0.0)
    ax.axvline(median, color=INK, linewidth=1.0, label=f"median, {median:.2f} px")
    ax.axvline(percentile, color=INK, linewidth=1.0, linestyle="--", label=f"95th percentile, {percentile:.2f} px")
    more = f", {beyond} larger ones not shown" if beyond else ""
    ax.set(title="Reprojection errors", xlabel=f"reprojection error [px]{more}", ylabel="number of observations")
    ax.set_xlim(left=0.0)


def draw_track_lengths(ax: Axes, lengths: Indices) -> None:
    """Draw how many points (N,), N > 0, have each number of observations."""
    counts = np.bincount(np.minimum(lengths, _MAX_TRACK_LENGTH))
    first = int(np.flatnonzero(counts)[0])
    ax.bar(np.arange(first, len(counts)), counts[first:], color=colours.SIGMA, width=0.85)
    set_log_scale(ax, "y", 0.7, 1.5 * float(counts.max()))
    ax.set_xlim(min(first, 2) - 0.6, max(len(counts) - 1, _MIN_TRACK_AXIS) + 0.6)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.grid(visible=False, axis="x")
    more = f" ({_MAX_TRACK_LENGTH}: or more)" if lengths.max() > _MAX_TRACK_LENGTH else ""
    ax.set(title="Track lengths", xlabel=f"number of observations of a point{more}", ylabel="number of points")


def draw_observations_per_image(ax: Axes, counts: Sequence[int]) -> None:
    """Draw the number of observations of all images in their order; an image that is not registered has none."""
    ax.bar(np.arange(1, len(counts) + 1), counts, color=colours.SIGMA, width=0.85 if len(counts) < 100 else 1.0)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.grid(visible=False, axis="x")
    ax.set(title="Observations per image", xlabel="number of the image", ylabel="number of observations")


def draw_error_per_image(ax: Axes, medians_px: Sequence[float]) -> None:
    """Draw the median reprojection error of all images in their order; NaN for none."""
    width = 0.85 if len(medians_px) < 100 else 1.0
    ax.bar(np.arange(1, len(medians_px) + 1), medians_px, color=colours.SIGMA, width=width)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.grid(visible=False, axis="x")
    ax.set(title="Reprojection error per image", xlabel="number of the image", ylabel="median error [px]")


def draw_residual_field(ax: Axes, field: ResidualField, model: CameraModel, title: str) -> None:
    """Draw the mean residual of each cell of the image as an arrow, with a key of its length in pixels."""
    known = np.isfinite(field.mean_px[..., 0])
    centres, mean = field.centres_px[known], field.mean_px[known]
    ax.set(xlim=(-0.5, model.width - 0.5), ylim=(model.height - 0.5, -0.5), title=title)
    ax.set(xlabel="column [px]", ylabel="row [px]")
    ax.set_aspect("equal")
    ax.grid(visible=False)
    if not len(mean):
        return
    largest = float(np.percentile(np.linalg.norm(mean, axis=1), 95.0))
    cell_px = model.width / field.counts.shape[1]
    key_px = round_down(largest)
    arrows = ax.quiver(
        *centres.T,
        *mean.T,
        angles="xy",
        scale_units="xy",
        scale=max(largest, np.finfo(float).tiny) / (_ARROW_CELLS * cell_px),
        color=colours.ESTIMATE,
        width=0.004,
    )
    ax.quiverkey(arrows, 0.9, 1.05, key_px, f"{key_px:g} px", labelpos="W", color=INK, labelcolor=INK)


def draw_match_counts(ax: Axes, counts: Indices) -> None:
    """Draw the numbers of verified matches (I, I) between images, I > 0; pairs without matches stay empty."""
    images = len(counts)
    shown = np.ma.masked_less_equal(counts, 0)
    largest = int(counts.max())
    if largest > 0:
        picture = ax.imshow(
            shown,
            cmap="viridis",
            norm=LogNorm(1.0, max(2.0, float(largest))),
            extent=(0.5, images + 0.5, images + 0.5, 0.5),
            interpolation="nearest",
        )
        if images <= _MAX_LABELLED_IMAGES:
            for i, j in zip(*np.nonzero(counts > 0), strict=True):
                dark = counts[i, j] > np.sqrt(largest)
                shade = "black" if dark else "white"
                ax.text(j + 1, i + 1, f"{counts[i, j]}", ha="center", va="center", fontsize=7.5, color=shade)
        else:
            bar = ax.figure.colorbar(picture, ax=ax, shrink=0.6, format=FuncFormatter(lambda value, _: f"{value:g}"))
            bar.outline.set_visible(False)
    else:
        ax.set(xlim=(0.5, images + 0.5), ylim=(images + 0.5, 0.5), aspect="equal")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(MaxNLocator(integer=True, nbins=8))
    ax.grid(visible=False)
    ax.set(title="Verified matches", xlabel="number of the image", ylabel="number of the image")


def draw_positions(ax: Axes, comparison: PositionComparison) -> None:
    """Draw the true and the aligned camera positions from above, connected by lines."""
    true, aligned = comparison.true_m[:, :2], comparison.aligned_m[:, :2]
    ax.add_collection(LineCollection(list(np.stack([true, aligned], axis=1)), colors=INK, linewidths=0.7))
    ax.plot(*true.T, "o", color=colours.TRUTH, markersize=5.0, alpha=0.75, linestyle="none", label="truth")
    ax.plot(*aligned.T, ".", color=colours.ESTIMATE, markersize=4.0, linestyle="none", label="estimate, aligned")
    ax.set_aspect("equal", adjustable="datalim")
    ax.set(title="Camera positions from above", xlabel="x [m]", ylabel="y [m]")


def draw_position_errors(ax: Axes, comparison: PositionComparison) -> None:
    """Draw the position error of each image after alignment."""
    errors = comparison.errors_m
    ax.bar(np.arange(1, len(errors) + 1), errors, color=colours.ESTIMATE, width=0.85 if len(errors) < 100 else 1.0)
    ax.axhline(comparison.rmse_m, color=INK, linewidth=1.0, linestyle="--", label=f"r.m.s., {comparison.rmse_m:.3g} m")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.grid(visible=False, axis="x")
    ax.set(title="Position errors", xlabel="image with a true position", ylabel="position error [m]")
