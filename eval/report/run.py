"""The report of a run: an HTML page, its values as JSON, and a plot of the path."""

import json
from pathlib import Path

import numpy as np

from dronevio.eval.map_results import MapResults
from dronevio.eval.metrics import ScoredTrajectory
from dronevio.eval.provenance import RunInfo
from dronevio.eval.report.figures import figure, save_png
from dronevio.eval.report.model import ControlResult, RunReport, RunResults
from dronevio.eval.report.page import run_page
from dronevio.eval.report.plots import SIDE_VIEW, TOP_VIEW, draw_path
from dronevio.eval.run import EstimatorRun
from dronevio.models.arrays import Array
from dronevio.models.policies.outcome import PolicyOutcome
from dronevio.models.protocols import Recording


def write_report(
    folder: Path,
    info: RunInfo,
    recording: Recording,
    run: EstimatorRun,
    scored: ScoredTrajectory | None,
    *,
    outline: Array | None = None,
    control: ControlResult | None = None,
    policy: PolicyOutcome | None = None,
    map_results: MapResults | None = None,
) -> RunReport:
    """Write ``report.html``, ``report.json`` and ``trajectory.png``, and return the figures of the run.

    Args:
        folder: Existing folder for the files.
        info: Provenance of the run.
        recording: The measurements.
        run: The estimates of all frames and their costs.
        scored: The estimated trajectory with its errors; None without ground truth.
        outline: (L, 2, 3) Line segments of the surroundings in the world frame of the ground truth [m].
        control: Control of a simulated flight.
        policy: Outcome of the flight of a policy.
        map_results: The map of the estimator with the corrected trajectories; None for an estimator without a map.

    Raises:
        EvaluationError: The run does not belong to the recording.
        InputError: An image cannot be read.
    """
    run.check_belongs_to(recording)
    outline = np.zeros((0, 2, 3)) if outline is None else outline
    results = RunResults(info, recording, run, scored, outline, control, policy, map_results)
    report = RunReport.of(results)
    text = json.dumps(report.values, indent=2, allow_nan=False, ensure_ascii=False)
    (folder / "report.json").write_text(text + "\n", encoding="utf-8")
    (folder / "report.html").write_text(run_page(results, report), encoding="utf-8")
    with figure(10.0, 4.6, columns=2) as (fig, axes):
        for ax, view in zip(axes, (TOP_VIEW, SIDE_VIEW), strict=True):
            draw_path(ax, view, results.estimate, recording.ground_truth, results.outline, results.corrected)
    save_png(fig, folder / "trajectory.png")
    return report
