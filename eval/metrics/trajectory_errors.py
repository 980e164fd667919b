"""An estimated trajectory compared with the truth: associated, aligned, and with its errors at every pose."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

from dronevio.eval.metrics.alignment import Alignment, AlignmentMode, align
from dronevio.eval.metrics.association import Association, associate
from dronevio.eval.metrics.consistency import Consistency, consistency
from dronevio.eval.metrics.errors import relative_errors, rotation_errors_rad, translation_errors_m
from dronevio.eval.metrics.lengths import DEFAULT_SHARES, LengthErrors, errors_by_length
from dronevio.eval.metrics.pairs import PairRule
from dronevio.models.arrays import Array
from dronevio.models.imu import Times
from dronevio.models.state import Trajectory


@dataclass(frozen=True)
class ScoreOptions:
    """How an estimate is compared with the truth."""

    alignment: AlignmentMode = "yaw"
    """What is aligned before errors are computed."""
    align_poses: int | None = None
    """Number of poses to align, from the first on; None for all."""
    rpe: PairRule = field(default_factory=PairRule)
    """Rule by which the pairs of poses of relative errors are selected: 1 s apart, one from every pose on."""
    lengths_m: tuple[float, ...] | None = None
    """Lengths of sub-trajectories [m]; None for 10 % to 50 % of the true path."""
    association: Association = "interpolate"
    """How the true pose of an estimated pose is found."""
    max_gap_s: float | None = None
    """Longest gap of the truth that is interpolated, or largest time difference to the nearest true pose [s]; None for
    0.5 s and 0.01 s, respectively."""
    time_offset_s: float = 0.0
    """Offset to add to the estimate's time stamps [s]; see `estimate_time_offset_s`."""


@dataclass(frozen=True, eq=False)
class Compared:
    """What is compared."""

    truth: Trajectory
    """The true trajectory of the IMU."""
    estimate: Trajectory
    """The estimated trajectory, in any world frame whose z axis is up."""
    frame_times_ns: Times | None
    """(M,) Time stamps of all frames [ns]; None if they are not known."""
    options: ScoreOptions
    """How they are compared."""


@dataclass(frozen=True, eq=False)
class TrajectoryErrors:
    """The errors of an estimated trajectory at every pose, from which its scores are computed."""

    given: Compared
    """What is compared."""
    truth: Trajectory
    """N true poses at the times of the estimate."""
    unaligned: Trajectory
    """N estimated poses."""
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

    @classmethod
    def of(cls, given: Compared) -> Self:
        """Associate and align an estimate with the truth, and return its errors.

        Raises:
            ConfigError: An option does not exist or is out of range.
            EvaluationError: Truth and estimate have fewer than three poses in common, or cannot be aligned.
        """
        estimate, options = given.estimate, given.options
        if options.time_offset_s:
            estimate = replace(estimate, t_ns=estimate.t_ns + round(options.time_offset_s * 1e9))
        true, unaligned = associate(given.truth, estimate, options.association, options.max_gap_s)
        motion = align(
            true.p_world_imu,
            unaligned.p_world_imu,
            options.alignment,
            n=options.align_poses,
            quat_truth_wxyz=true.quat_wxyz,
            quat_estimate_wxyz=unaligned.quat_wxyz,
        )
        aligned = motion.apply(unaligned)
        poses = true.p_world_imu, true.quat_wxyz, aligned.p_world_imu, aligned.quat_wxyz
        pairs = options.rpe.select(true.t_ns, *(poses[:2] if options.rpe.source == "truth" else poses[2:]))
        rpe_m, rpe_rad = relative_errors(*poses, pairs)
        return cls(
            given=given,
            truth=true,
            unaligned=unaligned,
            estimate=aligned,
            alignment=motion,
            translation_error_m=translation_errors_m(true.p_world_imu, aligned.p_world_imu),
            rotation_error_rad=rotation_errors_rad(true.quat_wxyz, aligned.quat_wxyz),
            rpe_t_ns=true.t_ns[pairs[0]],
            rpe_m=rpe_m,
            rpe_rad=rpe_rad,
            consistency=consistency(true, unaligned) if unaligned.covariance is not None else None,
        )

    @cached_property
    def lengths(self) -> tuple[LengthErrors, ...]:
        """Errors by sub-trajectory length."""
        chosen, true, estimate = self.given.options.lengths_m, self.truth, self.estimate
        lengths_m = default_lengths_m(true.length_m) if chosen is None else chosen
        return errors_by_length(true.p_world_imu, true.quat_wxyz, estimate.p_world_imu, estimate.quat_wxyz, lengths_m)


def default_lengths_m(path_m: float) -> tuple[float, ...]:
    """Return 10 % to 50 % of the length of a path [m], rounded down to centimetres; lengths of zero are omitted."""
    rounded = (int(share * path_m * 100.0) / 100.0 for share in DEFAULT_SHARES)
    return tuple(length_m for length_m in rounded if length_m > 0.0)
