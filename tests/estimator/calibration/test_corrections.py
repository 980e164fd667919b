"""Corrections of a calibration as a vector and as text."""

from dataclasses import replace

import numpy as np
import pytest

from dronevio.estimator.calibration.corrections import (
    COMMON_PARAMETERS,
    PARAMETERS_PER_CAMERA,
    Corrections,
    inverse_depth_errors,
)
from dronevio.estimator.types import Calibration
from dronevio.models.rig import Rig
from dronevio.models.rig_presets import rig_named
from dronevio.models.rotation import exp_so3, pose_matrix


def test_parameters_of_two_cameras_keep_their_order() -> None:
    found = Corrections.from_vector(np.arange(23.0) - 2.0)
    assert (found.time_offset_s, found.gravity_m_s2, found.gyro_scale) == (-2.0, -1.0, 0.0)
    np.testing.assert_array_equal(found.rotation_rad, [[1, 2, 3], [11, 12, 13]])
    np.testing.assert_array_equal(found.translation_m, [[4, 5, 6], [14, 15, 16]])
    np.testing.assert_array_equal(found.focal, [[7], [17]])
    np.testing.assert_array_equal(found.principal, [[8, 9], [18, 19]])
    np.testing.assert_array_equal(found.radial, [[10], [20]])


@pytest.mark.parametrize(
    ("index", "value", "text"),
    [
        (0, 0.0042, "time offset +4.2 ms"),
        (1, -0.0304, "gravity -0.030 m/s²"),
        (4, np.radians(-0.5), "camera 0 rotation +0.00 -0.50 +0.00°"),
        (16, 0.011, "camera 1 translation +11 +0 +0 mm"),
        (9, -0.0125, "camera 0 focal length -1.25 %"),
        (21, 0.002, "camera 1 principal point +0.0 +2.0 mrad"),
        (12, -0.0123, "camera 0 radial distortion -0.0123"),
    ],
)
def test_text_names_what_is_corrected(index: int, value: float, text: str) -> None:
    x = np.zeros(23)
    x[index] = value
    assert str(Corrections.from_vector(x)) == text


def test_text_of_no_correction_is_none() -> None:
    assert str(Corrections.from_vector(np.zeros(23))) == "none"


@pytest.mark.parametrize("preset", ["euroc-stereo", "fisheye-stereo"])
def test_errors_of_inverse_depths_by_stereo(preset: str) -> None:
    """What a rig with wrong corrections triangulates of a point far away, on the axis of the first camera."""
    given = Calibration(rig_named(preset))
    size = COMMON_PARAMETERS + 2 * PARAMETERS_PER_CAMERA
    A = inverse_depth_errors(given)
    assert A.shape == (4, size) and not A[:2].any()
    first, second = (camera.T_imu_cam for camera in given.rig.cameras)
    baseline = second[:3, 3] - first[:3, 3]
    axis = first[:3, 2]
    for index in range(COMMON_PARAMETERS, size):
        if index in (6, 7, 8, 16, 17, 18):  # positions of the cameras, which move nothing at infinity
            assert not A[2:, index].any()
            continue
        x = np.zeros(size)
        x[index] = 1e-5
        wrong = Corrections.from_vector(x).applied_to(given)
        # Both cameras look along the axis, as far as they are given
        seen = []
        for camera, T in enumerate((first, second)):
            ray = T[:3, :3].T @ axis
            xy = wrong.corrected_xy((ray[:2] / ray[2])[None], np.array([camera]))
            corrected = wrong.Ts_imu_cam[camera, :3, :3] @ np.append(xy, 1.0)
            seen.append(corrected / np.linalg.norm(corrected))
        across = baseline - (baseline @ axis) * axis
        expected = (seen[0] - seen[1]) @ across / (across @ across)
        if index not in (9, 12, 19, 22):  # focal lengths and distortions move nothing at the axis
            np.testing.assert_allclose(A[2] @ x, expected, rtol=0.05, atol=2e-6)
    np.testing.assert_allclose(A[3, [9, 19]], np.array([-0.4, 0.4]) / np.linalg.norm(across))
    np.testing.assert_allclose(A[3, [12, 22]], np.array([-0.12, 0.12]) / np.linalg.norm(across))


@pytest.mark.parametrize("turn", [[0.0, np.pi, 0.0], [0.0, 1.4, 0.0]])
def test_cameras_that_share_no_view_determine_no_depths(turn: list[float]) -> None:
    camera = rig_named("euroc").cameras[0]
    T = camera.T_imu_cam @ pose_matrix(exp_so3(np.array(turn)), np.array([0.1, 0.0, 0.0]))
    assert not inverse_depth_errors(Calibration(Rig((camera, replace(camera, T_imu_cam=T))))).any()
