"""The score of an estimate: every figure at once, and the errors over time behind them."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from dronevio.eval.metrics.alignment import Alignment, AlignmentMode, align, umeyama
from dronevio.eval.metrics.association import interpolate, nearest, nearest_rows
from dronevio.eval.metrics.consistency import Consistency, consistency
from dronevio.eval.metrics.errors import (
    Statistics,
    pairs_after_time,
    relative_errors,
    rotation_errors_rad,
    translation_errors_m,
)
from dronevio.models.errors import ConfigError, EvaluationError
from dronevio.models.imu import Times
from dronevio.models.state import Trajectory

Array = npt.NDArray[np.float64]

Association = Literal["interpolate", "nearest"]
"""Interpolate the truth at the estimate's time stamps, or take the nearest true pose."""

START_UP_S = 3.0
"""An estimator may take so long after the first frame before its poses are counted [s]."""
_FRAME_TOLERANCE_NS = 1_000_000  # a pose and its frame carry one time stamp, however it was rounded
_FEWEST_POSES = 3


@dataclass(frozen=True)
class Scores:
    """How good an estimate is. Angles are in degrees, for people; all else is SI."""

    alignment: AlignmentMode
    """What was taken out before poses were compared."""
    n_poses: int
    """Estimated poses that were compared with the truth."""
    n_estimated: int
    """Poses that the estimate has."""
    first_s: float
    """Time of the first compared pose after the truth's first [s]."""
    last_s: float
    """Time of the last compared pose after the truth's first [s]."""
    path_m: float
    """Length of the true path over the compared poses [m]."""
    ate_m: Statistics
    """Absolute error of position after alignment [m]."""
    ate_deg: Statistics
    """Absolute error of orientation after alignment [°]."""
    rpe_delta_s: float
    """Time between the two poses of a relative error [s]."""
    rpe_pairs: int
    """Pairs of poses that far apart."""
    rpe_m: Statistics | None
    """Relative error of position over that time [m]; None if no two poses are that far apart."""
    rpe_deg: Statistics | None
    """Relative error of orientation over that time [°]; None if no two poses are that far apart."""
    scale_error_percent: float | None
    """By how much the estimated path is too large [%], from the best similarity; None for a straight path."""
    coverage_percent: float | None
    """Share of the frames later than 3 s after the first that have a pose [%]; None if frames are not known."""
    nees_position: float | None
    """Mean normalised squared error of position; 3 expected, more is overconfident; None without covariances."""
    nees_orientation: float | None
    """Mean normalised squared error of orientation; 3 expected; None without covariances."""
    position_beyond_3_sigma_percent: float | None
    """Share of position errors beyond three standard deviations [%]; 0.27 expected; None without covariances."""


@dataclass(frozen=True, eq=False)
class ScoredTrajectory:
    """An estimate beside the truth, pose by pose."""

    truth: Trajectory
    """N true poses at the estimate's time stamps."""
    estimate: Trajectory
    """N estimated poses in the true world, aligned."""
    alignment: Alignment
    """What brought the estimate into the true world."""
    translation_error_m: Array
    """(N,) Distances between true and estimated positions [m]."""
    rotation_error_rad: Array
    """(N,) Angles between true and estimated orientations [rad]."""
    rpe_t_ns: Times
    """(M,) Time stamps at which the pairs of the relative errors begin [ns]."""
    rpe_m: Array
    """(M,) Relative errors of position [m]."""
    rpe_rad: Array
    """(M,) Relative errors of orientation [rad]."""
    consistency: Consistency | None
    """Errors against stated covariances, the gauge fixed at the first pose; None without covariances."""
    scores: Scores
    """All in figures."""


def score(
    truth: Trajectory,
    estimate: Trajectory,
    frame_times_ns: Times | None = None,
    alignment: AlignmentMode = "yaw",
    *,
    rpe_delta_s: float = 1.0,
    association: Association = "interpolate",
    max_gap_s: float | None = None,
) -> Scores:
    """Score an estimate against the truth; see `score_trajectory`, which also keeps the errors over time."""
    return score_trajectory(
        truth,
        estimate,
        frame_times_ns,
        alignment,
        rpe_delta_s=rpe_delta_s,
        association=association,
        max_gap_s=max_gap_s,
    ).scores


def score_trajectory(
    truth: Trajectory,
    estimate: Trajectory,
    frame_times_ns: Times | None = None,
    alignment: AlignmentMode = "yaw",
    *,
    rpe_delta_s: float = 1.0,
    association: Association = "interpolate",
    max_gap_s: float | None = None,
) -> ScoredTrajectory:
    """Score an estimate against the truth.

    Args:
        truth: The true motion of the IMU.
        estimate: The estimated one, in any world whose z axis is up.
        frame_times_ns: (M,) Time stamps of all frames [ns], for the coverage.
        alignment: What to take out before poses are compared.
        rpe_delta_s: Time between the two poses of a relative error [s].
        association: How to find the true pose that belongs to an estimated one.
        max_gap_s: The longest gap of the truth to interpolate, or the largest difference in time to the nearest true
            pose [s]; None for 0.5 s and 0.01 s.

    Raises:
        ConfigError: A choice that does not exist or makes no sense.
        EvaluationError: Truth and estimate have fewer than three instants in common, or cannot be aligned.
    """
    if not 0.0 < rpe_delta_s < 1e6:
        raise ConfigError(f"a relative error over {rpe_delta_s:g} s; expected a time above zero")
    true, estimated = associate(truth, estimate, association, max_gap_s)
    motion = align(true.p_world_imu, estimated.p_world_imu, alignment)
    aligned = motion.apply(estimated)
    pairs = pairs_after_time(true.t_ns, rpe_delta_s)
    rpe_m, rpe_rad = relative_errors(true.p_world_imu, true.quat_wxyz, aligned.p_world_imu, aligned.quat_wxyz, pairs)
    translation_error_m = translation_errors_m(true.p_world_imu, aligned.p_world_imu)
    rotation_error_rad = rotation_errors_rad(true.quat_wxyz, aligned.quat_wxyz)
    stated = consistency(true, estimated) if estimated.covariance is not None else None
    scores = Scores(
        alignment=alignment,
        n_poses=len(true),
        n_estimated=len(estimate),
        first_s=float(true.t_ns[0] - truth.t_ns[0]) * 1e-9,
        last_s=float(true.t_ns[-1] - truth.t_ns[0]) * 1e-9,
        path_m=true.length_m,
        ate_m=Statistics.of(translation_error_m),
        ate_deg=Statistics.of(np.degrees(rotation_error_rad)),
        rpe_delta_s=rpe_delta_s,
        rpe_pairs=len(rpe_m),
        rpe_m=Statistics.of(rpe_m) if len(rpe_m) else None,
        rpe_deg=Statistics.of(np.degrees(rpe_rad)) if len(rpe_m) else None,
        scale_error_percent=scale_error_percent(true.p_world_imu, estimated.p_world_imu),
        coverage_percent=None if frame_times_ns is None else coverage_percent(frame_times_ns, estimate.t_ns),
        nees_position=None if stated is None else float(stated.position_nees.mean()),
        nees_orientation=None if stated is None else float(stated.orientation_nees.mean()),
        position_beyond_3_sigma_percent=None if stated is None else 100.0 * stated.position_exceedance,
    )
    return ScoredTrajectory(
        true,
        aligned,
        motion,
        translation_error_m,
        rotation_error_rad,
        true.t_ns[pairs[0]],
        rpe_m,
        rpe_rad,
        stated,
        scores,
    )


def associate(
    truth: Trajectory, estimate: Trajectory, how: Association = "interpolate", max_gap_s: float | None = None
) -> tuple[Trajectory, Trajectory]:
    """Return N true and N estimated poses that belong together, stamped like the estimate.

    Raises:
        ConfigError: There is no such association.
        EvaluationError: There are fewer than three.
    """
    if how == "interpolate":
        true, rows = interpolate(truth, estimate.t_ns, 0.5 if max_gap_s is None else max_gap_s)
        estimated = estimate[rows]
    elif how == "nearest":
        true_rows, rows = nearest(truth.t_ns, estimate.t_ns, 0.01 if max_gap_s is None else max_gap_s)
        estimated = estimate[rows]
        true = Trajectory(estimated.t_ns, truth.p_world_imu[true_rows], truth.quat_wxyz[true_rows])
    else:
        raise ConfigError(f"unknown association {how!r}; expected interpolate or nearest")
    if len(rows) < _FEWEST_POSES:
        raise EvaluationError(
            f"truth ({_span(truth)}) and estimate ({_span(estimate)}) have {len(rows)} poses in common;"
            f" expected at least {_FEWEST_POSES}"
        )
    return true, estimated


def scale_error_percent(p_truth: Array, p_estimate: Array) -> float | None:
    """Return by how much an estimated path (N, 3) is larger than the true one (N, 3) [%], after the best similarity.

    None where the path is a point or a straight line and leaves the similarity open.
    """
    try:
        scale = umeyama(p_truth, p_estimate, with_scale=True).scale
    except EvaluationError:
        return None
    return 100.0 * (1.0 / scale - 1.0) if scale > 0.0 else None


def coverage_percent(frame_times_ns: Times, t_estimate_ns: Times, start_up_s: float = START_UP_S) -> float | None:
    """Return the share [%] of the frames later than ``start_up_s`` after the first that have a pose.

    Say it beside every error: an estimator that lost its way and fell silent must not look accurate. None where no
    frame is that late.
    """
    if len(frame_times_ns) == 0:
        return None
    counted = frame_times_ns[frame_times_ns > frame_times_ns[0] + round(start_up_s * 1e9)]
    if len(counted) == 0:
        return None
    if len(t_estimate_ns) == 0:
        return 0.0
    gap_ns = np.abs(t_estimate_ns[nearest_rows(t_estimate_ns, counted)] - counted)
    return 100.0 * float(np.mean(gap_ns <= _FRAME_TOLERANCE_NS))


def _span(trajectory: Trajectory) -> str:
    """Return the time that a trajectory spans, for messages."""
    if len(trajectory) == 0:
        return "empty"
    return f"{trajectory.t_ns[0] * 1e-9:.3f} to {trajectory.t_ns[-1] * 1e-9:.3f} s"
