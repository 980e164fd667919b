"""Corrections of the intrinsics: the way there and back, derivatives, and agreement with the lens models."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dronevio.estimator.calibration.corrections import Corrections
from dronevio.estimator.intrinsics import IntrinsicCorrections, lens_jacobian, lens_xy, normalized_xy
from dronevio.estimator.types import Calibration
from dronevio.models.rig_presets import rig_named

CAMERA = np.repeat([0, 1], 50)
XY = np.stack(np.meshgrid(np.linspace(-0.9, 0.9, 10), np.linspace(-0.7, 0.8, 10)), axis=-1).reshape(-1, 2)
ONE, ZERO = np.zeros(1, np.int64), np.zeros(1, np.bool_)


@given(focal=st.floats(-0.1, 0.1), x=st.floats(-0.05, 0.05), radial=st.floats(-0.1, 0.1), is_fisheye=st.booleans())
def test_given_coordinates_are_the_inverse_of_corrected_ones(
    focal: float, x: float, radial: float, is_fisheye: bool
) -> None:
    corrections = IntrinsicCorrections(
        np.array([focal, 0.0]),
        np.array([[x, 0.5 * x], [0.0, 0.0]]),
        np.array([radial, 0.0]),
        np.array([is_fisheye, is_fisheye]),
    )
    given_xy = corrections.given_xy(XY, CAMERA)
    np.testing.assert_allclose(corrections.corrected_xy(given_xy, CAMERA), XY, atol=1e-5)
    np.testing.assert_allclose(given_xy[50:], XY[50:], rtol=1e-12)


def test_corrections_by_hand() -> None:
    """r² = 0.25, so that the radial factor is 1.05; a fisheye sees 45° at π/4, not at 1."""
    pinhole = IntrinsicCorrections(np.array([0.1]), np.array([[0.01, -0.02]]), np.array([0.2]), ZERO)
    given_xy = pinhole.given_xy(np.array([[0.3, 0.4]]), ONE)
    np.testing.assert_allclose(given_xy, [[0.3 * 1.05 * 1.1 + 0.01, 0.4 * 1.05 * 1.1 - 0.02]])
    fisheye = IntrinsicCorrections(np.array([0.1]), np.zeros((1, 2)), np.zeros(1), ~ZERO)
    np.testing.assert_allclose(fisheye.given_xy(np.array([[1.0, 0.0]]), ONE), [[np.tan(1.1 * np.pi / 4.0), 0.0]])


def test_coordinates_of_fisheyes() -> None:
    """Also at the axis; the Jacobian by central differences."""
    xy, fisheye = np.vstack([XY, [[0.0, 0.0], [1e-5, 0.0], [4.0, -3.0]]]), np.ones(103, np.bool_)
    np.testing.assert_allclose(normalized_xy(lens_xy(xy, fisheye), fisheye), xy, rtol=1e-12)
    np.testing.assert_array_equal(lens_xy(xy, ~fisheye), xy)
    J = lens_jacobian(xy, fisheye)
    for column, step in enumerate(1e-6 * np.eye(2)):
        by_differences = (lens_xy(xy + step, fisheye) - lens_xy(xy - step, fisheye)) / 2e-6
        np.testing.assert_allclose(J[:, :, column], by_differences, atol=1e-8)


@pytest.mark.parametrize(("preset", "share"), [("euroc", 1.0 / 3.0), ("nano", 0.25), ("fisheye", 0.1)])
def test_a_wrong_calibration_is_corrected(preset: str, share: float) -> None:
    """Pixels that are normalized by a lens that differs in all intrinsics are corrected to a share of the error."""
    true = rig_named(preset).cameras[0].model
    k1, *others = true.distortion
    wrong = replace(
        true, fx=true.fx / 1.02, fy=true.fy / 1.02, cx=true.cx - 2.0, cy=true.cy + 1.0, distortion=(k1 - 0.01, *others)
    )
    rng = np.random.default_rng(1)
    pixels = rng.uniform(0.2, 0.8, (200, 2)) * [true.width, true.height]
    corrections = IntrinsicCorrections(
        np.array([0.02]),
        np.array([[2.0 / wrong.fx, -1.0 / wrong.fy]]),
        np.array([0.01]),
        np.array([true.lens != "radtan"]),
    )
    found = corrections.corrected_xy(wrong.normalize(pixels), np.zeros(200, np.int64))
    before, after = (np.linalg.norm(xy - true.normalize(pixels), axis=1) for xy in (wrong.normalize(pixels), found))
    assert np.sqrt((after**2).mean()) < share * np.sqrt((before**2).mean())


def test_rays_are_by_the_given_intrinsics() -> None:
    """What a camera with corrected intrinsics would see along a ray is what the given one sees along the returned."""
    rig = rig_named("euroc-stereo")
    intrinsics = IntrinsicCorrections(np.array([0.02, -0.01]), np.full((2, 2), 0.004), np.array([0.02, 0.0]), ZERO)
    intrinsics = replace(intrinsics, is_fisheye=np.zeros(2, np.bool_))
    p_imu = np.array([[0.5, 0.2, 3.0], [-0.4, 0.8, 2.0], [0.1, -0.3, 5.0]]) @ rig.cameras[0].T_imu_cam[:3, :3].T
    given, corrected = (Calibration(rig, intrinsics=each) for each in (None, intrinsics))
    true, found = given.rays(p_imu), corrected.rays(p_imu)
    for camera in range(2):
        T = rig.cameras[camera].T_imu_cam
        np.testing.assert_allclose(true[camera], (p_imu - T[:3, 3]) @ T[:3, :3])
        xy = true[camera, :, :2] / true[camera, :, 2:]
        seen = corrected.corrected_xy(found[camera, :, :2] / found[camera, :, 2:], np.full(3, camera))
        np.testing.assert_allclose(seen, xy, atol=1e-5)
        assert np.abs(found[camera, :, :2] / found[camera, :, 2:] - xy).max() > 0.003


@pytest.mark.parametrize(("preset", "is_fisheye"), [("euroc-stereo", False), ("nano", False), ("fisheye-stereo", True)])
def test_corrections_of_a_rig_are_those_of_its_lenses(preset: str, is_fisheye: bool) -> None:
    """The focal lengths of all cameras are corrected by 1 %, the tenth parameter of each."""
    given = Calibration(rig_named(preset))
    x = np.zeros(3 + 10 * len(given.rig.cameras))
    x[9::10] = 0.01
    intrinsics = Corrections.from_vector(x).applied_to(given).intrinsics
    assert intrinsics is not None and (intrinsics.is_fisheye == is_fisheye).all()
    expected = np.tan(np.pi / 4.0 * 1.01) if is_fisheye else 1.01
    np.testing.assert_allclose(intrinsics.given_xy(np.array([[1.0, 0.0]]), ONE), [[expected, 0.0]])


@pytest.mark.parametrize("is_fisheye", [False, True])
def test_coordinates_far_outside_the_image_stay_finite(is_fisheye: bool) -> None:
    corrections = IntrinsicCorrections(np.zeros(1), np.zeros((1, 2)), np.array([-0.05]), np.array([is_fisheye]))
    xy = corrections.corrected_xy(np.array([[50.0, 0.0], [1e6, -1e6]]), np.zeros(2, np.int64))
    assert np.isfinite(xy).all()
