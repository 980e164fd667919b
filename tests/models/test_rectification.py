"""CameraInfo of stereo pairs: the rectified images agree in their rows, and their disparity gives the depth."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from dronevio.models.recordings.bag.rectification import rectifications
from dronevio.models.recordings.bag.writer import write_bag
from dronevio.models.rig import Rig
from dronevio.models.rig_presets import rig_named
from dronevio.models.rotation import exp_so3, inverse_pose, pose_matrix

P_IMU_CAM0 = np.array([[0.3, -0.2, 2.0], [-0.5, 0.4, 1.5], [0.1, 0.05, 6.0]])
"""Points in the frame of the first camera [m]."""


def rectified_pixels(rig: Rig, number: int) -> np.ndarray:
    """Return the pixels (N, 2) of the points by R and P of CameraInfo, as image_geometry computes them."""
    T_cam_cam0 = inverse_pose(rig.cameras[number].T_imu_cam) @ rig.cameras[0].T_imu_cam
    points = P_IMU_CAM0 @ T_cam_cam0[:3, :3].T + T_cam_cam0[:3, 3]
    rectified = points @ rectifications(rig)[number].R.T
    K = rectifications(rig)[number].P[:, :3]
    return (rectified @ K.T)[:, :2] / rectified[:, 2:]


@pytest.mark.parametrize("name", ["euroc-stereo"])
def test_rows_agree_and_disparity_is_depth(name: str) -> None:
    rig = rig_named(name)
    left, right = rectified_pixels(rig, 0), rectified_pixels(rig, 1)
    np.testing.assert_allclose(left[:, 1], right[:, 1], atol=1e-9)
    first, second = rectifications(rig)
    f, Tx = second.P[0, 0], second.P[0, 3]
    baseline_m = np.linalg.norm(rig.cameras[1].T_imu_cam[:3, 3] - rig.cameras[0].T_imu_cam[:3, 3])
    np.testing.assert_allclose(-Tx / f, baseline_m)
    assert first.P[0, 3] == 0.0 and np.array_equal(first.P[:, :3], second.P[:, :3])
    depth = (P_IMU_CAM0 @ first.R.T)[:, 2]
    np.testing.assert_allclose(f * baseline_m / (left[:, 0] - right[:, 0]), depth, rtol=1e-9)


def test_rectification_agrees_with_opencv() -> None:
    """OpenCV turns both cameras by half of their rotation first: its axes differ by less than two milliradians."""
    rig = rig_named("euroc-stereo")
    a, b = (camera.model for camera in rig.cameras)
    T = inverse_pose(rig.cameras[1].T_imu_cam) @ rig.cameras[0].T_imu_cam
    k0, k1 = np.array(a.distortion), np.array(b.distortion)
    R0, R1, _, P1, *_ = cv2.stereoRectify(a.K, k0, b.K, k1, (752, 480), T[:3, :3], T[:3, 3:])
    ours = rectifications(rig)
    for R, mine in zip((R0, R1), ours, strict=True):
        assert np.abs(cv2.Rodrigues(R @ mine.R.T)[0]).max() < 2e-3
    np.testing.assert_allclose(P1[0, 3] / P1[0, 0], ours[1].P[0, 3] / ours[1].P[0, 0], rtol=1e-6)


def test_other_cameras_keep_their_axes() -> None:
    rig = rig_named("euroc-stereo")
    backward = pose_matrix(exp_so3(np.array([0.0, 2.0, 0.0])), np.zeros(3))
    turned = replace(rig.cameras[1], T_imu_cam=rig.cameras[1].T_imu_cam @ backward)
    same_place = replace(rig.cameras[1], T_imu_cam=rig.cameras[0].T_imu_cam)
    for cameras in ((rig.cameras[0],), (rig.cameras[0], turned), (rig.cameras[0], same_place)):
        for camera, found in zip(cameras, rectifications(Rig(cameras)), strict=True):
            np.testing.assert_array_equal(found.R, np.eye(3))
            np.testing.assert_array_equal(found.P, np.hstack([camera.model.K, np.zeros((3, 1))]))


def test_bags_have_the_rectification(tmp_path: Path, noise_recording: Callable[..., Any]) -> None:
    recording = noise_recording()
    write_bag(tmp_path / "bag", recording)
    with AnyReader([tmp_path / "bag"]) as reader:
        infos = {
            connection.topic: cast(Any, reader.deserialize(raw, connection.msgtype))
            for connection, _, raw in reader.messages()
            if connection.msgtype.endswith("CameraInfo")
        }
    for number, expected in enumerate(rectifications(recording.rig)):
        info = infos[f"/cam{number}/camera_info"]
        np.testing.assert_array_equal(info.r.reshape(3, 3), expected.R)
        np.testing.assert_array_equal(info.p.reshape(3, 4), expected.P)
    assert infos["/cam1/camera_info"].p[3] < -40.0  # px m: 11 cm at 457 px
