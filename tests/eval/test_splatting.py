"""Pictures of dense points."""

import numpy as np
import pytest

from dronevio.eval.splatting import BACKGROUND, ViewCamera, shaded, splat

CAMERA = ViewCamera.looking_at(
    np.array([0.0, -5.0, 0.0]), np.zeros(3), np.array([0.0, 0.0, 1.0]), np.radians(60.0), 40, 30
)


def test_axes_of_a_view_camera_by_hand() -> None:
    np.testing.assert_allclose(CAMERA.axes, [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]], atol=1e-12)
    assert CAMERA.focal_px == pytest.approx(15.0 / np.tan(np.radians(30.0)))


def test_near_points_cover_distant_ones() -> None:
    points = np.array([[0.0, 0.0, 0.0], [0.0, 3.0, 0.0], [0.0, -9.0, 0.0], [1.0, 0.0, 0.0]])
    colours = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [9, 9, 9]], np.uint8)
    picture = splat(CAMERA, points, colours, size=0.01)
    assert picture[15, 20].tolist() == [255, 0, 0]
    assert picture[15, 20 + round(CAMERA.focal_px / 5.0)].tolist() == [9, 9, 9]
    assert np.sum((picture != np.array(BACKGROUND)).any(axis=-1)) == 2


def test_points_are_as_large_as_their_size() -> None:
    picture = splat(CAMERA, np.zeros((1, 3)), np.full((1, 3), 200, np.uint8), size=0.5)
    side = np.ceil(0.5 * CAMERA.focal_px / 5.0)
    assert np.sum((picture == 200).all(axis=-1)) == side**2


def test_a_scene_behind_the_viewpoint_is_empty() -> None:
    picture = splat(CAMERA, np.array([[0.0, -9.0, 0.0]]), np.full((1, 3), 200, np.uint8), size=1.0)
    assert (picture == np.array(BACKGROUND)).all()


def test_surfaces_that_face_the_viewpoint_are_brighter() -> None:
    normals = np.array([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]])
    assert CAMERA.faces(np.zeros((2, 3)), normals).tolist() == [True, False]
    grey = shaded(normals, CAMERA)[:, 0]
    assert grey[0] > 2 * grey[1] > 0
