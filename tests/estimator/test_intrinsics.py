"""The calibration in use: corrections of intrinsics, their derivatives, and which matches determine depths."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dronevio.estimator.calibration.corrections import Corrections
from dronevio.estimator.intrinsics import IntrinsicCorrections, image_coordinates, image_jacobians
from dronevio.estimator.types import Calibration, Matches, Observations
from dronevio.models.camera import CameraModel
from dronevio.models.rig_presets import rig_named

CAMERA = np.repeat([0, 1], 50)
XY = np.stack(np.meshgrid(np.linspace(-0.9, 0.9, 10), np.linspace(-0.7, 0.8, 10)), axis=-1).reshape(-1, 2)
ONE = np.zeros(1, np.int64)
PINHOLE = CameraModel(640, 480, 400.0, 400.0, 319.5, 239.5)
FISHEYE = replace(PINHOLE, lens="equidistant")
MODELS = {
    "pinhole": PINHOLE,
    "radtan": rig_named("euroc").cameras[0].model,
    "rational": replace(PINHOLE, distortion=(0.3, 0.1, 1e-4, -2e-4, 0.01, 0.6, 0.2, 0.02)),
    "equidistant": rig_named("fisheye").cameras[0].model,
    "fov": replace(PINHOLE, lens="fov", distortion=(0.9,)),
    "ds": replace(PINHOLE, lens="ds", distortion=(-0.2, 0.6)),
    "eucm": replace(PINHOLE, lens="eucm", distortion=(0.6, 1.1)),
    "omni": replace(PINHOLE, lens="omni", distortion=(1.3, -0.2, 0.05, 1e-4, 2e-4)),
}


@pytest.mark.parametrize("lens", MODELS)
@given(focal=st.floats(-0.1, 0.1), x=st.floats(-0.05, 0.05), radial=st.floats(-0.03, 0.03))
def test_given_coordinates_are_the_inverse_of_corrected_ones(lens: str, focal: float, x: float, radial: float) -> None:
    corrections = IntrinsicCorrections(
        np.array([focal, 0.0]), np.array([[x, 0.5 * x], [0.0, 0.0]]), np.array([radial, 0.0]), 2 * (MODELS[lens],)
    )
    given_xy = corrections.given_xy(XY, CAMERA)
    np.testing.assert_allclose(corrections.corrected_xy(given_xy, CAMERA), XY, atol=1e-7)
    np.testing.assert_allclose(given_xy[50:], XY[50:], atol=1e-9)


def test_corrections_by_hand() -> None:
    """r² = 0.25, so that the radial factor is 1.05; a fisheye sees 45° at π/4, not at 1."""
    pinhole = IntrinsicCorrections(np.array([0.1]), np.array([[0.01, -0.02]]), np.array([0.2]), (PINHOLE,))
    given_xy = pinhole.given_xy(np.array([[0.3, 0.4]]), ONE)
    np.testing.assert_allclose(given_xy, [[0.3 * 1.05 * 1.1 + 0.01, 0.4 * 1.05 * 1.1 - 0.02]])
    fisheye = IntrinsicCorrections(np.array([0.1]), np.zeros((1, 2)), np.zeros(1), (FISHEYE,))
    np.testing.assert_allclose(fisheye.given_xy(np.array([[1.0, 0.0]]), ONE), [[np.tan(1.1 * np.pi / 4.0), 0.0]])


@pytest.mark.parametrize("lens", MODELS)
def test_derivatives_of_image_coordinates(lens: str) -> None:
    """Also at the axis; by central differences."""
    model, xy = MODELS[lens], np.vstack([XY, [[0.0, 0.0], [1e-5, 0.0]]])
    image, by_xy, by_radial = image_jacobians(model, xy, 0.01)
    np.testing.assert_array_equal(image, image_coordinates(model, xy, 0.01))
    np.testing.assert_allclose(image_coordinates(model, xy), model.distort(xy))
    for column, step in enumerate(1e-5 * np.eye(2)):
        by_differences = image_coordinates(model, xy + 10.0 * step, 0.01) - image_coordinates(
            model, xy - 10.0 * step, 0.01
        )
        np.testing.assert_allclose(by_xy[:, :, column], by_differences / 2e-4, atol=1e-5)
    by_differences = image_coordinates(model, xy, 0.0101) - image_coordinates(model, xy, 0.0099)
    np.testing.assert_allclose(by_radial, by_differences / 2e-4, atol=1e-5)


@pytest.mark.parametrize("lens", ["radtan", "rational", "equidistant", "omni"])
def test_a_wrong_calibration_is_corrected(lens: str) -> None:
    """Pixels that are normalized by a lens that differs in all intrinsics."""
    true = MODELS[lens]
    first, *others = true.distortion
    wrong = replace(
        true,
        fx=true.fx / 1.02,
        fy=true.fy / 1.02,
        cx=true.cx - 8.0,
        cy=true.cy + 5.0,
        distortion=(first - 0.01, *others),
    )
    rng = np.random.default_rng(1)
    pixels = rng.uniform(0.1, 0.9, (200, 2)) * [true.width, true.height]
    principal = np.array([[8.0 / wrong.fx, -5.0 / wrong.fy]])
    corrections = IntrinsicCorrections(np.array([0.02]), principal, np.array([0.01]), (wrong,))
    expected, xy = true.normalize(pixels), wrong.normalize(pixels)
    seen = np.abs(np.column_stack([expected, xy])).max(axis=1) < 10.0  # fisheyes see further than the coordinates go
    assert seen.sum() > 100
    camera = np.zeros(seen.sum(), np.int64)
    np.testing.assert_allclose(corrections.corrected_xy(xy[seen], camera), expected[seen], rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(corrections.given_xy(expected[seen], camera), xy[seen], rtol=1e-7, atol=1e-9)


def test_rays_are_by_the_given_intrinsics() -> None:
    """What a camera with corrected intrinsics would see along a ray is what the given one sees along the returned."""
    rig = rig_named("euroc-stereo")
    models = Calibration(rig).models
    intrinsics = IntrinsicCorrections(np.array([0.02, -0.01]), np.full((2, 2), 0.004), np.array([0.02, 0.0]), models)
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


@pytest.mark.parametrize("preset", ["euroc-stereo", "nano", "fisheye-stereo"])
def test_corrections_of_a_rig_are_those_of_its_lenses(preset: str) -> None:
    """The focal lengths of all cameras are corrected by 1 %, the tenth parameter of each."""
    given = Calibration(rig_named(preset))
    x = np.zeros(3 + 10 * len(given.rig.cameras))
    x[9::10] = 0.01
    intrinsics = Corrections.from_vector(x).applied_to(given).intrinsics
    assert intrinsics is not None
    xy = np.array([[0.5, -0.3]])
    for camera, model in enumerate(given.models):
        at_pixel = replace(model, fx=1.01 * model.fx, fy=1.01 * model.fy).project(np.array([[0.5, -0.3, 1.0]]))
        np.testing.assert_allclose(intrinsics.given_xy(xy, np.array([camera])), model.normalize(at_pixel), atol=1e-9)


@pytest.mark.parametrize("lens", MODELS)
def test_coordinates_far_outside_the_image_stay_finite(lens: str) -> None:
    corrections = IntrinsicCorrections(np.array([0.05]), np.zeros((1, 2)), np.array([-0.05]), (MODELS[lens],))
    xy = np.array([[50.0, 0.0], [1e6, -1e6]])
    assert np.isfinite(corrections.corrected_xy(xy, np.zeros(2, np.int64))).all()
    assert np.isfinite(corrections.given_xy(xy, np.zeros(2, np.int64))).all()


def test_matches_that_determine_no_depths_are_left_to_the_calibration() -> None:
    ids = np.arange(4)
    matches = Matches(ids, np.array([1, 2, 1, 2]), np.arange(8.0).reshape(4, 2))
    seen = Observations(ids, np.zeros((4, 2)), np.zeros((4, 2)), np.ones(4, np.int64), matches=matches)
    calibration = Calibration(rig_named("euroc-stereo"))
    assert calibration.usable(seen) is seen
    found = replace(calibration, without_depth=frozenset({1})).usable(seen)
    np.testing.assert_array_equal(found.matches.ids, [1, 3])
    np.testing.assert_array_equal(found.miscalibrated.ids, [0, 2])
    np.testing.assert_array_equal(found.miscalibrated.xy, [[0.0, 1.0], [4.0, 5.0]])
