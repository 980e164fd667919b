"""Scores of an estimated trajectory: all metrics at once, and the errors over time from which they are computed."""

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
from dronevio.eval.metrics.lengths import DEFAULT_SHARES, LengthErrors, errors_by_length
from dronevio.eval.metrics.pairs import PairRule
from dronevio.models.errors import EvaluationError
from dronevio.models.imu import Times
from dronevio.models.state import Trajectory

Array = npt.NDArray[np.float64]

ONE_SECOND = PairRule()
"""Pairs of poses 1 s apart, one from every pose on."""
START_UP_S = 3.0
"""Time after the first frame before which frames do not count for the coverage [s]."""
_FRAME_TOLERANCE_NS = 1_000_000  # between the time stamps of a frame and of its pose, which may be rounded


@dataclass(frozen=True)
class Scores:
    """Scores of an estimated trajectory. Angles are in degrees, other quantities in SI units."""

    alignment: AlignmentMode
    """Alignment before errors were computed."""
    align_poses: int | None
    """Number of aligned poses, from the first on; None for all."""
    association: Association
    """How the true pose of an estimated pose was found."""
    time_offset_s: float
    """Offset that was added to the estimate's time stamps [s]."""
    n_poses: int
    """Number of estimated poses that were compared with the truth."""
    n_estimated: int
    """Number of poses of the estimate."""
    first_pose_s: float
    """Time of the first compared pose after the first true pose [s]."""
    last_pose_s: float
    """Time of the last compared pose after the first true pose [s]."""
    longest_gap_s: float
    """Longest time between two successive compared poses [s]."""
    path_m: float
    """Length of the true path over the compared poses [m]."""
    ate_m: Statistics
    """Absolute position error after alignment [m]."""
    ate_deg: Statistics
    """Absolute orientation error after alignment [°]."""
    rpe_interval: str
    """Distance between the two poses of a relative error, such as ``1 s`` or ``100 m``."""
    rpe_delta_s: float | None
    """The same distance [s]; None if its unit is not the second."""
    rpe_pairs: int
    """Number of pairs of poses at that distance."""
    rpe_m: Statistics | None
    """Relative position error [m]; None without such pairs."""
    rpe_deg: Statistics | None
    """Relative orientation error [°]; None without such pairs."""
    lengths: tuple[LengthErrors, ...]
    """Errors by sub-trajectory length."""
    drift_percent: float | None
    """Mean drift over all sub-trajectories, relative to their lengths [%]; None without sub-trajectories."""
    scale_error_percent: float | None
    """Relative error of the scale, positive if the estimated path is too large [%]; None for a straight path."""
    velocity_m_s: Statistics | None
    """Velocity error after alignment [m/s]; None if truth or estimate has no velocities."""
    gyro_bias_rad_s: Statistics | None
    """Error of the gyroscope bias [rad/s]; None if truth or estimate has no biases."""
    accel_bias_m_s2: Statistics | None
    """Error of the accelerometer bias [m/s²]; None if truth or estimate has no biases."""
    coverage_percent: float | None
    """Share of the frames later than 3 s after the first that have a pose [%]; None without frame times."""
    initialization_s: float | None
    """Time from the first frame to the first estimated pose [s]; None without frame times."""
    nees_position: float | None
    """Mean NEES of the position, 3 expected; larger values are overconfident; None without covariances."""
    nees_orientation: float | None
    """Mean NEES of the orientation, 3 expected; larger values are overconfident; None without covariances."""
    nees_velocity: float | None
    """Mean NEES of the velocity, 3 expected; larger values are overconfident; None without covariances or
    velocities."""
    nees_position_inside_percent: float | None
    """Share of poses whose NEES of the position is within its two-sided 95 % bounds [%]; None without covariances."""
    nees_orientation_inside_percent: float | None
    """Share of poses whose NEES of the orientation is within these bounds [%]; None without covariances."""
    position_beyond_3_sigma_percent: float | None
    """Share of position errors beyond 3σ [%]; 0.27 expected; None without covariances."""
    orientation_beyond_3_sigma_percent: float | None
    """Share of orientation errors beyond 3σ [%]; 0.27 expected; None without covariances."""


@dataclass(frozen=True, eq=False)
class ScoredTrajectory:
    """An estimated trajectory with its errors at every pose."""

    truth: Trajectory
    """N true poses at the times of the estimate."""
    estimate: Trajectory
    """N estimated poses, aligned with the truth."""
    alignment: Alignment
    """Alignment of the estimate with the truth."""
    translation_error_m: Array
    """(N,) Distances between true and aligned estimated positions [m]."""
    rotation_error_rad: Array
    """(N,) Angles between true and aligned estimated orientations [rad]."""
    rpe_t_ns: Times
    """(M,) Time stamps of the first poses of the pairs of relative errors [ns]."""
    rpe_m: Array
    """(M,) Relative position errors [m]."""
    rpe_rad: Array
    """(M,) Relative orientation errors [rad]."""
    consistency: Consistency | None
    """Errors with estimated uncertainty, anchored at the first pose; None without covariances."""
    scores: Scores
    """Scores computed from these errors."""


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
    """Return the scores of an estimate; see `score_trajectory`, which also returns the errors at every pose."""
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
    """Return the scores of an estimate, and its errors at every pose.

    Args:
        truth: The true trajectory of the IMU.
        estimate: The estimated trajectory, in any world frame whose z axis is up.
        frame_times_ns: (M,) Time stamps of all frames [ns], from which the coverage is computed.
        alignment: What is aligned before errors are computed.
        align_poses: Number of poses to align, from the first on; None for all.
        rpe: Rule by which the pairs of poses of relative errors are selected.
        lengths_m: Lengths of sub-trajectories [m]; None for 10 % to 50 % of the true path.
        association: How the true pose of an estimated pose is found.
        max_gap_s: Longest gap of the truth that is interpolated, or largest time difference to the nearest true pose
            [s]; None for 0.5 s and 0.01 s, respectively.
        time_offset_s: Offset to add to the estimate's time stamps [s]; see `estimate_time_offset_s`.

    Raises:
        ConfigError: An option does not exist or is out of range.
        EvaluationError: Truth and estimate have fewer than three poses in common, or cannot be aligned.
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
    pairs = rpe.select(true.t_ns, *(poses[:2] if rpe.source == "truth" else poses[2:]))
    rpe_m, rpe_rad = relative_errors(*poses, pairs)
    translation_error_m = translation_errors_m(true.p_world_imu, aligned.p_world_imu)
    rotation_error_rad = rotation_errors_rad(true.quat_wxyz, aligned.quat_wxyz)
    path_m = true.length_m
    lengths = errors_by_length(*poses, default_lengths_m(path_m) if lengths_m is None else lengths_m)
    anchored = consistency(true, estimated) if estimated.covariance is not None else None
    scores = Scores(
        alignment=alignment,
        align_poses=align_poses,
        association=association,
        time_offset_s=time_offset_s,
        n_poses=len(true),
        n_estimated=len(estimate),
        first_pose_s=float(true.t_ns[0] - truth.t_ns[0]) * 1e-9,
        last_pose_s=float(true.t_ns[-1] - truth.t_ns[0]) * 1e-9,
        longest_gap_s=float(np.diff(true.t_ns).max()) * 1e-9,
        path_m=path_m,
        ate_m=Statistics.of(translation_error_m),
        ate_deg=Statistics.of(np.degrees(rotation_error_rad)),
        rpe_interval=rpe.label,
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
        initialization_s=None if frame_times_ns is None else initialization_s(frame_times_ns, estimate.t_ns),
        nees_position=None if anchored is None else float(anchored.position_nees.mean()),
        nees_orientation=None if anchored is None else float(anchored.orientation_nees.mean()),
        nees_velocity=None
        if anchored is None or anchored.velocity_nees is None
        else float(anchored.velocity_nees.mean()),
        nees_position_inside_percent=None if anchored is None else inside_percent(anchored.position_nees),
        nees_orientation_inside_percent=None if anchored is None else inside_percent(anchored.orientation_nees),
        position_beyond_3_sigma_percent=None if anchored is None else 100.0 * anchored.position_exceedance,
        orientation_beyond_3_sigma_percent=None if anchored is None else 100.0 * anchored.orientation_exceedance,
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
        anchored,
        scores,
    )


def default_lengths_m(path_m: float) -> tuple[float, ...]:
    """Return 10 % to 50 % of the length of a path [m], rounded down to centimetres; lengths of zero are omitted."""
    rounded = (int(share * path_m * 100.0) / 100.0 for share in DEFAULT_SHARES)
    return tuple(length_m for length_m in rounded if length_m > 0.0)


def mean_drift_percent(lengths: tuple[LengthErrors, ...]) -> float | None:
    """Return the mean drift over all sub-trajectories of all lengths [%]; None if there are none."""
    count = sum(errors.drift_percent.n for errors in lengths)
    return sum(errors.drift_percent.mean * errors.drift_percent.n for errors in lengths) / count if count else None


def initialization_s(frame_times_ns: Times, t_estimate_ns: Times) -> float | None:
    """Return the time from the first frame to the first estimated pose [s]; None without frames or poses."""
    if len(frame_times_ns) == 0 or len(t_estimate_ns) == 0:
        return None
    return float(t_estimate_ns[0] - frame_times_ns[0]) * 1e-9


def scale_error_percent(p_truth: Array, p_estimate: Array) -> float | None:
    """Return the relative error of the scale of an estimated path (N, 3), positive if it is too large [%].

    The scale is that of the least-squares similarity; None if the path is a point or a straight line.
    """
    try:
        scale = umeyama(p_truth, p_estimate, with_scale=True).scale
    except EvaluationError:
        return None
    return 100.0 * (1.0 / scale - 1.0) if scale > 0.0 else None


def coverage_percent(frame_times_ns: Times, t_estimate_ns: Times, start_up_s: float = START_UP_S) -> float | None:
    """Return the share [%] of the frames later than ``start_up_s`` after the first that have a pose.

    It belongs beside every error: an estimator that loses track and stops publishing poses must not look accurate. None
    if there is no such frame.
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
    """Return the statistics of the norms of differences of vectors (N, 3); None if one of the two is missing."""
    if truth is None or estimate is None:
        return None
    return Statistics.of(translation_errors_m(truth, estimate))
