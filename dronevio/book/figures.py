"""Files of figures."""

from pathlib import Path

import matplotlib
from matplotlib.figure import Figure

_DPI = 120


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure to an image file, in the format of its suffix; the same figure gives the same file."""
    with matplotlib.rc_context({"svg.hashsalt": "dronevio"}):
        figure.savefig(path, dpi=_DPI, metadata={"Date": None} if path.suffix == ".svg" else None)
