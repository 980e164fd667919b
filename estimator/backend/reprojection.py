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
from functools import cached_property

import numpy as np
import numpy.typing as npt

from dronevio.estimator.backend.observations import ObservationTable
from dronevio.estimator.backend.triangulation import MIN_DEPTH_M
from dronevio.models.arrays import Array, Integers

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
    """(L, 3, 6K) Off-diagonal blocks between landmarks (rows) and poses (columns)."""
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
        gain = (self._inverse_H_point * eliminated[:, None, None]) @ self.H_cross
        gain_rows, cross_rows = (A.reshape(-1, 6 * K) for A in (gain, self.H_cross))
        H = -gain_rows.T @ cross_rows
        for k in range(K):
            H[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] += self.H_pose[k]
        b = self.b_pose.ravel() - gain_rows.T @ self.b_point.ravel()
        return H, b

    def back_substitute(self, delta_poses: Array) -> Array:
        """Return the step (L, 3) of the landmarks that belongs to a step (K, 6) of the poses."""
        b = self.b_point - self.H_cross @ delta_poses.ravel()
        return np.asarray((self._inverse_H_point @ b[..., None])[..., 0])

    @cached_property
    def _inverse_H_point(self) -> Array:
        """(L, 3, 3) Inverses of the landmarks' blocks, damped because a depth may be unconstrained."""
        damping = RELATIVE_DAMPING * np.trace(self.H_point, axis1=1, axis2=2)[:, None, None] + 1e-12
        return np.linalg.inv(self.H_point + damping * np.eye(3))


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
    _, (x, y, depth) = _to_imu_and_camera_frame(observations, indices, Ts_imu_cam, state)
    inverse_depth = 1.0 / np.maximum(depth, MIN_DEPTH_M)
    return observations.xy - np.column_stack([x * inverse_depth, y * inverse_depth]), depth


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
    K, L, N = len(R_world_imu), len(linearization_point.points), len(observations)
    root_weight = np.sqrt(weight)
    inverse_depth = 1.0 / np.maximum(p_cam[2], MIN_DEPTH_M)
    axes = _selected(np.swapaxes(Ts_imu_cam[:, :3, :3], 1, 2), observations.camera)  # of the camera, in the IMU frame
    projected = p_cam[:2] * inverse_depth
    J_imu = (axes[:2] - projected[:, None] * axes[2]) * (root_weight * inverse_depth)
    J_point = np.einsum("rin,jin->rjn", J_imu, _selected(R_world_imu, indices.keyframe))
    J_r = np.empty((2, 7, N))  # Jacobian by the pose, and the residual
    for axis, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):  # the cross product of each row of J_imu with p_imu
        J_r[:, axis] = J_imu[:, i] * p_imu[j] - J_imu[:, j] * p_imu[i]
    J_r[:, 3:6] = -J_imu
    J_r[:, 6] = residual.T * root_weight

    order = np.argsort(indices.keyframe, kind="stable")
    bounds = np.searchsorted(indices.keyframe[order], np.arange(K + 1)).tolist()
    H_b_pose, by_keyframe = np.zeros((K, 6, 7)), J_r.take(order, axis=2).swapaxes(0, 1)  # H and b side by side
    for k in range(K):
        J_r_k = by_keyframe[..., bounds[k] : bounds[k + 1]].reshape(7, -1)
        H_b_pose[k] = J_r_k[:6] @ J_r_k.T

    block = L * indices.keyframe + indices.landmark
    by_block = _sums(_transposed_products(J_point, J_r[:, :6]), block, K * L).reshape(3, 6, K, L)
    H_cross = by_block.transpose(3, 0, 2, 1).reshape(L, 3, 6 * K)
    J_r_point = np.concatenate([J_point, J_r[:, 6:]], axis=1)
    H_b_point = np.moveaxis(_sums(_transposed_products(J_point, J_r_point), indices.landmark, L), 2, 0)
    return VisualSystem(H_b_pose[..., :6], H_b_pose[..., 6], H_cross, H_b_point[..., :3], H_b_point[..., 3])


def _transposed_products(A: Array, B: Array) -> Array:
    """Return AᵀB (i, j, N) of N matrices with two rows, (2, i, N) and (2, j, N)."""
    return np.asarray(np.einsum("rin,rjn->ijn", A, B))


def _sums(values: Array, group: Integers, count: int) -> Array:
    """Return the sums (..., G) of values (..., N) over those of each group (N,), of a number of groups G."""
    sums = np.empty((*values.shape[:-1], count))
    for index in np.ndindex(values.shape[:-1]):
        sums[index] = np.bincount(group, values[index], count)
    return sums


def _selected(matrices: Array, indices: Integers) -> Array:
    """Return some of several matrices (M, 3, 3) by their indices (N,), components first: (3, 3, N)."""
    return matrices.reshape(-1, 9).T.take(indices, axis=1).reshape(3, 3, -1)


def _to_imu_and_camera_frame(
    observations: ObservationTable, indices: ObservationIndices, Ts_imu_cam: Array, state: VisualState
) -> tuple[Array, Array]:
    """Return the positions (3, N) of the observed landmarks in the IMU frame and in the camera frame.

    Components come first here and in `visual_system`, so that the innermost loops of numpy go over the observations.
    """
    keyframe, camera = indices.keyframe, observations.camera
    relative = state.points.T.take(indices.landmark, axis=1) - state.p_world_imu.T.take(keyframe, axis=1)
    p_imu = np.einsum("in,ijn->jn", relative, _selected(state.R_world_imu, keyframe))
    from_camera = p_imu - Ts_imu_cam[:, :3, 3].T.take(camera, axis=1)
    return p_imu, np.einsum("in,ijn->jn", from_camera, _selected(Ts_imu_cam[:, :3, :3], camera))
