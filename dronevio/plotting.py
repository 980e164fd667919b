"""Plots of trajectories for notebooks and scripts."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from dronevio.eval.metrics.scores import ScoredTrajectory
from dronevio.eval.report.figures import figure
from dronevio.eval.report.plots import (
    SIDE_VIEW,
    TOP_VIEW,
    draw_orientation_error,
    draw_path,
    draw_paths,
    draw_position_error,
)
from dronevio.eval.run import EstimatorRun
from dronevio.models.errors import ConfigError, EvaluationError
from dronevio.models.state import Trajectory

_NO_LINES = np.zeros((0, 2, 3))


def plot(shown: Trajectory | Mapping[str, Trajectory] | EstimatorRun | ScoredTrajectory) -> Figure:
    """Draw paths from above and from the side, and the errors of a scored trajectory over time.

    For example, in a notebook:

        dv.plot(dv.evaluate(recording, run))
        dv.plot({"truth": recording.ground_truth, "estimate": run.trajectory}).savefig("paths.png")

    Args:
        shown: A trajectory; several ones by name, which are drawn as they are, without alignment; the result of
            `estimate`, whose path is drawn as estimated, and as corrected by the map if it has one; or that of
            `evaluate`.

    Returns:
        The figure. Notebooks show it; `Figure.savefig` writes it to a file.

    Raises:
        ConfigError: The argument is of another type, or there is no trajectory.
        EvaluationError: A trajectory has no pose.
    """
    if isinstance(shown, ScoredTrajectory):
        return _scored(shown)
    if isinstance(shown, EstimatorRun):
        return _run(shown)
    paths = {"trajectory": shown} if isinstance(shown, Trajectory) else shown
    if not isinstance(paths, Mapping) or not all(isinstance(path, Trajectory) for path in paths.values()):
        raise ConfigError(
            f"plot() of {_kind(paths)}; expected a trajectory, trajectories by name, a run or a scored trajectory"
        )
    if not paths:
        raise ConfigError("plot() of no trajectory; expected at least one")
    for name, path in paths.items():
        _check_poses(name, path)
    with figure(10.0, 4.6, columns=2) as (fig, axes):
        for ax, view in zip(axes, (TOP_VIEW, SIDE_VIEW), strict=True):
            draw_paths(ax, view, {f"{name}": path for name, path in paths.items()})
    return fig


def _run(run: EstimatorRun) -> Figure:
    """Draw the path of a run, and the path that its map corrects."""
    _check_poses("run", run.trajectory)
    corrected = None if run.map is None else run.final_trajectory
    with figure(10.0, 4.6, columns=2) as (fig, axes):
        for ax, view in zip(axes, (TOP_VIEW, SIDE_VIEW), strict=True):
            draw_path(ax, view, run.trajectory, None, _NO_LINES, corrected)
    return fig


def _scored(scored: ScoredTrajectory) -> Figure:
    """Draw the true and the aligned estimated path, and the errors over time."""
    origin_ns = int(scored.truth.t_ns[0])
    with figure(10.0, 8.4, columns=2, rows=2) as (fig, axes):
        for ax, view in zip(axes[:2], (TOP_VIEW, SIDE_VIEW), strict=True):
            draw_path(ax, view, scored.estimate, scored.truth, _NO_LINES)
        for ax, draw in zip(axes[2:], (draw_position_error, draw_orientation_error), strict=True):
            draw(ax, scored, origin_ns)
            ax.legend()
    return fig


def _kind(given: object) -> str:
    """Return the type of an argument, and of a mapping also those of its values, for an error message."""
    if not isinstance(given, Mapping):
        return type(given).__name__
    return f"{type(given).__name__} of {', '.join(sorted({type(value).__name__ for value in given.values()}))}"


def _check_poses(name: str, trajectory: Trajectory) -> None:
    """Check that there is something to draw.

    Raises:
        EvaluationError: The trajectory has no pose.
    """
    if len(trajectory) == 0:
        raise EvaluationError(f"plot() of {name} without poses; expected at least one")
