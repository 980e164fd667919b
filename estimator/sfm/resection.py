"""Pose of an image from points whose positions are known (perspective-n-point)."""

import cv2
import numpy as np
import numpy.typing as npt

from dronevio.estimator.sfm.bearings import angles_between_rad, tangent_bases
from dronevio.estimator.sfm.config import ResectionConfig
from dronevio.models.rotation import exp_so3, pose_matrix, skew

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

MAX_PINHOLE_RAD = np.radians(75.0)
"""Largest angle from the optical axis of the points that RANSAC uses [rad]."""
GAUSS_NEWTON_STEPS = 8


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
    if is_inlier.sum() < max(config.min_inliers, config.min_ratio * len(points)):
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
    bases = tangent_bases(bearings)
    T = T_world_cam
    for _ in range(GAUSS_NEWTON_STEPS):
        p = (points - T[:3, 3]) @ T[:3, :3]
        distance = np.linalg.norm(p, axis=1, keepdims=True)
        u = p / distance
        residual = np.einsum("nij,nj->ni", bases, u)
        J_u = (bases - np.einsum("nij,nj->ni", bases, u)[..., None] * u[:, None, :]) / distance[:, None]
        J = np.concatenate([np.einsum("nij,njk->nik", J_u, skew(p)), -J_u], axis=2)
        behind = np.sum(u * bearings, axis=1) <= 0.0
        weight = np.where(behind, 0.0, 1.0 / (1.0 + np.sum(residual**2, axis=1) / scale_rad**2))
        H = np.einsum("n,nij,nik->jk", weight, J, J)
        g = np.einsum("n,nij,ni->j", weight, J, residual)
        step = -np.linalg.lstsq(H, g, rcond=None)[0]
        # The translation is that of the camera in its own frame: t ← t + R δ.
        T = pose_matrix(T[:3, :3] @ exp_so3(step[:3]), T[:3, 3] + T[:3, :3] @ step[3:])
        if np.linalg.norm(step[:3]) < 1e-9:
            break
    return T
