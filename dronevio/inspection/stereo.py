"""Whether the relative pose of two cameras agrees with the images that they take at the same time."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from dronevio.inspection.flow import Flow
from dronevio.models.arrays import Array
from dronevio.models.rig import RigCamera
from dronevio.models.rotation import cross, inverse_pose, log_so3

MIN_MATCHES = 60
"""Smallest number of matches of all images together."""
MIN_AGREEMENT = 0.6
"""Smallest share of matches that agree with any one relative pose; fewer are no matches of the same points."""
NEAR_PX = 1.5
"""Distance from the epipolar line within which a match agrees [px]."""
PARALLAX_PX = 3.0
"""Smallest parallax of a match whose depth has a certain sign [px]."""


@dataclass(frozen=True)
class StereoCheck:
    """Agreement of two cameras."""

    error_px: float
    """Median distance of matches from their epipolar lines by the calibration [px]."""
    best_px: float
    """The same with the rotation and the direction of the baseline that agree best [px]."""
    rotation_deg: float
    """Angle between the calibrated and that rotation [°]."""
    behind: float
    """Share of the matches with parallax that lie behind a camera by the calibration; NaN without parallax."""
    matches: int
    """Number of matches."""


def check_stereo(flows: Sequence[Flow], first: RigCamera, second: RigCamera) -> StereoCheck | None:
    """Return the agreement of two cameras; None if they have no view in common, as far as the images tell.

    Args:
        flows: Matches between images of both cameras at the same times.
        first: The first camera.
        second: The second camera.
    """
    if sum(len(flow.pixels[0]) for flow in flows) < MIN_MATCHES:
        return None
    f0, f1 = (np.concatenate([flow.bearings[k] for flow in flows]) for k in (0, 1))
    pixel_rad = 1.0 / second.model.fx
    R_free = _free_rotation(f0[:, :2] / f0[:, 2:], f1[:, :2] / f1[:, 2:], NEAR_PX * pixel_rad)
    if R_free is None:
        return None
    free = _free_errors(f0 @ R_free.T, f1)
    if np.mean(free < NEAR_PX * pixel_rad) < MIN_AGREEMENT:
        return None
    T = inverse_pose(second.T_imu_cam) @ first.T_imu_cam
    R, t = T[:3, :3], T[:3, 3]
    turned, direction = f0 @ R.T, t / max(float(np.linalg.norm(t)), 1e-12)
    errors = np.abs(cross(turned, f1) @ direction) / np.maximum(
        np.linalg.norm(cross(turned, direction[None]), axis=1), 1e-3
    )
    normals = cross(turned, f1)
    has_parallax = np.linalg.norm(normals, axis=1) > PARALLAX_PX * pixel_rad
    depth_first = -np.einsum("ni,ni->n", cross(direction[None], f1), normals)
    depth_second = -np.einsum("ni,ni->n", cross(direction[None], turned), normals)
    behind = ((depth_first < 0.0) | (depth_second < 0.0))[has_parallax]
    return StereoCheck(
        float(np.median(errors)) / pixel_rad,
        float(np.median(free)) / pixel_rad,
        float(np.degrees(np.linalg.norm(log_so3(R_free @ R.T)))),
        float(np.mean(behind)) if len(behind) >= MIN_MATCHES // 2 else float("nan"),
        len(f0),
    )


def _free_rotation(xy0: Array, xy1: Array, threshold: float) -> Array | None:
    """Return the rotation (3, 3) of the first camera in the second that agrees best, by five matches at a time."""
    E, inliers = cv2.findEssentialMat(xy0, xy1, np.eye(3), cv2.RANSAC, prob=0.999, threshold=threshold)
    if E is None or E.shape != (3, 3):
        return None
    return np.asarray(cv2.recoverPose(E, xy0, xy1, np.eye(3), mask=inliers)[1], np.float64)


def _free_errors(turned: Array, f1: Array) -> Array:
    """Return the angles (N,) of bearings from the epipolar planes of the baseline that agrees best [rad]."""
    normals, weights = cross(turned, f1), np.ones(len(f1))
    errors = np.zeros(len(f1))
    for _ in range(5):
        t = np.linalg.eigh((normals * weights[:, None]).T @ normals)[1][:, 0]
        errors = np.abs(normals @ t) / np.maximum(np.linalg.norm(cross(turned, t[None]), axis=1), 1e-3)
        weights = 1.0 / (1.0 + (errors / max(float(np.median(errors)), 1e-5)) ** 2)
    return np.asarray(errors)
