"""Several estimates of one flight, laid into one world to be seen beside each other."""

from collections.abc import Sequence
from dataclasses import dataclass

from dronevio.eval.metrics import IDENTITY, Alignment, AlignmentMode, ScoredTrajectory, score_trajectory
from dronevio.eval.run import EstimatorRun
from dronevio.models.errors import EvaluationError
from dronevio.models.imu import Times
from dronevio.models.state import Trajectory


@dataclass(frozen=True, eq=False)
class NamedEstimate:
    """What one of several estimators made of a recording."""

    name: str
    """What it is called."""
    trajectory: Trajectory
    """The poses that it stands by, in its own world."""
    alignment: Alignment = IDENTITY
    """Lays them into the world that is shown."""
    scored: ScoredTrajectory | None = None
    """The same beside the truth; None where there is no truth."""
    run: EstimatorRun | None = None
    """Its answers to each frame; None where only its trajectory is known."""


def laid_together(
    names: Sequence[str],
    trajectories: Sequence[Trajectory],
    truth: Trajectory | None,
    frame_times_ns: Times,
    alignment: AlignmentMode = "yaw",
) -> list[NamedEstimate]:
    """Return estimates laid on the truth and scored; without a truth, laid on the first of them and not scored.

    Args:
        names: What they are called.
        trajectories: The estimated motions, each in a world of its own.
        truth: The true motion, where it is known.
        frame_times_ns: (M,) Time stamps of all frames [ns], for the coverage.
        alignment: What to take out.

    Raises:
        EvaluationError: One of them has fewer than three instants in common with what it is laid on, or cannot be
            aligned; the message names it.
    """
    laid = []
    for name, trajectory in zip(names, trajectories, strict=True):
        try:
            scored = score_trajectory(truth or trajectories[0], trajectory, frame_times_ns, alignment)
        except EvaluationError as error:
            raise EvaluationError(f"{name}: {error}") from error
        laid.append(NamedEstimate(name, trajectory, scored.alignment, None if truth is None else scored))
    return laid


def summary_table(estimates: Sequence[NamedEstimate]) -> str:
    """Return a table (Markdown) of what matters most of each estimate."""
    rows = ["| | ATE | ATE | RPE | coverage |", "|---|---:|---:|---:|---:|"]
    for estimate in estimates:
        scores = None if estimate.scored is None else estimate.scored.scores
        figures = (
            (None, None, None, None)
            if scores is None
            else (
                scores.ate_m.rmse,
                scores.ate_deg.rmse,
                None if scores.rpe_m is None else scores.rpe_m.rmse,
                scores.coverage_percent,
            )
        )
        units = ((".3f", " m"), (".2f", "°"), (".3f", " m"), (".1f", " %"))
        cells = [
            "–" if figure is None else format(figure, form) + unit
            for figure, (form, unit) in zip(figures, units, strict=True)
        ]
        rows.append(f"| {estimate.name} | {' | '.join(cells)} |")
    return "\n".join(rows) + "\n"
