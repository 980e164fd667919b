"""Results as they are shown: a line of text in a terminal, tables in a notebook."""

from collections.abc import Sequence
from html import escape

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array

Row = tuple[str, ...]
Times = npt.NDArray[np.int64]

_TABLE = "border-collapse: collapse; margin: 0.3em 0 0.8em"
_CELL = "padding: 0.15em 0.8em 0.15em 0; text-align: {}; vertical-align: top; font-variant-numeric: tabular-nums"
_CAPTION = "caption-side: top; text-align: left; font-weight: bold; padding: 0.2em 0; color: inherit"


class Summarized:
    """A result with a summary in place of all its values, which would fill many pages.

    A dataclass that inherits from it is declared with ``repr=False``.
    """

    def _summary(self) -> Sequence[tuple[str, str]]:
        """Return the quantities of the summary as pairs of a label and a value with its unit."""
        raise NotImplementedError

    def __repr__(self) -> str:
        quantities = "; ".join(f"{label}: {value}" for label, value in self._summary())
        return f"<{type(self).__name__}, {quantities}>"

    def _repr_html_(self) -> str:
        """Return the summary as HTML, by which notebooks show it."""
        return html_table(type(self).__name__, self._summary())


def html_table(title: str, rows: Sequence[Row], columns: Row = ()) -> str:
    """Return an HTML table in the colours of the page that contains it; all text is escaped.

    Args:
        title: Caption.
        rows: (R) Rows of C cells each, of which the first names the row.
        columns: (C) Headings of the columns; empty for none.
    """
    head = f"<thead><tr>{_cells('th', columns)}</tr></thead>" if columns else ""
    body = "".join(f"<tr>{_cells('td', row)}</tr>" for row in rows)
    caption = f'<caption style="{_CAPTION}">{escape(title)}</caption>'
    return f'<table style="{_TABLE}">{caption}{head}<tbody>{body}</tbody></table>'


def duration_text(t_ns: Times) -> str:
    """Return the time from the first to the last of time stamps (N,) [ns] as text in seconds."""
    return f"{float(np.ptp(t_ns)) * 1e-9 if len(t_ns) else 0.0:.2f} s"


def size_text(points: Array) -> str:
    """Return the sides of the box along the axes that encloses points (N, 3) [m] as text; a dash without points."""
    return " × ".join(f"{side:.2f}" for side in np.ptp(points, axis=0)) + " m" if len(points) else "–"


def _cells(tag: str, row: Row) -> str:
    """Return the cells of a row: text on the left, numbers of a table with several columns on the right."""
    aligned = ("left", *["left" if len(row) == 2 else "right"] * (len(row) - 1))
    cells = zip(row, aligned, strict=True)
    return "".join(f'<{tag} style="{_CELL.format(align)}">{escape(text)}</{tag}>' for text, align in cells)
