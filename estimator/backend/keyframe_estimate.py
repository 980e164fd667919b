"""Keyframes that leave the smoother's window: their final estimates, for a map that is built around the odometry."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from dronevio.estimator.backend.marginal_prior import POSE_DIM, STATE_DIM
from dronevio.estimator.backend.window import Window
from dronevio.estimator.optimization.linalg import CholeskyFactor
from dronevio.models.arrays import Array, Integers
from dronevio.models.rotation import adjoint
from dronevio.models.state import NavState

_NO_LANDMARKS = np.zeros(0, np.int64), np.zeros((0, 3))


@dataclass(frozen=True, eq=False)
class KeyframeEstimate:
    """The estimate of a keyframe for a map: the final one when it leaves the window, or that of the newest state.

    Covariances of poses are in GTSAM's order: δθ, then δp, both in the IMU frame (right perturbation).
    """

    t_ns: int
    """Time of the keyframe by the IMU's clock [ns]."""
    T_odom_imu: Array
    """(4, 4) Pose of the IMU in the odometry frame."""
    covariance: Array
    """(6, 6) Covariance of that pose, where yaw and position of the first pose are known."""
    next_t_ns: int
    """Time of the next keyframe of the window [ns]."""
    T_imu_next: Array
    """(4, 4) Pose of the next keyframe in the frame of this one, by the same window."""
    relative_covariance: Array
    """(6, 6) Covariance of that pose."""
    landmark_ids: Integers
    """(L,) Identities of the triangulated landmarks that the keyframe observes, in increasing order."""
    landmarks_odom: Array
    """(L, 3) Their positions in the odometry frame [m]."""

    @classmethod
    def of_state(
        cls, state: NavState, landmark_ids: Integers = _NO_LANDMARKS[0], landmarks_odom: Array = _NO_LANDMARKS[1]
    ) -> Self:
        """Return a state with its causal covariance as that of a keyframe; the relative covariance is zero.

        Args:
            state: The state, with its covariance.
            landmark_ids: (L,) Identities of the triangulated landmarks that it observes, in increasing order.
            landmarks_odom: (L, 3) Their positions in the odometry frame [m].
        """
        S, zero = np.eye(6), np.zeros((6, 6))
        S[3:, 3:] = state.T_world_imu[:3, :3].T
        covariance = zero if state.covariance is None else S @ state.covariance[:6, :6] @ S.T
        return cls(state.t_ns, state.T_world_imu, covariance, state.t_ns, np.eye(4), zero, landmark_ids, landmarks_odom)


def keyframe_estimate(
    window: Window, index: int, solver: CholeskyFactor, times_ns: dict[int, int], position_covariance: Array
) -> KeyframeEstimate:
    """Return the final estimate of a keyframe of a window.

    Args:
        window: The window, which still contains the keyframe.
        index: Index of the keyframe in the window; it must not be the last one.
        solver: Cholesky factor of the window's linear system.
        times_ns: Times of the keyframes by their numbers [ns].
        position_covariance: (3, 3) Covariance of the position at which the window begins, in the odometry frame [m²].
    """
    (k, state), (following, next_state) = list(window.states.items())[index : index + 2]
    pose_columns = np.arange(POSE_DIM)
    columns = np.concatenate([STATE_DIM * index + pose_columns, STATE_DIM * (index + 1) + pose_columns])
    P = solver.inverse_block(columns)
    J = np.hstack([-adjoint(next_state.pose.between(state.pose).matrix()), np.eye(POSE_DIM)])
    covariance, R = P[:POSE_DIM, :POSE_DIM].copy(), state.pose.rotation().matrix()
    covariance[3:, 3:] += R.T @ position_covariance @ R
    landmarks = window.landmarks
    ids = np.intersect1d(landmarks.observed_in(k), landmarks.ids, assume_unique=True)
    return KeyframeEstimate(
        times_ns[k],
        state.pose.matrix(),
        covariance,
        times_ns[following],
        state.pose.between(next_state.pose).matrix(),
        np.asarray(J @ P @ J.T),
        ids,
        landmarks.points[landmarks.rows(ids)],
    )
