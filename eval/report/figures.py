"""Figures of reports: one style, output as SVG or PNG, and lines, box plots and logarithmic axes.

`figure` makes axes to draw into; `as_svg` and `save_png` convert the figure. Matplotlib's global state is changed only
while a figure is drawn. The same data give the same bytes.
"""

import io
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from dronevio.eval import colours
from dronevio.models.arrays import Array

INK = "#1f2328"
"""Colour of text and axes; pages replace it by one of the light or dark mode."""
GRID = "#d0d7de"
"""Colour of grid lines; pages replace it likewise."""

_PAGE_COLOURS = {INK: "ink", GRID: "grid", colours.SECOND: "blue"}  # replaced by variables of the style sheet
_MAX_POINTS = 1500  # of one line, more than a screen resolves
_WHISKERS_PERCENT = (5.0, 95.0)
_BOX_SHARE = 0.8  # of the distance between two groups that boxes take
_MAX_BOX_WIDTH = 0.22  # in units of the same distance
_MAX_RATIO_FOR_1_2_5 = 1e3  # of the limits of a logarithmic axis whose ticks are at 1, 2 and 5
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
    "svg.hashsalt": "dronevio",  # the same data give the same bytes
    "text.color": INK,
    "text.parse_math": False,  # a dollar sign in a name is a dollar sign
    "xtick.color": GRID,
    "xtick.labelcolor": INK,
    "ytick.color": GRID,
    "ytick.labelcolor": INK,
}
_COORDINATES = re.compile(r' (?:d|x|y|transform)="[^"]*"')
_LONG_FRACTION = re.compile(r"-?\d+\.\d{3,}")


@dataclass(frozen=True, eq=False)
class Boxes:
    """Box plots of one colour, one in each group."""

    label: str
    """Name in the legend."""
    colour: str
    """Colour of the boxes."""
    values: Sequence[Array]
    """Values of each group; a group without values has no box."""


class ShownFigure(Figure):
    """A figure that notebooks show, also where pyplot is not imported."""

    def _repr_png_(self) -> bytes:
        """Return the figure as PNG, by which notebooks show it."""
        buffer = io.BytesIO()
        save_png(self, buffer, dpi=100)
        return buffer.getvalue()


@contextmanager
def figure(
    width_in: float, height_in: float, columns: int = 1, legend_columns: int = 4, rows: int = 1
) -> Iterator[tuple[Figure, Sequence[Axes]]]:
    """Yield a figure with axes in rows and columns, in the style of reports, to draw into while the context lasts.

    The legend of the first axes is placed below all axes.
    """
    with mpl.rc_context(_STYLE):
        fig = ShownFigure(figsize=(width_in, height_in), layout="constrained")
        axes = list(np.ravel(fig.subplots(rows, columns)))
        yield fig, axes
        handles, labels = axes[0].get_legend_handles_labels()
        if handles:
            fig.legend(handles, labels, loc="outside lower center", ncols=legend_columns)


def as_svg(fig: Figure, alt: str) -> Markup:
    """Return a figure as an ``<svg>`` element without background, to be inserted into a page.

    Args:
        fig: The figure.
        alt: Description for readers who cannot see it.
    """
    buffer = io.StringIO()
    with mpl.rc_context(_STYLE):
        fig.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    text = buffer.getvalue()
    text = re.sub(r"<metadata>.*?</metadata>\s*", "", text[text.index("<svg") :], flags=re.DOTALL)
    text = re.sub(r"<!--.*?-->\s*", "", text, flags=re.DOTALL)
    text = re.sub(r'<g id="[^"]*"', "<g", text)  # the figures of a page would share these ids
    text = _COORDINATES.sub(lambda m: _LONG_FRACTION.sub(_rounded, m[0]), text)
    for colour, name in _PAGE_COLOURS.items():
        text = text.replace(colour, f"var(--{name})")
    return Markup('<svg role="img" aria-label="{}"').format(alt) + Markup(text.removeprefix("<svg"))


def svg_plot(height_in: float, draw: Callable[[Axes], None], alt: str = "", width_in: float = 4.8) -> Markup:
    """Return a plot with one pair of axes as an ``<svg>`` element.

    Args:
        height_in: Height [in].
        draw: Draws into the axes.
        alt: Description after the title for readers who cannot see the plot.
        width_in: Width [in].
    """
    with figure(width_in, height_in) as (fig, axes):
        draw(axes[0])
    title = axes[0].get_title(loc="left")
    return as_svg(fig, f"{title}: {alt}" if alt else title)


def save_png(fig: Figure, path: Path | io.BytesIO, dpi: int = 160) -> None:
    """Write a figure on white as PNG, into a file or a buffer."""
    with mpl.rc_context(_STYLE):
        fig.savefig(path, dpi=dpi, facecolor="white")


def draw_line(ax: Axes, points: Array, **style: Any) -> None:
    """Draw a line through points (N, 2), thinned to what a screen resolves."""
    step = max(1, len(points) // _MAX_POINTS)
    kept = np.concatenate([points[::step], points[-1:]])
    ax.plot(kept[:, 0], kept[:, 1], **style)


def draw_boxes(ax: Axes, groups: Sequence[str], rows: Sequence[Boxes]) -> None:
    """Draw box plots side by side in groups: median, quartiles, and whiskers from the 5th to the 95th percentile."""
    step = _BOX_SHARE / max(len(rows), 1)
    width = min(0.85 * step, _MAX_BOX_WIDTH)
    for i, row in enumerate(rows):
        offset = (i - 0.5 * (len(rows) - 1)) * min(step, 1.2 * _MAX_BOX_WIDTH)
        drawn = [(k + offset, v) for k, v in enumerate(row.values) if len(v)]
        line = {"color": row.colour, "linewidth": 1.1}
        if drawn:
            ax.boxplot(
                [v for _, v in drawn],
                positions=[x for x, _ in drawn],
                widths=width,
                whis=_WHISKERS_PERCENT,
                showfliers=False,
                showcaps=False,
                manage_ticks=False,
                patch_artist=True,
                boxprops={"facecolor": f"{row.colour}55", "edgecolor": row.colour, "linewidth": 1.1},
                whiskerprops=line,
                medianprops={"color": INK, "linewidth": 1.6},
            )
        if len(rows) > 1:
            ax.fill([], [], facecolor=f"{row.colour}55", edgecolor=row.colour, label=row.label)
    ax.set_xticks(range(len(groups)), groups)
    ax.set_xlim(-0.6, len(groups) - 0.4)
    ax.grid(visible=False, axis="x")
    ax.set_ylim(bottom=0.0)


def set_log_scale(ax: Axes, which: Literal["x", "y"], low: float, high: float) -> None:
    """Make an axis logarithmic from low to high with plain numbers, at 1, 2 and 5 if there are few decades."""
    ax.set(**{f"{which}scale": "log", f"{which}lim": (low, high)})
    axis = ax.xaxis if which == "x" else ax.yaxis
    few = high < _MAX_RATIO_FOR_1_2_5 * low
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if few else (1.0,), numticks=12))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())


def _rounded(number: re.Match[str]) -> str:
    """Return a coordinate rounded to a hundredth of a point."""
    return f"{float(number[0]):.2f}".rstrip("0").rstrip(".")
