"""Geometric verification of the matches of two images, and their relative pose.

An essential matrix explains the matches of two views of a static scene, and a homography those of a plane or of a
rotation without translation; neither of the latter determines a depth that can be relied upon (Hartley and Zisserman,
*Multiple ImageView Geometry*, 2004, section 11.9). Without calibration, a fundamental matrix verifies the matches.
"""

from dataclasses import dataclass
from enum import StrEnum

import cv2
import numpy as np

from dronevio.estimator.sfm.bearings import angles_between_rad, midpoints
from dronevio.estimator.sfm.config import VerificationConfig
from dronevio.estimator.sfm.matching import Matches
from dronevio.models.arrays import Array, Mask
from dronevio.models.camera import CameraModel
from dronevio.models.rotation import pose_matrix

MAX_PINHOLE_RAD = np.radians(65.0)
"""Largest angle from the optical axis of the matches that determine the essential matrix [rad]."""
PLANAR_SIGMAS = 4.0
"""Largest error of a match that a homography explains, relative to the noise of the epipolar distances."""
MIN_PLANAR_ERROR_PX = 0.3
"""Smallest value of that error [px]."""
MAX_HOMOGRAPHY_RATIO = 0.8
"""Smallest ratio of the inliers of a homography to those of the essential matrix at which a pair is planar."""
MAD_TO_SIGMA = 1.4826
"""Standard deviation of a normal distribution divided by the median absolute deviation."""
CONFIDENCE = 0.9999
"""Probability that RANSAC draws a sample without outliers."""


class Geometry(StrEnum):
    """What the matches of two images determine."""

    GENERAL = "general"
    """Rotation and direction of translation."""
    PLANAR = "planar"
    """A homography: the scene is a plane."""
    ROTATION = "rotation"
    """A rotation: the camera has not moved, or the scene is far away."""


@dataclass(frozen=True, eq=False)
class TwoView:
    """Two images with verified matches."""

    first: int
    """Index of the first image."""
    second: int
    """Index of the second image."""
    matches: Matches
    """(K, 2) Verified matches: indices of features of the first image and of the second."""
    geometry: Geometry
    """What the matches determine."""
    T_first_second: Array
    """(4, 4) Pose of the second camera in the frame of the first; the translation has length 1, or 0 for a rotation."""
    angle_rad: float
    """Median angle between the rays of a match, with the rotation removed [rad]."""


@dataclass(frozen=True, eq=False)
class ImageView:
    """Pixels of an image together with what verification needs of its camera."""

    pixels: Array
    """(N, 2) Pixels of the features."""
    bearings: Array
    """(N, 3) Unit vectors in the camera frame; NaN where the lens has none."""
    focal_px: float
    """Focal length, the scale between angles and pixels [px]."""
    is_calibrated: bool
    """Whether the camera model is known; otherwise it is a guess."""


def view_of(pixels: Array, camera: CameraModel, is_calibrated: bool) -> ImageView:
    """Return the view of an image from the pixels (N, 2) of its features."""
    return ImageView(pixels, camera.unproject(pixels), float(np.sqrt(np.prod(camera.central_focal_px))), is_calibrated)


def verify(
    first: int, second: int, views: tuple[ImageView, ImageView], matches: Matches, config: VerificationConfig
) -> TwoView | None:
    """Return the verified matches of two images, None if there are too few.

    Args:
        first: Index of the first image.
        second: Index of the second image.
        views: Features of both images.
        matches: (K, 2) Putative matches.
        config: Thresholds.
    """
    if len(matches) < config.min_inliers:
        return None
    # Rays of the matched features
    a, b = views
    f0, f1 = a.bearings[matches[:, 0]], b.bearings[matches[:, 1]]
    is_defined = np.isfinite(f0).all(axis=1) & np.isfinite(f1).all(axis=1)
    matches, f0, f1 = matches[is_defined], f0[is_defined], f1[is_defined]
    focal_px = min(a.focal_px, b.focal_px)
    threshold_rad = config.max_error_px / focal_px

    # Essential matrix; without a calibration, of the inliers of a fundamental matrix
    if a.is_calibrated and b.is_calibrated:
        E = _essential(f0, f1, focal_px, config)
        if E is None:
            return None
        is_inlier = _epipolar_angles(E, f0, f1) < threshold_rad
    else:
        pixels = a.pixels[matches[:, 0]], b.pixels[matches[:, 1]]
        is_inlier = _fundamental_inliers(*pixels, config)
        E = _essential(f0[is_inlier], f1[is_inlier], focal_px, config) if is_inlier.sum() >= 8 else None
    if E is None or is_inlier.sum() < config.min_inliers:
        return None
    matches, f0, f1 = matches[is_inlier], f0[is_inlier], f1[is_inlier]

    # Relative pose, which a pure rotation does not have
    geometry, R_rotation = _classify(E, f0, f1, focal_px, config)
    if geometry is Geometry.ROTATION:
        T = pose_matrix(R_rotation.T, np.zeros(3))
        angle = float(np.median(angles_between_rad(f0, f1 @ R_rotation)))
        return TwoView(first, second, matches, geometry, T, angle)
    T, is_in_front = _pose(E, f0, f1)
    if is_in_front.sum() < config.min_inliers:
        return None
    matches, f0, f1 = matches[is_in_front], f0[is_in_front], f1[is_in_front]
    angle = float(np.median(angles_between_rad(f0, f1 @ T[:3, :3].T)))
    return TwoView(first, second, matches, geometry, T, angle)


def _essential(f0: Array, f1: Array, focal_px: float, config: VerificationConfig) -> Array | None:
    """Return the essential matrix (3, 3) of most matches, f1ᵀ E f0 = 0; None if RANSAC finds none."""
    is_central = (f0[:, 2] > np.cos(MAX_PINHOLE_RAD)) & (f1[:, 2] > np.cos(MAX_PINHOLE_RAD))
    if is_central.sum() < 8:
        return None
    xy0, xy1 = (focal_px * f[is_central, :2] / f[is_central, 2:] for f in (f0, f1))
    K = np.diag([focal_px, focal_px, 1.0])
    E, _ = cv2.findEssentialMat(
        xy0, xy1, K, cv2.USAC_MAGSAC, CONFIDENCE, config.max_error_px, maxIters=config.max_iterations
    )
    return None if E is None or E.shape != (3, 3) else np.asarray(E)


def _fundamental_inliers(px0: Array, px1: Array, config: VerificationConfig) -> Mask:
    _, inliers = cv2.findFundamentalMat(
        px0, px1, cv2.USAC_MAGSAC, config.max_error_px, CONFIDENCE, config.max_iterations
    )
    return np.zeros(len(px0), np.bool_) if inliers is None else np.asarray(inliers[:, 0] == 1)


def _epipolar_angles(E: Array, f0: Array, f1: Array) -> Array:
    """Return the larger of the two angles (K,) between the rays of a match and their epipolar planes [rad]."""
    normals_1, normals_0 = f0 @ E.T, f1 @ E
    products = np.abs(np.sum(normals_1 * f1, axis=1))
    smaller = np.minimum(np.linalg.norm(normals_0, axis=1), np.linalg.norm(normals_1, axis=1))
    return np.asarray(products / np.maximum(smaller, 1e-15))


def _classify(E: Array, f0: Array, f1: Array, focal_px: float, config: VerificationConfig) -> tuple[Geometry, Array]:
    """Return the geometry of verified matches, and the rotation (3, 3) of the first frame into the second.

    A homography has to explain the matches as precisely as the essential matrix does: with little motion, it explains
    those of any scene to within a few pixels.
    """
    threshold_rad = config.max_error_px / focal_px
    R = _rotation(f0, f1)
    for _ in range(5):  # least squares over the matches that the rotation explains
        explained = angles_between_rad(f0 @ R.T, f1) < 2.0 * threshold_rad
        if explained.sum() < 3:
            break
        R = _rotation(f0[explained], f1[explained])
    needed = MAX_HOMOGRAPHY_RATIO * len(f0)
    if np.sum(angles_between_rad(f0 @ R.T, f1) < threshold_rad) >= needed:
        return Geometry.ROTATION, R
    is_central = (f0[:, 2] > np.cos(MAX_PINHOLE_RAD)) & (f1[:, 2] > np.cos(MAX_PINHOLE_RAD))
    xy0, xy1 = (focal_px * f[is_central, :2] / f[is_central, 2:] for f in (f0, f1))
    error_px = focal_px * _epipolar_angles(E, f0[is_central], f1[is_central])
    noise_px = MAD_TO_SIGMA * float(np.median(error_px)) if len(error_px) else 0.0
    max_error_px = float(np.clip(PLANAR_SIGMAS * noise_px, MIN_PLANAR_ERROR_PX, config.max_error_px))
    _, inliers = cv2.findHomography(xy0, xy1, cv2.USAC_MAGSAC, max_error_px, maxIters=config.max_iterations)
    needed = MAX_HOMOGRAPHY_RATIO * np.sum(error_px < max_error_px)
    is_planar = inliers is not None and inliers.sum() >= needed
    return (Geometry.PLANAR if is_planar else Geometry.GENERAL), R


def _rotation(f0: Array, f1: Array) -> Array:
    """Return the rotation R (3, 3) for which R f0 is nearest to f1 (Kabsch)."""
    U, _, Vt = np.linalg.svd(f1.T @ f0)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)


def _pose(E: Array, f0: Array, f1: Array) -> tuple[Array, Mask]:
    """Return the pose (4, 4) of the second camera in the first, and which matches (K,) lie in front of both cameras."""
    R1, R2, t = (np.asarray(part, np.float64) for part in cv2.decomposeEssentialMat(E))
    best = np.eye(4), np.zeros(len(f0), np.bool_)
    for R_1_0, t_1 in ((R1, t), (R1, -t), (R2, t), (R2, -t)):
        T_first_second = pose_matrix(R_1_0.T, -R_1_0.T @ t_1[:, 0])
        points = midpoints(np.zeros(3), f0, T_first_second[:3, 3], f1 @ R_1_0)
        is_in_front = np.isfinite(points[:, 0])
        if is_in_front.sum() > best[1].sum():
            best = T_first_second, is_in_front
    return best
