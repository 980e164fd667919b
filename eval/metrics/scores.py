"""The score of an estimate: every figure at once, and the errors over time behind them."""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from dronevio.eval.metrics.alignment import Alignment, AlignmentMode, align, umeyama
from dronevio.eval.metrics.association import Association, associate, nearest_rows
from dronevio.eval.metrics.consistency import Consistency, consistency, inside_percent
from dronevio.eval.metrics.errors import (
    Statistics,
    relative_errors,
    rotation_errors_rad,
    translation_errors_m,
)
from dronevio.eval.metrics.lengths import SHARES, LengthErrors, errors_by_length
from dronevio.eval.metrics.pairs import PairRule
from dronevio.models.errors import EvaluationError
from dronevio.models.imu import Times
from dronevio.models.state import Trajectory

Array = npt.NDArray[np.float64]

ONE_SECOND = PairRule()
"""Pairs of poses one second apart, from every pose on."""
START_UP_S = 3.0
"""An estimator may take so long after the first frame before its poses are counted [s]."""
_FRAME_TOLERANCE_NS = 1_000_000  # a pose and its frame carry one time stamp, however it was rounded


@dataclass(frozen=True)
class Scores:
    """How good an estimate is. Angles are in degrees, for people; all else is SI."""

    alignment: AlignmentMode
    """What was taken out before poses were compared."""
    align_poses: int | None
    """Over how many poses, from the first on; None for all."""
    association: Association
    """How the true pose that belongs to an estimated one was found."""
    time_offset_s: float
    """What was added to the estimate's time stamps [s], as it was asked for."""
    n_poses: int
    """Estimated poses that were compared with the truth."""
    n_estimated: int
    """Poses that the estimate has."""
    first_s: float
    """Time of the first compared pose after the truth's first [s]."""
    last_s: float
    """Time of the last compared pose after the truth's first [s]."""
    longest_gap_s: float
    """Longest time between two compared poses [s]."""
    path_m: float
    """Length of the true path over the compared poses [m]."""
    ate_m: Statistics
    """Absolute error of position after alignment [m]."""
    ate_deg: Statistics
    """Absolute error of orientation after alignment [°]."""
    rpe_over: str
    """How far apart the two poses of a relative error are, for people: ``1 s``, ``100 m``."""
    rpe_delta_s: float | None
    """The same in seconds [s]; None if it is in another unit."""
    rpe_pairs: int
    """Pairs of poses that far apart."""
    rpe_m: Statistics | None
    """Relative error of position over that [m]; None if no two poses are that far apart."""
    rpe_deg: Statistics | None
    """Relative error of orientation over that [°]; None if no two poses are that far apart."""
    lengths: tuple[LengthErrors, ...]
    """Errors by length of sub-trajectories."""
    drift_percent: float | None
    """Mean over all of these of the error of position at the end, position and yaw aligned at the beginning, by the
    length [%]; None if there are none."""
    scale_error_percent: float | None
    """By how much the estimated path is too large [%], from the best similarity; None for a straight path."""
    velocity_m_s: Statistics | None
    """Error of velocity after alignment [m/s]; None where truth or estimate has none."""
    gyro_bias_rad_s: Statistics | None
    """Error of the gyroscope's bias [rad/s]; None where truth or estimate has none."""
    accel_bias_m_s2: Statistics | None
    """Error of the accelerometer's bias [m/s²]; None where truth or estimate has none."""
    coverage_percent: float | None
    """Share of the frames later than 3 s after the first that have a pose [%]; None if frames are not known."""
    initialized_s: float | None
    """Time of the first estimated pose after the first frame [s]; None if frames are not known."""
    nees_position: float | None
    """Mean normalized squared error of position; 3 expected, more is overconfident; None without covariances."""
    nees_orientation: float | None
    """Mean normalized squared error of orientation; 3 expected; None without covariances."""
    nees_position_inside_percent: float | None
    """Share of poses whose NEES of position lies within its two-sided 95 % bounds [%]; 95 expected."""
    nees_orientation_inside_percent: float | None
    """Share of poses whose NEES of orientation lies within its two-sided 95 % bounds [%]; 95 expected."""
    position_beyond_3_sigma_percent: float | None
    """Share of position errors beyond three standard deviations [%]; 0.27 expected; None without covariances."""
    orientation_beyond_3_sigma_percent: float | None
    """Share of orientation errors beyond three standard deviations [%]; 0.27 expected; None without covariances."""


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
    align_poses: int | None = None,
    rpe: PairRule = ONE_SECOND,
    lengths_m: tuple[float, ...] | None = None,
    association: Association = "interpolate",
    max_gap_s: float | None = None,
    time_offset_s: float = 0.0,
) -> Scores:
    """Score an estimate against the truth; see `score_trajectory`, which also keeps the errors over time."""
    return score_trajectory(
        truth,
        estimate,
        frame_times_ns,
        alignment,
        align_poses=align_poses,
        rpe=rpe,
        lengths_m=lengths_m,
        association=association,
        max_gap_s=max_gap_s,
        time_offset_s=time_offset_s,
    ).scores


def score_trajectory(
    truth: Trajectory,
    estimate: Trajectory,
    frame_times_ns: Times | None = None,
    alignment: AlignmentMode = "yaw",
    *,
    align_poses: int | None = None,
    rpe: PairRule = ONE_SECOND,
    lengths_m: tuple[float, ...] | None = None,
    association: Association = "interpolate",
    max_gap_s: float | None = None,
    time_offset_s: float = 0.0,
) -> ScoredTrajectory:
    """Score an estimate against the truth.

    Args:
        truth: The true motion of the IMU.
        estimate: The estimated one, in any world whose z axis is up.
        frame_times_ns: (M,) Time stamps of all frames [ns], for the coverage.
        alignment: What to take out before poses are compared.
        align_poses: Over how many poses to align, from the first on; None for all.
        rpe: Between which pairs of poses to take relative errors.
        lengths_m: Lengths of sub-trajectories [m]; None for 10 % to 50 % of the true path.
        association: How to find the true pose that belongs to an estimated one.
        max_gap_s: The longest gap of the truth to interpolate, or the largest difference in time to the nearest true
            pose [s]; None for 0.5 s and 0.01 s.
        time_offset_s: What to add to the estimate's time stamps [s]; see `estimate_time_offset_s`.

    Raises:
        ConfigError: A choice that does not exist or makes no sense.
        EvaluationError: Truth and estimate have fewer than three instants in common, or cannot be aligned.
    """
    shifted = replace(estimate, t_ns=estimate.t_ns + round(time_offset_s * 1e9)) if time_offset_s else estimate
    true, estimated = associate(truth, shifted, association, max_gap_s)
    motion = align(
        true.p_world_imu,
        estimated.p_world_imu,
        alignment,
        n=align_poses,
        quat_truth_wxyz=true.quat_wxyz,
        quat_estimate_wxyz=estimated.quat_wxyz,
    )
    aligned = motion.apply(estimated)
    poses = true.p_world_imu, true.quat_wxyz, aligned.p_world_imu, aligned.quat_wxyz
    pairs = rpe.choose(true.t_ns, *(poses[:2] if rpe.source == "truth" else poses[2:]))
    rpe_m, rpe_rad = relative_errors(*poses, pairs)
    translation_error_m = translation_errors_m(true.p_world_imu, aligned.p_world_imu)
    rotation_error_rad = rotation_errors_rad(true.quat_wxyz, aligned.quat_wxyz)
    path_m = true.length_m
    lengths = errors_by_length(*poses, usual_lengths_m(path_m) if lengths_m is None else lengths_m)
    stated = consistency(true, estimated) if estimated.covariance is not None else None
    scores = Scores(
        alignment=alignment,
        align_poses=align_poses,
        association=association,
        time_offset_s=time_offset_s,
        n_poses=len(true),
        n_estimated=len(estimate),
        first_s=float(true.t_ns[0] - truth.t_ns[0]) * 1e-9,
        last_s=float(true.t_ns[-1] - truth.t_ns[0]) * 1e-9,
        longest_gap_s=float(np.diff(true.t_ns).max()) * 1e-9,
        path_m=path_m,
        ate_m=Statistics.of(translation_error_m),
        ate_deg=Statistics.of(np.degrees(rotation_error_rad)),
        rpe_over=rpe.label,
        rpe_delta_s=rpe.delta if rpe.unit == "s" else None,
        rpe_pairs=len(rpe_m),
        rpe_m=Statistics.of(rpe_m) if len(rpe_m) else None,
        rpe_deg=Statistics.of(np.degrees(rpe_rad)) if len(rpe_m) else None,
        lengths=lengths,
        drift_percent=mean_drift_percent(lengths),
        scale_error_percent=scale_error_percent(true.p_world_imu, estimated.p_world_imu),
        velocity_m_s=_differences(true.velocity_m_s, aligned.velocity_m_s),
        gyro_bias_rad_s=_differences(true.gyro_bias_rad_s, aligned.gyro_bias_rad_s),
        accel_bias_m_s2=_differences(true.accel_bias_m_s2, aligned.accel_bias_m_s2),
        coverage_percent=None if frame_times_ns is None else coverage_percent(frame_times_ns, estimate.t_ns),
        initialized_s=None if frame_times_ns is None else initialized_s(frame_times_ns, estimate.t_ns),
        nees_position=None if stated is None else float(stated.position_nees.mean()),
        nees_orientation=None if stated is None else float(stated.orientation_nees.mean()),
        nees_position_inside_percent=None if stated is None else inside_percent(stated.position_nees),
        nees_orientation_inside_percent=None if stated is None else inside_percent(stated.orientation_nees),
        position_beyond_3_sigma_percent=None if stated is None else 100.0 * stated.position_exceedance,
        orientation_beyond_3_sigma_percent=None if stated is None else 100.0 * stated.orientation_exceedance,
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


def usual_lengths_m(path_m: float) -> tuple[float, ...]:
    """Return 10 % to 50 % of the length of a path [m], cut to centimetres; none for a path that hardly moves."""
    cut = (int(share * path_m * 100.0) / 100.0 for share in SHARES)
    return tuple(length_m for length_m in cut if length_m > 0.0)


def mean_drift_percent(lengths: tuple[LengthErrors, ...]) -> float | None:
    """Return the mean drift over all sub-trajectories of all lengths [%]; None if there are none."""
    count = sum(errors.drift_percent.n for errors in lengths)
    return sum(errors.drift_percent.mean * errors.drift_percent.n for errors in lengths) / count if count else None


def initialized_s(frame_times_ns: Times, t_estimate_ns: Times) -> float | None:
    """Return the time [s] from the first frame to the first estimated pose; None where there is no such thing."""
    if len(frame_times_ns) == 0 or len(t_estimate_ns) == 0:
        return None
    return float(t_estimate_ns[0] - frame_times_ns[0]) * 1e-9


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


def _differences(truth: Array | None, estimate: Array | None) -> Statistics | None:
    """Return the statistics of the lengths of differences of vectors (N, 3); None where one of the two is missing."""
    if truth is None or estimate is None:
        return None
    return Statistics.of(translation_errors_m(truth, estimate))
