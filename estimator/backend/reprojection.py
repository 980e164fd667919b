"""What observations say of keyframes and landmarks, to first order: the visual half of bundle adjustment.

A landmark at P, seen by a camera at (R_imu_cam, p_imu_cam) of a rig at (R, p), should appear at x/z, y/z of
R_imu_camᵀ (Rᵀ (P − p) − p_imu_cam). Its residual is linear in small changes of both: of the rig's pose by (δθ, δp) in
the IMU's own axes, which is GTSAM's convention, and of P in the world. The landmarks are then eliminated by the Schur
complement (Triggs et al., "Bundle adjustment, a modern synthesis", 2000, section 6.1), all at once.

Residuals are those of the present estimate; Jacobians are taken where each variable was first linearized, if it is tied
to the marginal prior, so that the linear system invents no knowledge of what cannot be observed (Huang, Mourikis,
Roumeliotis, "A first-estimates Jacobian EKF for improving SLAM consistency", ISER 2008).
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.estimator.backend.observations import Integers, ObservationTable
from dronevio.estimator.backend.triangulation import MIN_DEPTH_M
from dronevio.models.rotation import skew

Array = npt.NDArray[np.float64]

MEDIAN_CHI2_2DOF = 2.0 * math.log(2.0)
"""Median of the χ² distribution with two degrees of freedom, that of the squared residual of an image observation."""
RELATIVE_DAMPING = 1e-9  # of a landmark in a direction, relative to its trace: how far away it is may be unknown


@dataclass(frozen=True, eq=False)
class Scene:
    """Where the rig and the landmarks are, or were when they were linearized."""

    R_world_imu: Array
    """(K, 3, 3) Orientations of the keyframes."""
    p_world_imu: Array
    """(K, 3) Positions of the keyframes [m]."""
    points: Array
    """(L, 3) Landmarks in the world [m]."""


@dataclass(frozen=True, eq=False)
class Rows:
    """For each of N observations, its keyframe's and its landmark's place in a `Scene`."""

    keyframe: Integers
    """(N,) Rows of the keyframes."""
    landmark: Integers
    """(N,) Rows of the landmarks."""


@dataclass(frozen=True, eq=False)
class VisualSystem:
    """Normal equations of K poses and L landmarks: information, and what it pulls towards (H δ = b)."""

    pose: Array
    """(K, 6, 6) Information on each pose."""
    pose_b: Array
    """(K, 6) Its right side."""
    cross: Array
    """(L, K, 6, 3) Information between poses and landmarks."""
    point: Array
    """(L, 3, 3) Information on each landmark."""
    point_b: Array
    """(L, 3) Its right side."""

    def without_points(self, eliminated: npt.NDArray[np.bool_]) -> tuple[Array, Array]:
        """Return the information (6K, 6K) on the poses, and its right side (6K,), some landmarks (L,) eliminated."""
        K = len(self.pose)
        cross = self.cross[eliminated].reshape(-1, 6 * K, 3)
        inverse = _inverse(self.point[eliminated])
        gain = cross @ inverse
        H = -np.tensordot(gain, cross, axes=([0, 2], [0, 2]))
        for k in range(K):
            H[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] += self.pose[k]
        b = self.pose_b.ravel() - np.einsum("lpi,li->p", gain, self.point_b[eliminated])
        return H, b

    def points_given(self, poses: Array) -> Array:
        """Return the change (L, 3) of the landmarks that goes with one of the poses (K, 6)."""
        pulled = self.point_b - np.einsum("lkpi,kp->li", self.cross, poses)
        return np.asarray((_inverse(self.point) @ pulled[..., None])[..., 0])


def residuals(observations: ObservationTable, rows: Rows, Ts_imu_cam: Array, scene: Scene) -> tuple[Array, Array]:
    """Return how far each sighting is from where it should be (N, 2), and the landmark's depth (N,) [m]."""
    p_cam = _in_camera(observations, rows, Ts_imu_cam, scene)[1]
    depth = p_cam[:, 2]
    return observations.xy - p_cam[:, :2] / np.maximum(depth, MIN_DEPTH_M)[:, None], depth


def visual_system(
    observations: ObservationTable, rows: Rows, Ts_imu_cam: Array, first: Scene, error: Array, weight: Array
) -> VisualSystem:
    """Return the normal equations of some observations.

    Args:
        observations: N of them.
        rows: Where they belong in the scene.
        Ts_imu_cam: (C, 4, 4) Poses of the rig's cameras.
        first: Where to take Jacobians.
        error: (N, 2) Residuals.
        weight: (N,) Information of each residual, one over its variance.
    """
    p_imu, p_cam = _in_camera(observations, rows, Ts_imu_cam, first)
    K, L = len(first.R_world_imu), len(first.points)
    inverse_depth = 1.0 / np.maximum(p_cam[:, 2], MIN_DEPTH_M)
    scaled = np.sqrt(weight) * inverse_depth
    R_cam_imu = np.swapaxes(Ts_imu_cam[:, :3, :3], 1, 2)[observations.camera]
    projected = p_cam[:, :2] * inverse_depth[:, None]
    in_imu = (R_cam_imu[:, :2] - projected[:, :, None] * R_cam_imu[:, None, 2]) * scaled[:, None, None]
    J_point = in_imu @ np.swapaxes(first.R_world_imu, 1, 2)[rows.keyframe]
    J_pose = np.concatenate([in_imu @ skew(p_imu), -in_imu], axis=2)
    e = (error * np.sqrt(weight)[:, None])[..., None]
    pose, of_pose = np.zeros((K, 6, 7)), np.concatenate([J_pose, e], axis=2)
    for k in np.unique(rows.keyframe).tolist():
        own = of_pose[rows.keyframe == k].reshape(-1, 7)
        pose[k] = own[:, :6].T @ own
    cross, of_both = np.zeros((L, K, 6, 3)), _product(J_pose, J_point)
    for camera in range(len(Ts_imu_cam)):  # one camera of one keyframe sees a landmark once
        here = np.flatnonzero(observations.camera == camera)
        cross[rows.landmark[here], rows.keyframe[here]] += of_both[here]
    point, order = np.zeros((L, 3, 4)), np.argsort(rows.landmark, kind="stable")
    landmark = rows.landmark[order]
    first_of_each = np.flatnonzero(np.diff(landmark, prepend=-1))
    of_point = _product(J_point, np.concatenate([J_point, e], axis=2))[order]
    point[landmark[first_of_each]] = np.add.reduceat(of_point, first_of_each) if len(order) else 0.0
    return VisualSystem(pose[..., :6], pose[..., 6], cross, point[..., :3], point[..., 3])


def _product(A: Array, B: Array) -> Array:
    """Return AᵀB for many matrices of two rows, (N, 2, i) and (N, 2, j); much faster than a matrix product of each."""
    return np.asarray(A[:, 0, :, None] * B[:, 0, None, :] + A[:, 1, :, None] * B[:, 1, None, :])


def _in_camera(observations: ObservationTable, rows: Rows, Ts_imu_cam: Array, scene: Scene) -> tuple[Array, Array]:
    """Return the seen landmarks in the IMU's and in the camera's axes, (N, 3) each."""
    relative = (scene.points[rows.landmark] - scene.p_world_imu[rows.keyframe])[:, None]
    p_imu = (relative @ scene.R_world_imu[rows.keyframe])[:, 0]
    T = Ts_imu_cam[observations.camera]
    p_cam = ((p_imu - T[:, :3, 3])[:, None] @ T[:, :3, :3])[:, 0]
    return p_imu, p_cam


def _inverse(information: Array) -> Array:
    """Return the inverses (L, 3, 3), for what is far away damped in the direction that nothing tells."""
    least = RELATIVE_DAMPING * np.trace(information, axis1=1, axis2=2)[:, None, None] + 1e-12
    return np.linalg.inv(information + least * np.eye(3))
