"""Evaluation of trajectories in memory or in files, with little to import."""

from pathlib import Path

from dronevio.eval.metrics.alignment import AlignmentMode, align
from dronevio.eval.metrics.association import associate
from dronevio.eval.metrics.errors import Statistics, translation_errors_m
from dronevio.eval.metrics.scores import ScoredTrajectory, score_trajectory
from dronevio.eval.metrics.trajectory_errors import ScoreOptions
from dronevio.eval.run import EstimatorRun
from dronevio.models.errors import EvaluationError
from dronevio.models.imu import Times
from dronevio.models.protocols import Recording
from dronevio.models.recordings.open import read_frame_times, read_trajectory
from dronevio.models.state import Trajectory


def evaluate(
    truth: Recording | Trajectory | str | Path,
    estimated: EstimatorRun | Trajectory | str | Path,
    alignment: AlignmentMode = "yaw",
) -> ScoredTrajectory:
    """Compare an estimate with the ground truth.

    Args:
        truth: The ground truth: a recording that has one, a trajectory, or the path of either.
        estimated: The result of `estimate`, a trajectory, or the path of a trajectory.
        alignment: Degrees of freedom that are removed before: ``"yaw"`` (yaw and position), ``"se3"``, ``"sim3"``, ...

    Returns:
        The scores and the errors over time.

    Raises:
        EvaluationError: The recording has no ground truth, or the two do not overlap in time.
        InputError: A file cannot be read.
    """
    estimate = _estimated(estimated)
    true, frame_times_ns = _true(truth, estimate.t_ns)
    return score_trajectory(true, estimate, frame_times_ns, ScoreOptions(alignment))


def ate(
    truth: Recording | Trajectory | str | Path,
    estimated: EstimatorRun | Trajectory | str | Path,
    alignment: AlignmentMode = "yaw",
) -> Statistics:
    """Return the absolute trajectory error of the position, after association by time and alignment.

    The true poses are interpolated at the time stamps of the estimate. `dronevio.eval.metrics.ate` takes arrays of
    positions that are associated already.

    Args:
        truth: The ground truth: a recording that has one, a trajectory, or the path of either.
        estimated: The result of `estimate`, a trajectory, or the path of a trajectory.
        alignment: Degrees of freedom that are removed before: ``"yaw"`` (yaw and position), ``"se3"``, ``"sim3"``, ...

    Returns:
        Statistics of the distances between estimated and true positions [m].

    Raises:
        EvaluationError: The recording has no ground truth, or the two do not overlap in time.
        InputError: A file cannot be read.
    """
    estimated = _estimated(estimated)
    true, estimate = associate(_true(truth, estimated.t_ns)[0], estimated, "interpolate", None)
    motion = align(
        true.p_world_imu,
        estimate.p_world_imu,
        alignment,
        quat_truth_wxyz=true.quat_wxyz,
        quat_estimate_wxyz=estimate.quat_wxyz,
    )
    errors_m = translation_errors_m(true.p_world_imu, motion.apply(estimate).p_world_imu)
    return Statistics.of(errors_m)


def _true(truth: Recording | Trajectory | str | Path, poses_ns: Times) -> tuple[Trajectory, Times | None]:
    """Return the true trajectory, and the time stamps of the frames (M,) [ns] if they are known.

    Where the clock of a recording steps, these are of the segment with the most of the poses (N,) [ns].

    Raises:
        EvaluationError: A recording has no ground truth.
        InputError: A file cannot be read.
    """
    if isinstance(truth, str | Path):
        path = Path(truth)
        return read_trajectory(path, poses_ns), read_frame_times(path, poses_ns) if path.is_dir() else None
    if isinstance(truth, Trajectory):
        return truth, None
    if truth.ground_truth is None:
        raise EvaluationError(f"{truth.name}: no ground truth; expected a recording with one")
    return truth.ground_truth, truth.frame_times_ns


def _estimated(estimated: EstimatorRun | Trajectory | str | Path) -> Trajectory:
    """Return an estimated trajectory.

    Raises:
        InputError: A file cannot be read.
    """
    if isinstance(estimated, EstimatorRun):
        return estimated.trajectory
    return read_trajectory(Path(estimated)) if isinstance(estimated, str | Path) else estimated
