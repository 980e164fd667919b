"""Numbers and Markdown tables of the scripts that measure the odometry."""

import math
from collections.abc import Iterable, Sequence


def numbers(text: str) -> tuple[int, ...]:
    """Return the numbers that a text such as ``0-4`` or ``0,2,5-7`` lists.

    Raises:
        ValueError: The text lists no numbers.
    """
    found: list[int] = []
    for part in text.split(","):
        first, _, last = part.partition("-")
        found += range(int(first), int(last or first) + 1)
    if not found:
        raise ValueError(f"{text!r} lists no number; expected a text such as 0-4 or 0,2,5")
    return tuple(dict.fromkeys(found))


def text(value: float | None, form: str = ".3f") -> str:
    """Return a number as text for a table: a dash for None and NaN, ∞ for a failed run.

    Args:
        value: The number.
        form: Format specification of finite numbers.
    """
    if value is None or math.isnan(value):
        return "–"
    return "∞" if math.isinf(value) else format(value, form)


def table(headings: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1) -> str:
    """Return a Markdown table.

    Args:
        headings: Headings of the columns.
        rows: Cells of each row.
        left: Number of left-aligned columns; the others are right-aligned.
    """
    rule = [":---" if column < left else "---:" for column in range(len(headings))]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (headings, rule, *rows))
