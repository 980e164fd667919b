"""The report of a benchmark: an HTML page, and tables as Markdown, LaTeX and CSV."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.eval.report.benchmark.page import benchmark_page

__all__ = [
    "benchmark_page",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.eval.report.benchmark.page": ("benchmark_page",),
    },
)
