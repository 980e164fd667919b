"""The report of a run: an HTML page, the same numbers as JSON, and a picture of the path."""

import json
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dronevio.eval.metrics import ScoredTrajectory
from dronevio.eval.provenance import RunInfo
from dronevio.eval.report.figures import figure, save_png
from dronevio.eval.report.model import Subject, report_numbers
from dronevio.eval.report.page import page
from dronevio.eval.report.plots import ABOVE, FRONT, draw_path
from dronevio.eval.run import EstimatorRun
from dronevio.models.protocols import Recording

Array = npt.NDArray[np.float64]


def write_report(
    folder: Path,
    info: RunInfo,
    recording: Recording,
    run: EstimatorRun,
    scored: ScoredTrajectory | None,
    *,
    outline: Array | None = None,
) -> None:
    """Write ``report.html``, ``report.json`` and ``trajectory.png`` into a folder.

    Args:
        folder: Where to; it exists.
        info: Where the run comes from.
        recording: What was measured.
        run: What the estimator made of it.
        scored: Its trajectory beside the truth; None where there is no truth.
        outline: (L, 2, 3) Line segments of the surroundings [m], in the truth's world.

    Raises:
        EvaluationError: The run does not belong to the recording.
        InputError: An image cannot be read.
    """
    run.check_belongs_to(recording)
    subject = Subject(info, recording, run, scored, np.zeros((0, 2, 3)) if outline is None else outline)
    numbers = report_numbers(subject)
    text = json.dumps(numbers, indent=2, allow_nan=False, ensure_ascii=False)
    (folder / "report.json").write_text(text + "\n", encoding="utf-8")
    (folder / "report.html").write_text(page(subject, numbers), encoding="utf-8")
    with figure(10.0, 4.6, columns=2) as (fig, axes):
        for ax, side in zip(axes, (ABOVE, FRONT), strict=True):
            draw_path(ax, side, subject.estimate, recording.ground_truth, subject.outline)
    save_png(fig, folder / "trajectory.png")
