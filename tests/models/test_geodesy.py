"""Geodetic coordinates, Earth-centred coordinates, local frames and attitudes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dronevio.models.geodesy import (
    FLATTENING,
    SEMI_MAJOR_M,
    GeodeticPoint,
    ecef_from_geodetic,
    geodetic_from_ecef,
    geodetic_from_utm,
    rotation_ecef_enu,
    rotation_enu_cam,
    yaw_pitch_roll_deg,
)

ZURICH = GeodeticPoint(47.3977, 8.5456, 430.0)
angles = st.floats(-180.0, 180.0)


def test_ecef_of_points_that_are_known() -> None:
    polar_m = SEMI_MAJOR_M * (1.0 - FLATTENING)
    found = ecef_from_geodetic(np.array([[0.0, 0.0, 10.0], [0.0, 90.0, 0.0], [90.0, 17.0, 0.0], [-90.0, 0.0, 5.0]]))
    expected = [[SEMI_MAJOR_M + 10.0, 0, 0], [0, SEMI_MAJOR_M, 0], [0, 0, polar_m], [0, 0, -polar_m - 5.0]]
    np.testing.assert_allclose(found, expected, atol=1e-8)
    # by PROJ 9 (pyproj 3.7.2, EPSG:4979 to EPSG:4978)
    proj = [4277515.676, 642759.801, 4672122.8325]
    np.testing.assert_allclose(ecef_from_geodetic(ZURICH.geodetic), proj, atol=1e-4)


def test_local_frame_as_in_proj() -> None:
    # by PROJ 9: +proj=cart +ellps=WGS84, then +proj=topocentric
    found = ZURICH.to_enu(np.array([47.45, 8.60, 500.0]))
    np.testing.assert_allclose(found, [4102.9003, 5816.5565, 66.0275], atol=1e-4)


@given(st.floats(-90.0, 90.0), st.floats(-179.999, 179.999), st.floats(-5_000.0, 100_000.0))
def test_ecef_and_back(latitude: float, longitude: float, height: float) -> None:
    geodetic = np.array([latitude, longitude, height])
    ecef = ecef_from_geodetic(geodetic)
    np.testing.assert_allclose(ecef_from_geodetic(geodetic_from_ecef(ecef)), ecef, atol=1e-6)
    if abs(latitude) < 89.999:
        np.testing.assert_allclose(geodetic_from_ecef(ecef), geodetic, rtol=0, atol=2e-6)


@given(st.floats(-89.0, 89.0), st.floats(-179.0, 179.0), st.lists(st.floats(-5000.0, 5000.0), min_size=3, max_size=3))
def test_local_frame_and_back(latitude: float, longitude: float, enu: list[float]) -> None:
    origin = GeodeticPoint(latitude, longitude, 100.0)
    np.testing.assert_allclose(origin.to_enu(origin.from_enu(np.array(enu))), enu, atol=1e-6)


def test_axes_of_a_local_frame() -> None:
    step = 1e-5  # degrees, about a metre
    moved = ZURICH.to_enu(ZURICH.geodetic + np.diag([step, step, 1.0]))
    assert moved[0, 1] == pytest.approx(1.11, abs=0.01) and abs(moved[0, 0]) < 1e-5
    assert moved[1, 0] == pytest.approx(1.11 * np.cos(np.radians(47.4)), abs=0.01) and abs(moved[1, 1]) < 1e-5
    np.testing.assert_allclose(moved[2], [0.0, 0.0, 1.0], atol=1e-6)
    R = rotation_ecef_enu(47.0, 8.0)
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-15)
    assert np.linalg.det(R) == pytest.approx(1.0)


def test_utm_as_in_proj() -> None:
    # by PROJ 9: EPSG:4326 to EPSG:32633 and EPSG:32718
    north = geodetic_from_utm(np.array([391390.7313, 5817855.2408]), 33, is_north=True)
    south = geodetic_from_utm(np.array([[650697.5213, 5426376.6231]]), 18, is_north=False)
    np.testing.assert_allclose(north, [52.5, 13.4], atol=1e-8)
    np.testing.assert_allclose(south, [[-41.3, -73.2]], atol=1e-8)


def test_attitudes_that_are_known() -> None:
    """Rows: east, north, up; columns: x to the right, y down, z along the optical axis."""
    level_north = rotation_enu_cam(0.0, 0.0, 0.0)
    np.testing.assert_allclose(level_north, [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-15)
    down_east = rotation_enu_cam(90.0, -90.0, 0.0)  # the upper edge of the image is in the east
    np.testing.assert_allclose(down_east, [[0, -1, 0], [-1, 0, 0], [0, 0, -1]], atol=1e-15)
    rolled = rotation_enu_cam(0.0, 0.0, 30.0)  # to the right: the right edge of the image sinks
    np.testing.assert_allclose(rolled[:, 0], [np.cos(np.pi / 6), 0.0, -0.5], atol=1e-15)


@given(angles, st.floats(-90.0, 90.0), angles)
def test_attitudes_and_back(yaw: float, pitch: float, roll: float) -> None:
    R = rotation_enu_cam(yaw, pitch, roll)
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(rotation_enu_cam(*yaw_pitch_roll_deg(R)), R, atol=1e-7)
