"""The camera model, held against OpenCV's and against itself there and back."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.models.camera import CameraModel
from dronevio.models.rig import EUROC_CAM0, EUROC_T_IMU_CAM0, euroc_rig

PINHOLE = replace(EUROC_CAM0, distortion=(0.0, 0.0, 0.0, 0.0))
BARREL = CameraModel(640, 480, 320.0, 310.0, 322.0, 241.0, (-0.15, 0.02, 1e-3, -2e-3))
CAMERAS = [PINHOLE, EUROC_CAM0, BARREL]


def every_pixel(model: CameraModel, step: float = 16.0) -> np.ndarray:
    """Return pixels (N, 2) over the whole image, its borders included."""
    u = np.linspace(-0.5, model.width - 0.5, int(model.width / step))
    v = np.linspace(-0.5, model.height - 0.5, int(model.height / step))
    return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("model", CAMERAS)
def test_projection_is_opencvs(model: CameraModel) -> None:
    p = np.random.default_rng(0).uniform([-2.0, -1.5, 2.0], [2.0, 1.5, 9.0], (200, 3))
    theirs, _ = cv2.projectPoints(p, np.zeros(3), np.zeros(3), model.K, np.array(model.distortion))
    np.testing.assert_allclose(model.project(p), theirs[:, 0], atol=1e-9)


@pytest.mark.parametrize("model", CAMERAS)
def test_every_pixel_comes_back(model: CameraModel) -> None:
    pixels = every_pixel(model)
    xy = model.normalise(pixels)
    back = model.project(np.column_stack([xy, np.ones(len(xy))]) * 3.7)
    np.testing.assert_allclose(back, pixels, atol=1e-9)
    np.testing.assert_allclose(model.undistort(model.distort(xy)), xy, atol=1e-11)


@pytest.mark.parametrize("model", CAMERAS)
def test_bearings_have_unit_length_and_point_at_their_pixel(model: CameraModel) -> None:
    pixels = every_pixel(model, 40.0).reshape(-1, 2)
    bearings = model.unproject(pixels)
    np.testing.assert_allclose(np.linalg.norm(bearings, axis=1), 1.0, atol=1e-14)
    np.testing.assert_allclose(model.project(bearings), pixels, atol=1e-9)


@given(st.floats(-0.7, 0.7), st.floats(-0.45, 0.45))
@settings(max_examples=50, deadline=None)
def test_jacobian_of_the_lens_is_its_derivative(x: float, y: float) -> None:
    xy, h = np.array([x, y]), 1e-6
    numeric = np.stack(
        [(EUROC_CAM0.distort(xy + h * e) - EUROC_CAM0.distort(xy - h * e)) / (2 * h) for e in np.eye(2)], axis=1
    )
    np.testing.assert_allclose(EUROC_CAM0._distortion_jacobian(xy), numeric, atol=1e-8)


def test_what_is_not_in_front_has_no_pixel() -> None:
    pixels = EUROC_CAM0.project(np.array([[0.1, 0.1, -1.0], [0.1, 0.1, 0.0], [0.0, 0.0, 1.0]]))
    assert np.isnan(pixels[:2]).all()
    np.testing.assert_array_equal(pixels[2], [EUROC_CAM0.cx, EUROC_CAM0.cy])


def test_no_points_and_many_axes_are_fine() -> None:
    assert EUROC_CAM0.normalise(np.zeros((0, 2))).shape == (0, 2)
    assert EUROC_CAM0.project(np.zeros((0, 3))).shape == (0, 2)
    pixels = every_pixel(EUROC_CAM0)[:24].reshape(2, 3, 4, 2)
    np.testing.assert_array_equal(EUROC_CAM0.unproject(pixels).shape, (2, 3, 4, 3))
    np.testing.assert_allclose(EUROC_CAM0.normalise(pixels)[1, 2, 3], EUROC_CAM0.normalise(pixels[1, 2, 3]), atol=1e-12)


def test_eurocs_rig_looks_ahead_of_the_vehicle() -> None:
    rig = euroc_rig()
    T_vehicle_cam = rig.T_vehicle_imu @ rig.cameras[0].T_imu_cam
    for R in (EUROC_T_IMU_CAM0[:3, :3], rig.T_vehicle_imu[:3, :3]):
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(R) == pytest.approx(1.0)
    right, down, ahead = T_vehicle_cam[:3, :3].T
    assert ahead[0] > 0.99 and right[1] < -0.99 and down[2] < -0.99
