"""Rectification of stereo pairs, for the fields R and P of CameraInfo messages.

The rectified images of a pair have parallel axes, x along the baseline, and the same intrinsics, so that a point has
the same row in both, and its depth is f B / disparity (Fusiello, Trucco and Verri, Machine Vision and Applications
2000).
"""

import math
from dataclasses import dataclass

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.rig import Rig, RigCamera

_MAX_ANGLE = math.radians(
    30.0
)  # between the optical axes of a pair, and between its baseline and the rows of its images


@dataclass(frozen=True, eq=False)
class Rectification:
    """Rectification of one camera, as in sensor_msgs/CameraInfo."""

    R: Array
    """(3, 3) Rotation from the frame of the camera to that of the rectified camera."""
    P: Array
    """(3, 4) Projection of a point in the rectified frame of the first camera of the pair to pixels of this camera."""


def rectifications(rig: Rig) -> tuple[Rectification, ...]:
    """Return the rectification of each camera.

    Two successive cameras, counted from the first, are a pair if their images have the same size, their optical axes
    are within 30°, and the second camera is beside the first one. Other cameras keep their axes and intrinsics, with
    their lens distortion removed.
    """
    by_camera: list[Rectification] = []
    while len(by_camera) < len(rig.cameras):
        pair = rig.cameras[len(by_camera) : len(by_camera) + 2]
        both = _of_pair(*pair) if len(pair) == 2 else None
        by_camera.extend(both or (Rectification(np.eye(3), np.hstack([pair[0].model.K, np.zeros((3, 1))])),))
    return tuple(by_camera)


def _of_pair(first: RigCamera, second: RigCamera) -> tuple[Rectification, Rectification] | None:
    """Return the rectification of two cameras, None if they are not a stereo pair."""
    models = (first.model, second.model)
    rotations = (first.T_imu_cam[:3, :3], second.T_imu_cam[:3, :3])
    baseline = second.T_imu_cam[:3, 3] - first.T_imu_cam[:3, 3]
    mean = rotations[0] + rotations[1]
    x = baseline * np.sign(baseline @ mean[:, 0])
    same_size = (models[0].width, models[0].height) == (models[1].width, models[1].height)
    parallel = _angle(rotations[0][:, 2], rotations[1][:, 2]) < _MAX_ANGLE
    if not same_size or not parallel or not _angle(x, mean[:, 0]) < _MAX_ANGLE:
        return None
    x = x / np.linalg.norm(x)
    z = mean[:, 2] - (mean[:, 2] @ x) * x
    z /= np.linalg.norm(z)
    R_rect_imu = np.stack([x, np.cross(z, x), z])
    focal_px = float(np.mean([model.central_focal_px for model in models]))
    Rs = [R_rect_imu @ R for R in rotations]
    # the optical axes remain in the middle of the rectified images, in the mean of both
    centre = np.mean([(m.cx, m.cy) - focal_px * R[:2, 2] / R[2, 2] for m, R in zip(models, Rs, strict=True)], axis=0)
    K = np.array([[focal_px, 0.0, centre[0]], [0.0, focal_px, centre[1]], [0.0, 0.0, 1.0]])
    shifts = (0.0, -focal_px * float(baseline @ x))
    Ps = [np.hstack([K, [[shift], [0.0], [0.0]]]) for shift in shifts]
    return Rectification(Rs[0], Ps[0]), Rectification(Rs[1], Ps[1])


def _angle(a: Array, b: Array) -> float:
    """Return the angle between two vectors [rad], NaN if one is zero."""
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)) if a.any() and b.any() else math.nan
