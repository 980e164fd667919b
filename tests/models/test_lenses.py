"""Lens models: values by hand, other implementations, the inverse of the projection, and the field of view."""

from typing import Any

import gtsam
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.lenses import ds, eucm, fov, omni, radtan
from dronevio.models.lenses.lens import LENSES, LensName

small, tangential = st.floats(-0.3, 0.3), st.floats(-5e-3, 5e-3)
RADTAN = (small, small, tangential, tangential)
COEFFICIENTS: dict[LensName, list[tuple[st.SearchStrategy[float], ...]]] = {
    "radtan": [RADTAN, (*RADTAN, small), (*RADTAN, small, small, small, small)],
    "equidistant": [(st.floats(-0.1, 0.1),) * 4],
    "fov": [(st.floats(1e-3, 3.0),)],
    "ds": [(st.floats(-0.9, 1.0), st.floats(0.0, 1.0))],
    "eucm": [(st.floats(0.0, 1.0), st.floats(0.1, 10.0))],
    "omni": [(st.floats(0.0, 5.0), *RADTAN)],
}


@st.composite
def cameras(draw: st.DrawFn) -> CameraModel:
    """Cameras with any lens and a focal length of 300 px near the axis."""
    lens = draw(st.sampled_from(list(LENSES)))
    coefficients = draw(st.tuples(*draw(st.sampled_from(COEFFICIENTS[lens]))))
    f = 300.0 / LENSES[lens].central_scale(coefficients)
    return CameraModel(640, 480, f, f, 319.5, 239.5, coefficients, lens)


@settings(max_examples=400, deadline=None)
@given(cameras(), st.integers(0, 2**32 - 1))
def test_projection_inverts_unprojection(model: CameraModel, seed: int) -> None:
    pixels = np.random.default_rng(seed).uniform([-0.5, -0.5], [639.5, 479.5], (200, 2))
    rays = model.unproject(pixels)
    seen = np.asarray(np.isfinite(rays).all(axis=-1))
    assert seen[np.linalg.norm(pixels - [model.cx, model.cy], axis=1) < 0.1 * model.fx].all()
    np.testing.assert_allclose(np.linalg.norm(rays[seen], axis=-1), 1.0, atol=1e-13)
    back = model.project(rays[seen] * np.random.default_rng(seed).uniform(0.1, 100.0, (seen.sum(), 1)))
    on_edge = np.isnan(back).any(axis=-1)  # rounding may carry a ray to the limit of the lens
    assert on_edge.sum() <= 1
    np.testing.assert_allclose(back[~on_edge], pixels[seen][~on_edge], atol=1e-9)


@settings(max_examples=200, deadline=None)
@given(cameras(), st.integers(0, 2**32 - 1))
def test_unprojection_inverts_projection(model: CameraModel, seed: int) -> None:
    """Every direction that has a pixel is found again, and no other one has that pixel."""
    p = np.random.default_rng(seed).normal(size=(100, 3))
    p /= np.linalg.norm(p, axis=1, keepdims=True)
    pixels = model.project(p)
    seen = np.isfinite(pixels).all(axis=-1) & (np.abs(pixels - [model.cx, model.cy]) < 2000.0).all(axis=-1)
    h = 1e-5
    nearby = [model.project(p[seen] + h * axis) for axis in np.eye(3)]
    J = np.stack([(near - pixels[seen]) / h for near in nearby], axis=-1)
    # Where a pixel hardly moves with the direction, near the limit of the lens, the inverse is ill conditioned.
    well = np.asarray(np.isfinite(J).all(axis=(1, 2)))
    well[well] = np.linalg.svd(J[well], compute_uv=False)[:, -1] > 1.0
    np.testing.assert_allclose(model.unproject(pixels[seen][well]), p[seen][well], atol=1e-8)


@settings(max_examples=100, deadline=None)
@given(cameras())
def test_the_focal_length_near_the_axis_is_the_derivative(model: CameraModel) -> None:
    h = 1e-6
    right, down = model.project(np.array([[h, 0.0, 1.0], [0.0, h, 1.0]])) - [model.cx, model.cy]
    assert right[0] / h == pytest.approx(model.central_focal_px[0], rel=1e-4)
    assert down[1] / h == pytest.approx(model.central_focal_px[1], rel=1e-4)
    np.testing.assert_allclose(model.K[[0, 1], [0, 1]], model.central_focal_px)


def rays(degrees: float) -> Array:
    """Return a ray (3,) at an angle from the axis, to the right."""
    return np.array([np.sin(np.radians(degrees)), 0.0, np.cos(np.radians(degrees))])


@pytest.mark.parametrize(
    ("lens", "coefficients", "degrees", "radius"),
    [
        (omni, (1.0, 0.0, 0.0, 0.0, 0.0), 90.0, 1.0),  # stereographic: tan(θ / 2)
        (omni, (1.0, 0.0, 0.0, 0.0, 0.0), 120.0, np.sqrt(3.0)),
        (omni, (1.0, 0.1, 0.0, 0.0, 0.01), 90.0, 1.1 + 3.0 * 0.01),  # (1 + k₁) · 1 + 3 p₂
        (omni, (0.0, 0.0, 0.0, 0.0, 0.0), 45.0, 1.0),
        (omni, (2.0, 0.0, 0.0, 0.0, 0.0), 90.0, 0.5),
        (eucm, (0.5, 1.0), 90.0, 2.0),  # 2 tan(θ / 2)
        (eucm, (0.5, 4.0), 90.0, 1.0),  # d = 2 at 90°
        (eucm, (0.0, 3.0), 45.0, 1.0),
        (ds, (0.0, 0.5), 90.0, 2.0),
        (ds, (1.0, 0.0), 90.0, 1.0),
        (ds, (0.5, 0.5), 90.0, 1.0 / (0.5 * np.sqrt(1.25) + 0.25)),
        (ds, (-0.5, 0.5), 90.0, 1.0 / (0.5 * np.sqrt(1.25) - 0.25)),
        (fov, (0.5 * np.pi,), np.degrees(np.arctan(0.5)), 0.5),  # arctan(1) / (π / 2)
        (radtan, (0.1, 0.2, 0.0, 0.01, 0.3, 0.0, 0.0, 0.1), 45.0, 1.6 / 1.1 + 0.03),
    ],
)
def test_values_by_hand(lens: Any, coefficients: tuple[float, ...], degrees: float, radius: float) -> None:
    np.testing.assert_allclose(lens.project(3.0 * rays(degrees), coefficients), [radius, 0.0], atol=1e-14)
    found = lens.unproject(np.array([radius, 0.0]), coefficients)
    np.testing.assert_allclose(found / np.linalg.norm(found), rays(degrees), atol=1e-12)


@settings(max_examples=100, deadline=None)
@given(st.floats(0.0, 5.0), st.floats(0.0, 170.0))
def test_unified_models_agree(xi: float, degrees: float) -> None:
    p, alpha = 2.0 * rays(degrees), xi / (1.0 + xi)
    unified = eucm.project(p, (alpha, 1.0))
    np.testing.assert_allclose(unified, ds.project(p, (0.0, alpha)), rtol=1e-12)
    theirs = (1.0 + xi) * omni.project(p, (xi, 0.0, 0.0, 0.0, 0.0))
    if abs(np.cos(np.radians(degrees)) + min(xi, 1.0 / max(xi, 1.0))) > 1e-9:  # not at the limit
        np.testing.assert_allclose(unified, theirs, rtol=1e-7)


@settings(max_examples=200, deadline=None)
@given(st.floats(-0.9, 0.9), st.floats(0.01, 0.99), st.floats(0.0, 180.0), st.floats(-3.0, 3.0))
def test_double_sphere_agrees_with_the_paper(xi: float, alpha: float, degrees: float, azimuth: float) -> None:
    """Usenko et al., eqs. 40 to 42, up to the maximum of the radius, which is that of the second half.

    Their limit (eq. 43) is another one: it is too early for ξ > 0, and too late where ξ is near -1.
    """
    x, y, z = 2.5 * np.array([rays(degrees)[0] * np.cos(azimuth), rays(degrees)[0] * np.sin(azimuth), rays(degrees)[2]])
    d1 = np.sqrt(x**2 + y**2 + z**2)
    d2 = np.sqrt(x**2 + y**2 + (xi * d1 + z) ** 2)
    w1 = alpha / (1.0 - alpha) if alpha <= 0.5 else (1.0 - alpha) / alpha
    beyond = xi * d1 + z + w1 * d2
    assume(abs(beyond) > 1e-9)
    found = ds.project(np.array([x, y, z]), (xi, alpha))
    if beyond < 0.0:
        assert np.isnan(found).all()
    else:
        np.testing.assert_allclose(found, np.array([x, y]) / (alpha * d2 + (1.0 - alpha) * (xi * d1 + z)), rtol=1e-12)


def test_the_field_of_view_of_the_fisheyes_exceeds_180_degrees() -> None:
    """Rays behind the camera have pixels and return from them, but no normalized coordinates."""
    for lens, coefficients in (("ds", (-0.2, 0.6)), ("eucm", (0.6, 1.1)), ("omni", (1.2, 0.0, 0.0, 0.0, 0.0))):
        model = CameraModel(640, 640, 150.0, 150.0, 319.5, 319.5, coefficients, lens)  # type: ignore[arg-type]
        p = np.stack([rays(degrees) for degrees in (80.0, 89.9, 90.1, 100.0)])
        pixels = model.project(p)
        np.testing.assert_allclose(model.unproject(pixels), p, atol=1e-12)
        np.testing.assert_array_equal(np.isnan(model.normalize(pixels)).any(axis=1), [False, False, True, True])


def test_omni_agrees_with_gtsam() -> None:
    xi, k1, k2, p1, p2 = 1.3, -0.2, 0.05, 1e-3, -2e-3
    model = CameraModel(640, 480, 500.0, 510.0, 320.0, 240.0, (xi, k1, k2, p1, p2), "omni")
    theirs = gtsam.Cal3Unified(500.0, 510.0, 0.0, 320.0, 240.0, k1, k2, p1, p2, xi)
    for xy in np.random.default_rng(0).uniform(-2.0, 2.0, (100, 2)):
        np.testing.assert_allclose(model.project(np.array([*xy, 1.0])), theirs.uncalibrate(xy), atol=1e-9)


@pytest.mark.parametrize(
    ("name", "lens", "coefficients"),
    [
        ("FOV", "fov", (0.93,)),
        ("FULL_OPENCV", "radtan", (0.4, 0.05, 1e-3, -2e-3, 0.001, 0.55, 0.2, 0.01)),
        ("EUCM", "eucm", (0.59, 1.127)),
    ],
)
def test_colmap_has_the_same_values(name: str, lens: LensName, coefficients: tuple[float, ...]) -> None:
    """COLMAP's models by pycolmap, with its centre of the first pixel at (0.5, 0.5)."""
    pycolmap = pytest.importorskip("pycolmap")
    ours = CameraModel(640, 480, 400.0, 410.0, 319.0, 241.0, coefficients, lens)
    theirs = pycolmap.Camera(model=name, width=640, height=480, params=[400.0, 410.0, 319.5, 241.5, *coefficients])
    p = np.random.default_rng(0).uniform([-1.0, -1.0, 1.0], [1.0, 1.0, 3.0], (200, 3))
    np.testing.assert_allclose(ours.project(p) + 0.5, theirs.img_from_cam(p), atol=1e-9)
