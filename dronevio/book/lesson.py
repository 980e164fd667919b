"""Tables of explained values for the commands of the book: each value has its unit and one line on its meaning."""

import sys
import textwrap
from collections.abc import Sequence

from dronevio.cli.terminal import print_table

_WIDTH = 110


def print_lesson(title: str, section: str, module: str, rows: Sequence[tuple[str, str, str, str]]) -> None:
    """Print a table of explained values.

    Args:
        title: Line above the table.
        section: Section of the book that the values belong to.
        module: Module that computes them.
        rows: Name, value, unit and explanation of each value; the unit of a pure number is ``1``.
    """
    print_table(
        f"{title}\nBook: section {section}. Code: {module}",
        ("", "value", "unit", "meaning"),
        rows,
        left=("unit", "meaning"),
    )


def print_paragraph(text: str) -> None:
    """Print a paragraph, wrapped, with an empty line after it."""
    sys.stdout.write(textwrap.fill(" ".join(text.split()), _WIDTH) + "\n\n")
