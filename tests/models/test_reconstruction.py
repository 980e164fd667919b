"""Reconstructions: checks of the fields, reprojection, and changes of the world frame."""

from dataclasses import replace

import numpy as np
import pytest

from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.rotation import exp_so3


def two_views() -> Reconstruction:
    """Return two cameras 1 m apart along x that look along z at a point 4 m in front of the first."""
    Ts_world_cam = np.tile(np.eye(4), (2, 1, 1))
    Ts_world_cam[1, 0, 3] = 1.0
    return Reconstruction(
        cameras=(CameraModel(200, 100, 80.0, 80.0, 100.0, 50.0),),
        image_names=("left.png", "right.png"),
        image_camera=np.array([0, 0]),
        Ts_world_cam=Ts_world_cam,
        points=np.array([[0.0, 0.5, 4.0]]),
        colours=np.array([[10, 20, 30]], np.uint8),
        observation_image=np.array([0, 1]),
        observation_point=np.array([0, 0]),
        observation_px=np.array([[100.0, 60.0], [83.0, 64.0]]),
    )


def test_reprojection_errors_by_hand() -> None:
    # The point projects to (100, 50 + 80 * 0.5 / 4) in the first image and to (100 - 80 / 4, 60) in the second.
    np.testing.assert_allclose(two_views().reprojection_residuals_px(), [[0.0, 0.0], [-3.0, -4.0]], atol=1e-12)
    np.testing.assert_allclose(two_views().reprojection_errors_px(), [0.0, 5.0], atol=1e-12)
    assert two_views().track_lengths().tolist() == [2]


def test_a_new_world_frame_keeps_reprojections() -> None:
    before = two_views()
    R = exp_so3(np.array([0.3, -0.2, 0.9]))
    after = before.transformed(2.5, R, np.array([1.0, 2.0, -3.0]))
    np.testing.assert_allclose(after.reprojection_errors_px(), before.reprojection_errors_px(), atol=1e-10)
    assert np.linalg.norm(after.positions[1] - after.positions[0]) == pytest.approx(2.5)


def test_points_behind_a_camera_have_no_reprojection() -> None:
    behind = replace(two_views(), points=np.array([[0.0, 0.5, -4.0]]))
    assert np.isnan(behind.reprojection_errors_px()).all()


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("points", np.zeros((2, 3)), "colours has shape"),
        ("observation_image", np.array([0, 2]), "observation_image has values from 0 to 2; expected 0 to 1"),
        ("observation_point", np.array([0, -1]), "observation_point has values from -1"),
        ("image_camera", np.array([0, 1]), "image_camera"),
    ],
)
def test_contradictions_are_named(field: str, value: np.ndarray, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        replace(two_views(), **{field: value})  # type: ignore[arg-type]
