"""Recordings of videos whose IMU has an unknown rotation, which their images tell."""

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from dronevio.models.errors import InputError

if TYPE_CHECKING:
    from dronevio.models.recordings.gopro import VideoRecording

FRAMES = 600
"""Number of frames whose rotation is used: 20 s of a usual video."""


def with_estimated_rotation(recording: "VideoRecording") -> "VideoRecording":
    """Return a recording with the rotation of the IMU by the images, whatever the one of its rig is.

    Raises:
        InputError: The images do not tell it, since they rotate too little, or about one axis only.
    """
    from dronevio.estimator.calibration.image_rotation import tracked_rotations
    from dronevio.estimator.calibration.imu_rotation import imu_rotation

    (camera,) = recording.rig.cameras
    level = replace(recording.rig, cameras=(replace(camera, T_imu_cam=np.eye(4)),))
    count = min(len(recording.frame_times_ns), FRAMES)
    rotation = imu_rotation(tracked_rotations(map(recording.frame, range(count)), level), recording.imu)
    if rotation is None or not rotation.is_significant:
        known = "too few frames"
        if rotation is not None:
            known = (
                f"known to {math.degrees(rotation.sigma_rad):.1f}°, {max(rotation.explained, 0.0):.0%} of it explained"
            )
        raise InputError(
            recording.name,
            f"images that do not tell the rotation of the IMU ({known})",
            "rotation about two axes, its axes by name (--imu-rotation yxz), or T_cam_imu in the calibration",
        )
    T_imu_cam = np.eye(4)
    T_imu_cam[:3, :3] = rotation.R_imu_cam
    return replace(recording, rig=replace(recording.rig, cameras=(replace(camera, T_imu_cam=T_imu_cam),)))
