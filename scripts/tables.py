"""Numbers and tables, as the scripts that measure read and print them."""

import math
import statistics
from collections.abc import Iterable, Sequence


def numbers(text: str) -> tuple[int, ...]:
    """Return the numbers that a text such as ``0-4`` or ``0,2,5-7`` names.

    Raises:
        ValueError: It names none.
    """
    found: list[int] = []
    for part in text.split(","):
        first, _, last = part.partition("-")
        found += range(int(first), int(last or first) + 1)
    if not found:
        raise ValueError(f"{text!r} names no seed; expected such as 0-4 or 0,2,5")
    return tuple(dict.fromkeys(found))


def median(values: Iterable[float | None]) -> float:
    """Return the median, failed runs (infinite) included; nan of none or where one is not known."""
    known = list(values)
    return math.nan if not known or None in known else float(statistics.median(v for v in known if v is not None))


def geometric_mean(values: Sequence[float]) -> float:
    """Return the geometric mean of positive numbers; nan of none."""
    return math.exp(math.fsum(math.log(value) for value in values) / len(values)) if values else math.nan


def text(value: float | None, form: str = ".3f") -> str:
    """Return a number for a table: a dash where there is none, ∞ where a run failed."""
    if value is None or math.isnan(value):
        return "–"
    return "∞" if math.isinf(value) else format(value, form)


def table(headings: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1) -> str:
    """Return a Markdown table whose first ``left`` columns hold words."""
    rule = [":---" if column < left else "---:" for column in range(len(headings))]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (headings, rule, *rows))
