"""An estimate beside the truth, pose by pose: the series behind the scores, for pictures and recordings."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import numpy.typing as npt

from dronevio.models.errors import EvaluationError
from dronevio.models.imu import Times
from dronevio.models.rotation import exp_so3, log_so3, pose_matrix, quat_wxyz_from_matrix, slerp_quat_wxyz
from dronevio.models.state import Trajectory

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Comparison:
    """An estimate beside the truth, at the estimate's time stamps.

    An odometry frame is free in yaw and position. There are two ways to tie it to the world. *Best fit* over the whole
    flight is how trajectories are scored. *Anchored* at the first pose is what a covariance speaks of: error grows
    from zero there, so only the anchored errors may be held against 3σ.
    """

    truth: Trajectory
    """The truth, interpolated at the estimate's time stamps."""
    estimate: Trajectory
    """The estimate in the truth's world, best fit of yaw and position; covariances stay those of the odometry frame."""
    T_world_odom: Array
    """(4, 4) The best fit: maps the estimate's own frame into the truth's world."""
    position_error_m: Array
    """(N,) Distance to the truth after the best fit [m]."""
    orientation_error_rad: Array
    """(N,) Angle to the truth after the best fit [rad]."""
    anchored_position_error_m: Array
    """(N, 3) Estimate less truth, in the odometry frame, where they are tied at the first pose [m]."""
    anchored_orientation_error_rad: Array
    """(N, 3) Rotation vector from the estimate to the truth, in the IMU frame, tied at the first pose [rad]."""

    @property
    def position_sigma_m(self) -> Array | None:
        """(N,) Root of the trace of the position's covariance: the distance to be expected (r.m.s.) [m]."""
        return _expected_norm(self.estimate.covariance, slice(3, 6))

    @property
    def orientation_sigma_rad(self) -> Array | None:
        """(N,) The same for the orientation [rad]."""
        return _expected_norm(self.estimate.covariance, slice(0, 3))

    @classmethod
    def of(cls, truth: Trajectory, estimate: Trajectory) -> Self:
        """Compare an estimate with the truth where both are known.

        Raises:
            EvaluationError: The two share no time.
        """
        shared = (estimate.t_ns >= truth.t_ns[0]) & (estimate.t_ns <= truth.t_ns[-1])
        if not shared.any():
            raise EvaluationError("an estimate and a truth that share no time")
        estimate = estimate[shared]
        truth = interpolate(truth, estimate.t_ns)
        T_world_odom = fit_yaw_and_position(truth.p_world_imu, estimate.p_world_imu)
        fitted = transformed(T_world_odom, estimate)
        anchor = T_world_odom_at_first_pose(truth, estimate)
        anchored = transformed(anchor, estimate)
        return cls(
            truth,
            fitted,
            T_world_odom,
            np.asarray(np.linalg.norm(fitted.p_world_imu - truth.p_world_imu, axis=1)),
            np.asarray(np.linalg.norm(_rotation_between(fitted, truth), axis=1)),
            (anchored.p_world_imu - truth.p_world_imu) @ anchor[:3, :3],
            _rotation_between(anchored, truth),
        )


def interpolate(trajectory: Trajectory, t_ns: Times) -> Trajectory:
    """Return a trajectory at other time stamps (N,) within its span; straight lines and shortest arcs between poses."""
    after = np.clip(np.searchsorted(trajectory.t_ns, t_ns), 1, len(trajectory) - 1)
    t0, t1 = trajectory.t_ns[after - 1], trajectory.t_ns[after]
    fraction = (t_ns - t0) / (t1 - t0)

    def between(values: Array) -> Array:
        return values[after - 1] + fraction[:, None] * (values[after] - values[after - 1])

    def between_if_known(values: Array | None) -> Array | None:
        return None if values is None else between(values)

    return Trajectory(
        t_ns,
        between(trajectory.p_world_imu),
        slerp_quat_wxyz(trajectory.quat_wxyz[after - 1], trajectory.quat_wxyz[after], fraction),
        between_if_known(trajectory.velocity_m_s),
        between_if_known(trajectory.gyro_bias_rad_s),
        between_if_known(trajectory.accel_bias_m_s2),
    )


def transformed(T_a_b: Array, trajectory_b: Trajectory) -> Trajectory:
    """Return a trajectory given in frame b in frame a; covariances stay in b."""
    R = T_a_b[:3, :3]
    velocity = trajectory_b.velocity_m_s
    return replace(
        trajectory_b,
        p_world_imu=trajectory_b.p_world_imu @ R.T + T_a_b[:3, 3],
        quat_wxyz=quat_wxyz_from_matrix(R @ trajectory_b.rotations),
        velocity_m_s=None if velocity is None else velocity @ R.T,
    )


def T_world_odom_at_first_pose(truth: Trajectory, estimate: Trajectory) -> Array:
    """Return the (4, 4) turn about z and shift that lay the first pose of an estimate on the truth's.

    The turn is the yaw of the rotation between them: the rotation about z that is nearest to it.
    """
    R = truth.rotations[0] @ estimate.rotations[0].T
    return _about_z(np.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1]), truth.p_world_imu[0], estimate.p_world_imu[0])


def fit_yaw_and_position(p_world: Array, p_odom: Array) -> Array:
    """Return the (4, 4) turn about z and shift that lay points (N, 3) on others (N, 3), least squares."""
    a, b = p_world - p_world.mean(axis=0), p_odom - p_odom.mean(axis=0)
    yaw_rad = np.arctan2(np.sum(b[:, 0] * a[:, 1] - b[:, 1] * a[:, 0]), np.sum(b[:, :2] * a[:, :2]))
    return _about_z(yaw_rad, p_world.mean(axis=0), p_odom.mean(axis=0))


def _about_z(yaw_rad: float, p_world: Array, p_odom: Array) -> Array:
    """Return the (4, 4) turn about z that lays one point (3,) on another (3,)."""
    R = exp_so3(np.array([0.0, 0.0, yaw_rad]))
    return pose_matrix(R, p_world - R @ p_odom)


def _rotation_between(a: Trajectory, b: Trajectory) -> Array:
    """Return the rotation vectors (N, 3) that lead from the orientations of a to those of b [rad]."""
    return log_so3(np.swapaxes(a.rotations, -1, -2) @ b.rotations)


def _expected_norm(covariance: Array | None, block: slice) -> Array | None:
    return None if covariance is None else np.asarray(np.sqrt(np.trace(covariance[:, block, block], axis1=1, axis2=2)))
