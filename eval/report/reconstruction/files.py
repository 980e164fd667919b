"""The files of the report of a reconstruction."""

import json
from pathlib import Path

from dronevio.eval.provenance import RunInfo
from dronevio.eval.report.figures import figure, save_png
from dronevio.eval.report.reconstruction import clouds
from dronevio.eval.report.reconstruction.model import ReconstructionResults, report_values
from dronevio.eval.report.reconstruction.page import reconstruction_page
from dronevio.eval.scene import VIEW_ASPECT
from dronevio.models.errors import EvaluationError
from dronevio.models.recordings.files import write_text

_PICTURE_WIDTH_IN, _PICTURE_DPI = 10.0, 160


def write_reconstruction_report(folder: Path, info: RunInfo, results: ReconstructionResults) -> None:
    """Write ``report.html``, ``report.json`` and ``reconstruction.png``, a picture of the first component.

    Args:
        folder: Folder for the files; it is created if it does not exist.
        info: Provenance of the reconstruction.
        results: The reconstruction and what belongs to it.

    Raises:
        EvaluationError: There is no component.
        InputError: A file cannot be written, or an image cannot be read.
    """
    if not results.components:
        raise EvaluationError("a reconstruction without components; expected at least one registered image")
    values = json.dumps(report_values(info, results), indent=2, allow_nan=False, ensure_ascii=False)
    write_text(folder / "report.json", values + "\n")
    write_text(folder / "report.html", reconstruction_page(info, results))
    with figure(_PICTURE_WIDTH_IN, _PICTURE_WIDTH_IN / VIEW_ASPECT) as (fig, axes):
        clouds.draw_perspective(axes[0], clouds.upright(results.components[0], results.up))
    save_png(fig, folder / "reconstruction.png", dpi=_PICTURE_DPI)
