"""Pose of an image from points whose positions are known (perspective-n-point)."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt

from dronevio.estimator.optimization.gauss_newton import Step, gauss_newton
from dronevio.estimator.optimization.linalg import LeastNormFactor
from dronevio.estimator.optimization.robust import cauchy_inflation, cauchy_loss
from dronevio.estimator.sfm.bearings import angles_between_rad, tangent_bases
from dronevio.estimator.sfm.config import ResectionConfig
from dronevio.models.arrays import Array, Mask
from dronevio.models.rotation import exp_so3, pose_matrix, skew

MAX_PINHOLE_RAD = np.radians(75.0)
"""Largest angle from the optical axis of the points that RANSAC uses [rad]."""
MIN_INLIER_RATIO = 0.25
"""Smallest ratio of the inliers to the points that the image observes."""
GAUSS_NEWTON_STEPS = 8
MIN_STEP_RAD = 1e-9
"""Rotation after which a step is the last one [rad]."""


def resect(points: Array, bearings: Array, focal_px: float, config: ResectionConfig) -> tuple[Array, Mask] | None:
    """Return the pose (4, 4) of a camera in the world frame and the inliers (N,), None if there are too few.

    Args:
        points: (N, 3) Points in the world frame.
        bearings: (N, 3) Unit vectors in the camera frame.
        focal_px: Focal length, the scale between angles and pixels [px].
        config: Thresholds.
    """
    # RANSAC on a pinhole image of the rays near the axis
    is_central = bearings[:, 2] > np.cos(MAX_PINHOLE_RAD)
    if is_central.sum() < max(config.min_inliers, 6):
        return None
    xy = focal_px * bearings[is_central, :2] / bearings[is_central, 2:]
    K = np.diag([focal_px, focal_px, 1.0])
    parameters = cv2.UsacParams()
    parameters.threshold = config.max_error_px
    parameters.maxIterations = config.max_iterations
    parameters.confidence = 0.99999
    parameters.score = cv2.SCORE_METHOD_MSAC
    parameters.loMethod = cv2.LOCAL_OPTIM_INNER_LO
    parameters.sampler = cv2.SAMPLING_UNIFORM
    try:
        is_solved, _, r, t, _ = cv2.solvePnPRansac(
            np.ascontiguousarray(points[is_central]), np.ascontiguousarray(xy), K, np.zeros(4), params=parameters
        )
    except cv2.error:
        return None
    if not is_solved or r is None:
        return None
    # Refinement by all rays
    R_cam_world = exp_so3(np.asarray(r, np.float64).reshape(3))
    T = pose_matrix(R_cam_world.T, -R_cam_world.T @ np.asarray(t, np.float64).reshape(3))
    threshold_rad = config.max_error_px / focal_px
    T = refine_pose(T, points, bearings, 0.25 * threshold_rad)
    is_inlier = angles_between_rad((points - T[:3, 3]) @ T[:3, :3], bearings) < threshold_rad
    if is_inlier.sum() < max(config.min_inliers, MIN_INLIER_RATIO * len(points)):
        return None
    return T, is_inlier


def refine_pose(T_world_cam: Array, points: Array, bearings: Array, scale_rad: float) -> Array:
    """Return the pose (4, 4) that minimizes a Cauchy loss of the angles between bearings and points.

    Args:
        T_world_cam: (4, 4) Initial pose.
        points: (N, 3) Points in the world frame.
        bearings: (N, 3) Unit vectors in the camera frame.
        scale_rad: Scale of the Cauchy loss [rad].
    """
    objective = ResectionObjective(points, bearings, scale_rad)
    return gauss_newton(objective, T_world_cam, LeastNormFactor, GAUSS_NEWTON_STEPS, _is_short).x


def _is_short(step: Step[Array, LeastNormFactor]) -> bool:
    return float(np.linalg.norm(step.delta[:3])) < MIN_STEP_RAD


@dataclass(frozen=True, eq=False)
class PoseEquations:
    """Normal equations of a camera's pose."""

    H: Array
    """(6, 6) Information matrix of rotation and translation, both in the camera frame."""
    b: Array
    """(6,) Right-hand side, the negative gradient."""
    x: Array
    """(4, 4) Pose of the camera in the world frame."""
    scales: npt.NDArray[np.bool_]
    """(N,) Whether a point is in front of the camera."""

    def retract(self, delta: Array) -> Array:
        """Return the pose (4, 4) after a step (6,): t ← t + R δ."""
        R, t = self.x[:3, :3], self.x[:3, 3]
        return pose_matrix(R @ exp_so3(delta[:3]), t + R @ delta[3:])


@dataclass(frozen=True, eq=False)
class ResectionObjective:
    """Cauchy's loss of the angles between bearings and points; the variable is the pose (4, 4) of the camera."""

    points: Array
    """(N, 3) Points in the world frame."""
    bearings: Array
    """(N, 3) Unit vectors in the camera frame."""
    scale_rad: float
    """Scale of the loss [rad]."""

    def linearize(self, x: Array) -> PoseEquations:
        """Return the normal equations at a pose; points behind the camera have no weight."""
        p = (self.points - x[:3, 3]) @ x[:3, :3]
        distance = np.linalg.norm(p, axis=1, keepdims=True)
        u = p / distance
        residual = np.einsum("nij,nj->ni", self._bases, u)
        J_u = (self._bases - residual[..., None] * u[:, None, :]) / distance[:, None]
        J = np.concatenate([np.einsum("nij,njk->nik", J_u, skew(p)), -J_u], axis=2)
        is_ahead = np.sum(u * self.bearings, axis=1) > 0.0
        inflation = cauchy_inflation(np.sum(residual**2, axis=1), self.scale_rad**2)
        weight = np.where(is_ahead, 1.0 / inflation, 0.0)
        H = np.einsum("n,nij,nik->jk", weight, J, J)
        return PoseEquations(H, -np.einsum("n,nij,ni->j", weight, J, residual), x, is_ahead)

    def cost(self, x: Array, scales: npt.NDArray[np.bool_]) -> float:
        """Return half of the sum of the losses of the points that were in front of the camera."""
        p = (self.points - x[:3, 3]) @ x[:3, :3]
        residual = np.einsum("nij,nj->ni", self._bases, p / np.linalg.norm(p, axis=1, keepdims=True))
        losses = cauchy_loss(np.sum(residual**2, axis=1), self.scale_rad**2)
        return 0.5 * float(losses[scales].sum())

    @cached_property
    def _bases(self) -> Array:
        """(N, 2, 3) Bases of the tangent planes at the bearings."""
        return tangent_bases(self.bearings)
