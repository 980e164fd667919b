"""Camera models against OpenCV, and projection against its inverse."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError
from dronevio.models.lenses import equidistant, radtan
from dronevio.models.lenses.lens import LENSES
from dronevio.models.rig import EUROC_CAM0, EUROC_T_IMU_CAM0, euroc_rig

PINHOLE = replace(EUROC_CAM0, distortion=(0.0, 0.0, 0.0, 0.0))
BARREL = CameraModel(640, 480, 320.0, 310.0, 322.0, 241.0, (-0.15, 0.02, 1e-3, -2e-3))
WIDE = CameraModel(640, 480, 226.0, 225.5, 318.0, 242.5, (-0.01, 4e-3, -2e-3, 2e-4), "equidistant")
FISHEYE = CameraModel(512, 512, 190.978, 190.973, 254.93, 256.897, (3.48e-3, 7.15e-4, -2.05e-3, 2.03e-4), "equidistant")
RADTAN5 = replace(BARREL, distortion=(-0.25, 0.06, 1e-3, -2e-3, -0.004))
RATIONAL = replace(BARREL, distortion=(0.4, 0.05, 5e-4, -5e-4, 0.001, 0.5, 0.1, 0.002))
CAMERAS = [PINHOLE, EUROC_CAM0, BARREL, RADTAN5, RATIONAL]
FOV = CameraModel(640, 480, 300.0, 298.0, 318.0, 242.5, (0.93,), "fov")
DS = CameraModel(512, 512, 158.286, 158.274, 254.96, 256.89, (-0.172, 0.593), "ds")  # of TUM-VI
NARROW_DS = CameraModel(640, 480, 400.0, 401.0, 318.0, 242.5, (0.3, 0.4), "ds")
EUCM = CameraModel(752, 480, 460.76, 459.41, 365.89, 249.33, (0.59, 1.127), "eucm")  # of EuRoC
OMNI = CameraModel(640, 480, 700.0, 698.0, 318.0, 242.5, (1.6, -0.2, 0.1, 1e-3, -1e-3), "omni")
NEAR_OMNI = CameraModel(640, 480, 300.0, 298.0, 318.0, 242.5, (0.8, -0.05, 0.01, 1e-3, -1e-3), "omni")
NEW_FISHEYES = [FOV, DS, NARROW_DS, EUCM, OMNI, NEAR_OMNI]
ALL_CAMERAS = [*CAMERAS, WIDE, FISHEYE, *NEW_FISHEYES]


def sum_of(parts: tuple[tuple[float, ...], ...]) -> tuple[float, ...]:
    """Return the parts as one tuple."""
    return tuple(value for part in parts for value in part)


def pixel_grid(model: CameraModel, step: float = 16.0) -> Array:
    """Return pixels (N, 2) over the whole image, including its borders."""
    u = np.linspace(-0.5, model.width - 0.5, int(model.width / step))
    v = np.linspace(-0.5, model.height - 0.5, int(model.height / step))
    return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("model", CAMERAS)
def test_projection_agrees_with_opencv(model: CameraModel) -> None:
    p = np.random.default_rng(0).uniform([-2.0, -1.5, 2.0], [2.0, 1.5, 9.0], (200, 3))
    theirs, _ = cv2.projectPoints(p, np.zeros(3), np.zeros(3), model.K, np.array(model.distortion))
    np.testing.assert_allclose(model.project(p), theirs[:, 0], atol=1e-9)


@pytest.mark.parametrize("model", [WIDE, FISHEYE])
def test_fisheye_projection_agrees_with_opencv(model: CameraModel) -> None:
    p = np.random.default_rng(1).uniform([-9.0, -9.0, 0.3], [9.0, 9.0, 3.0], (300, 1, 3))  # up to 89° from the axis
    theirs, _ = cv2.fisheye.projectPoints(p, np.zeros(3), np.zeros(3), model.K, np.array(model.distortion))
    np.testing.assert_allclose(model.project(p), theirs, atol=1e-9)
    pixels = np.asarray(theirs, np.float64)
    forward = pixels[np.isfinite(model.normalize(pixels)).all(axis=-1)][:, None]
    xy = np.asarray(cv2.fisheye.undistortPoints(forward, model.K, np.array(model.distortion)))
    near = np.linalg.norm(xy, axis=-1) < 5.0  # OpenCV stops at 1e-8 rad
    np.testing.assert_allclose(model.normalize(forward)[near], xy[near], atol=1e-6)


def test_fisheye_field_of_view_exceeds_180_degrees() -> None:
    angles = np.deg2rad([0.0, 30.0, 89.0, 89.9, 90.1, 100.0])
    p = np.stack([np.sin(angles), np.zeros(6), np.cos(angles)], axis=-1) * 3.0
    k = FISHEYE.distortion
    theta_d = angles * (1.0 + sum(k[i] * angles ** (2 * i + 2) for i in range(4)))
    pixels = FISHEYE.project(p)
    np.testing.assert_allclose(pixels[:, 0], FISHEYE.cx + FISHEYE.fx * theta_d, atol=1e-9)
    np.testing.assert_allclose(FISHEYE.unproject(pixels) * 3.0, p, atol=1e-9)
    np.testing.assert_array_equal(np.isnan(FISHEYE.normalize(pixels)).any(axis=-1), angles >= 0.5 * np.pi)


@pytest.mark.parametrize("model", CAMERAS)
def test_normalization_inverts_projection(model: CameraModel) -> None:
    pixels = pixel_grid(model)
    xy = model.normalize(pixels)
    back = model.project(np.column_stack([xy, np.ones(len(xy))]) * 3.7)
    np.testing.assert_allclose(back, pixels, atol=1e-9)
    np.testing.assert_allclose(model.undistort(model.distort(xy)), xy, atol=1e-11)


@pytest.mark.parametrize("model", ALL_CAMERAS)
def test_bearings_are_unit_vectors_of_their_pixels(model: CameraModel) -> None:
    pixels = pixel_grid(model)
    bearings = model.unproject(pixels)
    np.testing.assert_allclose(np.linalg.norm(bearings, axis=1), 1.0, atol=1e-14)
    np.testing.assert_allclose(model.project(bearings * 2.5), pixels, atol=1e-9)
    np.testing.assert_allclose(model.unproject(model.project(bearings)), bearings, atol=1e-9)


FOLDING = [
    CameraModel(640, 480, 320.0, 320.0, 319.5, 239.5, (-0.35, 0.02, 2e-3, -1e-3)),
    CameraModel(640, 480, 320.0, 320.0, 319.5, 239.5, (-0.3, 0.0, 0.0, 0.0)),
    CameraModel(640, 480, 200.0, 200.0, 319.5, 239.5, (0.02, -0.03, 0.004, -0.002), "equidistant"),
    RADTAN5,
    replace(RATIONAL, distortion=(*RATIONAL.distortion[:5], 0.6, 0.3, 0.1)),
    DS,
    replace(OMNI, distortion=(1.6, 0.0, 0.0, 0.0, 0.0)),
    replace(EUCM, distortion=(0.8, 0.9)),
]


@pytest.mark.parametrize("model", FOLDING)
def test_the_lens_ends_before_its_image_folds(model: CameraModel) -> None:
    """With the angle from the axis the radius in the image increases up to the limit, and is NaN beyond."""
    angles = np.linspace(0.0, np.pi, 4001)[1:-1]
    azimuths = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)[:, None]
    p = np.stack(
        [np.sin(angles) * np.cos(azimuths), np.sin(angles) * np.sin(azimuths), np.cos(angles) + 0.0 * azimuths], axis=-1
    )
    pixels = model.project(p)
    valid = np.asarray(np.isfinite(pixels).all(axis=-1))
    assert (valid[:, :-1] >= valid[:, 1:]).all()  # one interval, from the axis on
    assert valid[:, 0].all()
    radius = np.linalg.norm(pixels - [model.cx, model.cy], axis=-1)
    assert (np.diff(radius, axis=1)[valid[:, 1:]] > 0.0).all()
    bearings = model.unproject(pixels)
    well_inside = np.roll(valid, -40, axis=1) & valid  # at the limit the inverse is ill conditioned
    np.testing.assert_allclose(bearings[well_inside], p[well_inside], atol=1e-9)
    last = valid.sum(axis=1) - 1
    outermost = pixels[np.arange(12), last]
    beyond = outermost + 0.05 * (outermost - [model.cx, model.cy])
    assert np.isnan(model.unproject(beyond)).all()
    assert np.isnan(model.normalize(beyond)).all()


def test_valid_limit_is_the_first_stationary_point() -> None:
    for lens, coefficients, limit in (
        (radtan, (-0.3, 0.0, 0.0, 0.0), np.sqrt(1.0 / 0.9)),
        (radtan, (-0.4, 0.05, 0.0, 0.0), np.sqrt((1.2 - np.sqrt(0.44)) / 0.5)),
        (radtan, EUROC_CAM0.distortion, np.inf),
        (radtan, (0.0, 0.0, 0.0, 0.0), np.inf),
        (radtan, (0.0, 0.0, 0.03, 0.04), 1.0 / 0.3),
        (radtan, (0.0, 0.0, 0.0, 0.0, -0.1), (1.0 / 0.7) ** (1.0 / 6.0)),
        (radtan, (0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0), 1.0),  # r / (1 + r²)
        (radtan, (0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0), 1.0),  # r / (1 − r²)
        (radtan, (0.5, 0.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0), np.inf),
        (radtan, (0.5, 0.0, 0.03, 0.04, 0.0, 0.5, 0.0, 0.0), 1.0 / 0.3),
        (equidistant, (-0.1, 0.0, 0.0, 0.0), np.sqrt(1.0 / 0.3)),
        (equidistant, (0.0, 0.0, 0.0, 0.0), np.pi),
    ):
        assert lens.valid_limit(coefficients) == pytest.approx(limit, rel=1e-12)


radial, tangential = st.floats(-0.5, 0.5), st.floats(-0.02, 0.02)
four = st.tuples(radial, radial, tangential, tangential)
radtans = st.one_of(
    four, st.tuples(four, st.tuples(radial)).map(sum_of), st.tuples(four, st.tuples(*[radial] * 4)).map(sum_of)
)


@given(radtans)
@settings(max_examples=100, deadline=None)
def test_radtan_jacobian_is_positive_within_its_limit(coefficients: tuple[float, ...]) -> None:
    radii = min(radtan.valid_limit(coefficients), 50.0) * np.linspace(0.0, 0.999, 50)[:, None]
    azimuths = np.linspace(0.0, 2.0 * np.pi, 36, endpoint=False)
    xy = np.stack([radii * np.cos(azimuths), radii * np.sin(azimuths)], axis=-1)
    assert np.linalg.eigvalsh(radtan.jacobian(xy, coefficients)).min() > 0.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"fx": 0.0}, "fx = 0.0"),
        ({"fy": np.nan}, "fy = nan"),
        ({"cx": np.inf}, "cx = inf"),
        ({"width": 0}, "width = 0; expected a whole number, 1 to 32000"),
        ({"lens": "magic"}, "lens 'magic'"),
        ({"lens": "ds"}, r"distortion of 4 numbers; expected 2 numbers \(xi, alpha\) for the lens ds"),
        ({"lens": "ds", "distortion": (-1.0, 0.5)}, r"camera xi = -1.0; expected a number, more than -1, at most 1"),
        ({"lens": "eucm", "distortion": (1.1, 1.0)}, r"camera alpha = 1.1; expected a number, 0 to 1"),
        ({"lens": "eucm", "distortion": (0.5, 0.0)}, r"camera beta = 0.0; expected a number, 0.001 to 1000"),
        ({"lens": "fov", "distortion": (0.0,)}, r"camera w = 0.0; expected a number, 1e-06 to 3.14"),
        ({"lens": "omni", "distortion": (-0.1, 0.0, 0.0, 0.0, 0.0)}, r"camera xi = -0.1; expected a number, 0 to 1000"),
        ({"distortion": (0.1, 0.0, np.nan, 0.0)}, "distortion = "),
        ({"distortion": (0.1, 0.0)}, r"4 numbers \(k1, k2, p1, p2\) or 5 numbers .* or 8 numbers"),
    ],
)
def test_invalid_cameras_are_refused(change: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        replace(EUROC_CAM0, **change)  # type: ignore[arg-type]


@pytest.mark.parametrize("model", [EUROC_CAM0, RADTAN5, RATIONAL])
@given(st.floats(-0.7, 0.7), st.floats(-0.45, 0.45))
@settings(max_examples=50, deadline=None)
def test_radtan_jacobian_is_the_derivative(model: CameraModel, x: float, y: float) -> None:
    xy, h = np.array([x, y]), 1e-6
    numeric = np.stack([(model.distort(xy + h * e) - model.distort(xy - h * e)) / (2 * h) for e in np.eye(2)], axis=1)
    np.testing.assert_allclose(radtan.jacobian(xy, model.distortion), numeric, atol=1e-8)


def test_camera_centre_and_nan_have_no_pixel() -> None:
    for model in ALL_CAMERAS:
        assert np.isnan(model.project(np.array([[0.0, 0.0, 0.0], [np.nan, 0.0, 1.0], [0.0, 0.0, -1.0]]))).all()
        assert np.isnan(model.unproject(np.array([np.nan, 3.0]))).all()
        np.testing.assert_allclose(model.unproject(np.array([model.cx, model.cy])), [0.0, 0.0, 1.0], atol=1e-15)
        np.testing.assert_allclose(model.project(np.array([0.0, 0.0, 2.0])), [model.cx, model.cy], atol=1e-12)
    assert set(LENSES) == {model.lens for model in ALL_CAMERAS}


def test_points_behind_the_camera_have_no_pixel() -> None:
    pixels = EUROC_CAM0.project(np.array([[0.1, 0.1, -1.0], [0.1, 0.1, 0.0], [0.0, 0.0, 1.0]]))
    assert np.isnan(pixels[:2]).all()
    np.testing.assert_array_equal(pixels[2], [EUROC_CAM0.cx, EUROC_CAM0.cy])


def test_empty_and_multidimensional_arrays_are_supported() -> None:
    assert EUROC_CAM0.normalize(np.zeros((0, 2))).shape == (0, 2)
    assert EUROC_CAM0.project(np.zeros((0, 3))).shape == (0, 2)
    pixels = pixel_grid(EUROC_CAM0)[:24].reshape(2, 3, 4, 2)
    np.testing.assert_array_equal(EUROC_CAM0.unproject(pixels).shape, (2, 3, 4, 3))
    np.testing.assert_allclose(EUROC_CAM0.normalize(pixels)[1, 2, 3], EUROC_CAM0.normalize(pixels[1, 2, 3]), atol=1e-12)


def test_eurocs_camera_faces_forward() -> None:
    rig = euroc_rig()
    T_vehicle_cam = rig.T_vehicle_imu @ rig.cameras[0].T_imu_cam
    for R in (EUROC_T_IMU_CAM0[:3, :3], rig.T_vehicle_imu[:3, :3]):
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(R) == pytest.approx(1.0)
    right, down, forward = T_vehicle_cam[:3, :3].T
    assert forward[0] > 0.99 and right[1] < -0.99 and down[2] < -0.99


def test_a_square_image_shows_the_middle_by_hand() -> None:
    camera = CameraModel(80, 40, 50.0, 50.0, 39.5, 19.5).fitted(20, 20)
    assert (camera.width, camera.height, camera.fx, camera.fy) == (20, 20, 25.0, 25.0)
    assert (camera.cx, camera.cy) == (9.5, 9.5)
    # Column 0 covers columns 20 and 21 of the whole image, whose middle is at 20.5.
    assert CameraModel(80, 40, 50.0, 50.0, 20.5, 19.5).fitted(20, 20).cx == 0.0


@given(st.integers(1, 2000), st.integers(1, 2000))
def test_fitted_images_have_the_pixels_of_the_camera(width: int, height: int) -> None:
    camera = EUROC_CAM0.fitted(width, height)
    assert camera.fx / camera.fy == pytest.approx(EUROC_CAM0.fx / EUROC_CAM0.fy)
    scale = camera.fx / EUROC_CAM0.fx
    assert min(width / scale, height / scale) > 0.0
    assert width / scale <= EUROC_CAM0.width * (1.0 + 1e-12) and height / scale <= EUROC_CAM0.height * (1.0 + 1e-12)
    assert max(width / scale / EUROC_CAM0.width, height / scale / EUROC_CAM0.height) == pytest.approx(1.0)


def test_fitted_with_the_same_ratio_is_resized() -> None:
    fitted, resized = EUROC_CAM0.fitted(376, 240), EUROC_CAM0.resized(376, 240)
    assert (fitted.fx, fitted.fy, fitted.cx, fitted.cy) == pytest.approx(
        (resized.fx, resized.fy, resized.cx, resized.cy)
    )
    with pytest.raises(ConfigError, match="width"):
        EUROC_CAM0.fitted(0, 0)
