"""Several estimates of one flight, aligned with each other for display."""

from collections.abc import Sequence
from dataclasses import dataclass

from dronevio.eval.metrics import IDENTITY, Alignment, AlignmentMode, ScoredTrajectory, ScoreOptions, score_trajectory
from dronevio.eval.metrics.scores import SCORE_METRICS
from dronevio.eval.run import EstimatorRun
from dronevio.models.errors import EvaluationError
from dronevio.models.imu import Times
from dronevio.models.state import Trajectory


@dataclass(frozen=True, eq=False)
class NamedEstimate:
    """An estimate of a flight with its name."""

    name: str
    """Name of the estimator."""
    trajectory: Trajectory
    """The valid poses, in the world frame of the estimator."""
    alignment: Alignment = IDENTITY
    """Alignment with the displayed world frame."""
    scored: ScoredTrajectory | None = None
    """The trajectory with its errors; None without ground truth."""
    run: EstimatorRun | None = None
    """The estimates of all frames; None if only the trajectory is known."""


def align_estimates(
    names: Sequence[str],
    trajectories: Sequence[Trajectory],
    truth: Trajectory | None,
    frame_times_ns: Times,
    alignment: AlignmentMode = "yaw",
) -> list[NamedEstimate]:
    """Return estimates aligned with the truth and scored; without truth, aligned with the first one and not scored.

    Args:
        names: Names of the estimators.
        trajectories: The estimated trajectories, each in a world frame of its own.
        truth: The true trajectory; None if it is not known.
        frame_times_ns: (M,) Time stamps of all frames [ns], from which the coverage is computed.
        alignment: What is aligned.

    Raises:
        EvaluationError: An estimate has fewer than three poses in common with the truth or the first estimate, or
            cannot be aligned; the message begins with its name.
    """
    aligned = []
    for name, trajectory in zip(names, trajectories, strict=True):
        try:
            scored = score_trajectory(truth or trajectories[0], trajectory, frame_times_ns, ScoreOptions(alignment))
        except EvaluationError as error:
            raise EvaluationError(f"{name}: {error}") from error
        aligned.append(NamedEstimate(name, trajectory, scored.alignment, None if truth is None else scored))
    return aligned


def summary_table(estimates: Sequence[NamedEstimate]) -> str:
    """Return the main scores of each estimate as a Markdown table."""
    shown = [SCORE_METRICS[name] for name in ("ate_m", "ate_deg", "rpe_m", "coverage_percent")]
    rows = ["| | ATE | ATE | RPE | coverage |", "|---|---:|---:|---:|---:|"]
    for estimate in estimates:
        scores = None if estimate.scored is None else estimate.scored.scores
        values = [None if scores is None else metric.of(scores) for metric in shown]
        cells = [
            metric.text(value) if value is None else f"{metric.text(value)} {metric.unit}"
            for value, metric in zip(values, shown, strict=True)
        ]
        rows.append(f"| {estimate.name} | {' | '.join(cells)} |")
    return "\n".join(rows) + "\n"
