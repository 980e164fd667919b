"""The rotation of the IMU of a video by its images: a textured wall that turns before the camera."""

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from dronevio.models.camera import CameraModel
from dronevio.models.errors import InputError
from dronevio.models.imu import ImuSamples
from dronevio.models.recordings.gopro import VideoRecording, imu_rotation_named
from dronevio.models.rig import Rig, RigCamera
from dronevio.models.rotation import exp_so3, log_so3
from dronevio.recording.imu_rotation import with_estimated_rotation

K = np.array([[200.0, 0.0, 159.5], [0.0, 200.0, 119.5], [0.0, 0.0, 1.0]])


def recording(R_imu_cam: Any, amplitudes: Any, frames: int = 60) -> VideoRecording:
    """Return a recording whose camera turns to and fro before a distant texture, 20 Hz, with a gyroscope of 200 Hz."""
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.integers(0, 256, (480, 640), dtype=np.uint8), (0, 0), 2.0)
    texture = cv2.normalize(texture, np.zeros_like(texture), 0, 255, cv2.NORM_MINMAX)
    shift = np.array([[1.0, 0.0, -160.0], [0.0, 1.0, -120.0], [0.0, 0.0, 1.0]])

    def angles(t_s: Any) -> Any:
        waves = zip(amplitudes, (5.0, 3.3, 7.1), (0.0, 1.0, 2.0), strict=True)
        return np.stack([a * np.sin(f * np.asarray(t_s) + p) for a, f, p in waves], axis=-1)

    def image(index: int) -> Any:
        R = exp_so3(angles(0.5 + 0.05 * index))
        return cv2.warpPerspective(
            texture, K @ R.T @ np.linalg.inv(K) @ shift, (320, 240), borderMode=cv2.BORDER_REFLECT
        )

    t_s = np.arange(0, 800) * 0.005
    R = exp_so3(angles(t_s))
    rates = log_so3(np.swapaxes(R[:-1], 1, 2) @ R[1:]) / 0.005
    imu = ImuSamples((t_s[1:] * 1e9).astype(np.int64), rates @ R_imu_cam.T, np.zeros((799, 3)), "increment")
    camera = RigCamera(CameraModel(320, 240, 200.0, 200.0, 159.5, 119.5), np.eye(4))
    times = ((0.5 + 0.05 * np.arange(frames)) * 1e9).astype(np.int64)
    images: Any = image
    return VideoRecording("wall", Rig((camera,)), imu, times, images)


def test_the_rotation_is_that_by_which_the_video_was_made() -> None:
    R = imu_rotation_named("yxz")
    found = with_estimated_rotation(recording(R, (0.05, 0.06, 0.04))).rig.cameras[0].T_imu_cam
    assert np.degrees(np.linalg.norm(log_so3(R.T @ found[:3, :3]))) < 2.0
    np.testing.assert_array_equal(found[:3, 3], np.zeros(3))


@pytest.mark.parametrize(("amplitudes", "frames"), [((0.0, 0.06, 0.0), 60), ((0.05, 0.06, 0.04), 8)])
def test_too_little_rotation_is_named(amplitudes: Any, frames: int) -> None:
    still = replace(recording(np.eye(3), amplitudes, frames))
    with pytest.raises(InputError, match="images that do not tell the rotation of the IMU"):
        with_estimated_rotation(still)
