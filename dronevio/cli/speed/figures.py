"""Figures of a benchmark, for people and for machines."""

from collections.abc import Sequence
from dataclasses import asdict

from dronevio.cli.terminal import print_table
from dronevio.models.performance import Figure


def print_figures(title: str, figures: Sequence[Figure]) -> None:
    """Print figures beside their bounds, and how each was measured."""
    print_table(
        title,
        ("", "measured", "bound", "ratio", ""),
        [
            (
                figure.name,
                f"{figure.value:.3g} {figure.unit}".strip(),
                f"{'≤' if figure.sense == 'at most' else '≥'} {figure.bound:g}",
                f"{figure.ratio:.2f}",
                "met" if figure.met else "missed",
            )
            for figure in figures
        ],
    )
    for figure in figures:
        print(f"{figure.name}: {figure.how}")


def plain_figures(figures: Sequence[Figure]) -> list[dict[str, object]]:
    """Return figures as a document for machines has them."""
    return [{**asdict(figure), "ratio": figure.ratio, "met": figure.met} for figure in figures]
