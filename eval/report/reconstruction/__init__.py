"""The report of a reconstruction from images: an HTML page with pictures, its values as JSON, and a picture."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.eval.report.reconstruction.files import write_reconstruction_report
    from dronevio.eval.report.reconstruction.model import ReconstructionResults

__all__ = [
    "ReconstructionResults",
    "write_reconstruction_report",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.eval.report.reconstruction.files": ("write_reconstruction_report",),
        "dronevio.eval.report.reconstruction.model": ("ReconstructionResults",),
    },
)
