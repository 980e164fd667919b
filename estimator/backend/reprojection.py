"""Linearized reprojection errors: the visual part of the smoother's bundle adjustment.

A landmark at P, observed by a camera at (R_imu_cam, p_imu_cam) of a rig at (R, p), projects to (x/z, y/z) of
R_imu_camᵀ (Rᵀ (P − p) − p_imu_cam). Its residual is linearized by the pose, with the tangent vector (δθ, δp) in the IMU
frame as in GTSAM, and by P in the world frame. The landmarks are then eliminated all at once by the Schur complement
(Triggs et al., "Bundle adjustment: a modern synthesis", 2000, section 6.1).

Residuals are evaluated at the current estimates. Jacobians are evaluated at the linearization points of the variables
that the marginal prior holds (first-estimates Jacobians), so that unobservable directions gain no information (Huang,
Mourikis, Roumeliotis, "A first-estimates Jacobian EKF for improving SLAM consistency", ISER 2008).
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.estimator.backend.observations import Integers, ObservationTable
from dronevio.estimator.backend.triangulation import MIN_DEPTH_M
from dronevio.models.rotation import cross

Array = npt.NDArray[np.float64]

MEDIAN_CHI2_2DOF = 2.0 * math.log(2.0)
"""Median of the χ² distribution with two degrees of freedom, that of the squared residual of an image observation."""
RELATIVE_DAMPING = 1e-9
"""Addition to the information on a landmark, relative to its trace, because its depth may be unconstrained."""


@dataclass(frozen=True, eq=False)
class VisualState:
    """Poses of K keyframes and positions of L landmarks: current estimates or linearization points."""

    R_world_imu: Array
    """(K, 3, 3) Orientations of the keyframes."""
    p_world_imu: Array
    """(K, 3) Positions of the keyframes [m]."""
    points: Array
    """(L, 3) Positions of the landmarks in the world frame [m]."""


@dataclass(frozen=True, eq=False)
class ObservationIndices:
    """The variables of N observations, as indices into the arrays of a `VisualState`."""

    keyframe: Integers
    """(N,) Index of the keyframe."""
    landmark: Integers
    """(N,) Index of the landmark."""


@dataclass(frozen=True, eq=False)
class VisualSystem:
    """Normal equations H δ = b of K poses and L landmarks in blocks."""

    H_pose: Array
    """(K, 6, 6) Diagonal blocks of the poses."""
    b_pose: Array
    """(K, 6) Right-hand side of the poses."""
    H_cross: Array
    """(L, K, 6, 3) Off-diagonal blocks between poses (rows) and landmarks (columns)."""
    H_point: Array
    """(L, 3, 3) Diagonal blocks of the landmarks."""
    b_point: Array
    """(L, 3) Right-hand side of the landmarks."""

    def reduced_system(self, eliminated: npt.NDArray[np.bool_]) -> tuple[Array, Array]:
        """Return the normal equations of the poses after elimination of some landmarks; the others are left out.

        Args:
            eliminated: (L,) Whether a landmark is eliminated.

        Returns:
            The information matrix (6K, 6K) and the right-hand side (6K,).
        """
        K = len(self.H_pose)
        H_cross = self.H_cross[eliminated].reshape(-1, 6 * K, 3)
        gain = H_cross @ _damped_inverse(self.H_point[eliminated])
        gain_rows, cross_rows = (np.swapaxes(A, 0, 1).reshape(6 * K, -1) for A in (gain, H_cross))
        H = -gain_rows @ cross_rows.T
        for k in range(K):
            H[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] += self.H_pose[k]
        b = self.b_pose.ravel() - gain_rows @ self.b_point[eliminated].ravel()
        return H, b

    def back_substitute(self, delta_poses: Array) -> Array:
        """Return the step (L, 3) of the landmarks that belongs to a step (K, 6) of the poses."""
        b = self.b_point - np.einsum("lkpi,kp->li", self.H_cross, delta_poses)
        return np.asarray((_damped_inverse(self.H_point) @ b[..., None])[..., 0])


def residuals(
    observations: ObservationTable, indices: ObservationIndices, Ts_imu_cam: Array, state: VisualState
) -> tuple[Array, Array]:
    """Return the residuals of observations and the depths of their landmarks.

    Args:
        observations: N observations.
        indices: Their keyframes and landmarks in the state.
        Ts_imu_cam: (C, 4, 4) Poses of the rig's cameras.
        state: Poses and landmarks.

    Returns:
        The observed minus the projected normalized coordinates (N, 2), and the depths (N,) [m].
    """
    p_cam = _to_imu_and_camera_frame(observations, indices, Ts_imu_cam, state)[1]
    depth = p_cam[:, 2]
    return observations.xy - p_cam[:, :2] / np.maximum(depth, MIN_DEPTH_M)[:, None], depth


def visual_system(
    observations: ObservationTable,
    indices: ObservationIndices,
    Ts_imu_cam: Array,
    linearization_point: VisualState,
    residual: Array,
    weight: Array,
) -> VisualSystem:
    """Return the normal equations of observations.

    Args:
        observations: N observations.
        indices: Their keyframes and landmarks in the state.
        Ts_imu_cam: (C, 4, 4) Poses of the rig's cameras.
        linearization_point: Poses and landmarks at which the Jacobians are evaluated.
        residual: (N, 2) Residuals at the current estimates.
        weight: (N,) Weight of each residual, its inverse variance.
    """
    p_imu, p_cam = _to_imu_and_camera_frame(observations, indices, Ts_imu_cam, linearization_point)
    R_world_imu = linearization_point.R_world_imu
    K, L = len(R_world_imu), len(linearization_point.points)
    inverse_depth = 1.0 / np.maximum(p_cam[:, 2], MIN_DEPTH_M)
    scaled = np.sqrt(weight) * inverse_depth
    R_cam_imu = np.swapaxes(Ts_imu_cam[:, :3, :3], 1, 2)[observations.camera]
    projected = p_cam[:, :2] * inverse_depth[:, None]
    J_imu = (R_cam_imu[:, :2] - projected[:, :, None] * R_cam_imu[:, None, 2]) * scaled[:, None, None]
    J_point = _products(J_imu, np.swapaxes(R_world_imu, 1, 2)[indices.keyframe])
    J_pose = np.concatenate([cross(J_imu, p_imu[:, None]), -J_imu], axis=2)
    r = (residual * np.sqrt(weight)[:, None])[..., None]

    order = np.argsort(indices.keyframe, kind="stable")
    bounds = np.searchsorted(indices.keyframe[order], np.arange(K + 1)).tolist()
    H_b_pose, J_r = np.zeros((K, 6, 7)), np.concatenate([J_pose, r], axis=2)[order]  # H and b side by side
    for k in range(K):
        J_r_k = J_r[bounds[k] : bounds[k + 1]].reshape(-1, 7)
        H_b_pose[k] = J_r_k[:, :6].T @ J_r_k

    H_cross, products = np.zeros((L, K, 6, 3)), _transposed_products(J_pose, J_point)
    for camera in range(len(Ts_imu_cam)):  # a camera observes a landmark once in a keyframe
        rows = np.flatnonzero(observations.camera == camera)
        H_cross[indices.landmark[rows], indices.keyframe[rows]] += products[rows]

    H_b_point, order = np.zeros((L, 3, 4)), np.argsort(indices.landmark, kind="stable")
    landmark = indices.landmark[order]
    starts = np.flatnonzero(np.diff(landmark, prepend=-1))
    products = _transposed_products(J_point, np.concatenate([J_point, r], axis=2))[order]
    H_b_point[landmark[starts]] = np.add.reduceat(products, starts) if len(order) else 0.0
    return VisualSystem(H_b_pose[..., :6], H_b_pose[..., 6], H_cross, H_b_point[..., :3], H_b_point[..., 3])


def _transposed_products(A: Array, B: Array) -> Array:
    """Return AᵀB (N, i, j) of matrices with two rows, (N, 2, i) and (N, 2, j); much faster than `numpy.matmul`."""
    return np.asarray(A[:, 0, :, None] * B[:, 0, None, :] + A[:, 1, :, None] * B[:, 1, None, :])


def _products(A: Array, B: Array) -> Array:
    """Return A B (N, i, 3) of matrices (N, i, 3) and (N, 3, 3); much faster than `numpy.matmul`."""
    first, second, third = (A[..., k, None] * B[:, None, k] for k in range(3))
    return np.asarray(first + second + third)


def _to_imu_and_camera_frame(
    observations: ObservationTable, indices: ObservationIndices, Ts_imu_cam: Array, state: VisualState
) -> tuple[Array, Array]:
    """Return the positions (N, 3) of the observed landmarks in the IMU frame and in the camera frame."""
    relative = (state.points[indices.landmark] - state.p_world_imu[indices.keyframe])[:, None]
    p_imu = _products(relative, state.R_world_imu[indices.keyframe])[:, 0]
    T = Ts_imu_cam[observations.camera]
    p_cam = _products((p_imu - T[:, :3, 3])[:, None], T[:, :3, :3])[:, 0]
    return p_imu, p_cam


def _damped_inverse(information: Array) -> Array:
    """Return the inverses (L, 3, 3) of information matrices, damped because a depth may be unconstrained."""
    damping = RELATIVE_DAMPING * np.trace(information, axis1=1, axis2=2)[:, None, None] + 1e-12
    return np.linalg.inv(information + damping * np.eye(3))
