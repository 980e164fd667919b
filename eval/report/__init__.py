"""Reports of runs and benchmarks: HTML pages, JSON, plots and tables."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.eval.report.plots import write_score_plot
    from dronevio.eval.report.reconstruction.files import write_reconstruction_report
    from dronevio.eval.report.reconstruction.model import ReconstructionResults
    from dronevio.eval.report.run import write_report

__all__ = [
    "ReconstructionResults",
    "write_reconstruction_report",
    "write_report",
    "write_score_plot",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.eval.report.plots": ("write_score_plot",),
        "dronevio.eval.report.reconstruction.files": ("write_reconstruction_report",),
        "dronevio.eval.report.reconstruction.model": ("ReconstructionResults",),
        "dronevio.eval.report.run": ("write_report",),
    },
)
