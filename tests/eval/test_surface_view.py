"""The viewpoint from which dense surfaces fill a picture."""

import numpy as np
import pytest

from dronevio.eval.scene import VIEWER_FIELD_OF_VIEW_RAD
from dronevio.eval.splatting import ViewCamera
from dronevio.eval.surface_view import surface_view
from dronevio.models.camera import CameraModel
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.rotation import exp_so3, pose_matrix

LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # x right, z forward along y of the world


def cameras(headings_deg: list[float]) -> Reconstruction:
    """Return cameras around the origin with these headings, without points."""
    none = np.empty(0, np.int64)
    turned = [exp_so3(np.array([0.0, 0.0, np.radians(h)])) @ LEVEL for h in headings_deg]
    return Reconstruction(
        cameras=(CameraModel(8, 6, 10.0, 10.0, 3.5, 2.5),),
        image_names=tuple(str(k) for k in range(len(turned))),
        image_camera=np.zeros(len(turned), np.int64),
        Ts_world_cam=np.stack([pose_matrix(R, np.array([0.1 * k, 0.0, 0.0])) for k, R in enumerate(turned)]),
        points=np.empty((0, 3)),
        colours=np.empty((0, 3), np.uint8),
        observation_image=none,
        observation_point=none,
        observation_px=np.empty((0, 2)),
    )


@pytest.mark.parametrize("aspect", [0.8, 1.6])
@pytest.mark.parametrize("headings_deg", [[-5.0, 0.0, 5.0], [0.0, 90.0, 180.0, 270.0]])
def test_surfaces_fill_the_picture(headings_deg: list[float], aspect: float) -> None:
    rng = np.random.default_rng(0)
    centre = np.array([0.0, 8.0, 0.0]) if len(headings_deg) == 3 else np.zeros(3)
    points = centre + rng.uniform(-2.0, 2.0, (2000, 3))
    position, target = surface_view(cameras(headings_deg), points, aspect)
    view_camera = ViewCamera.looking_at(
        position, target, np.array([0.0, 0.0, 1.0]), VIEWER_FIELD_OF_VIEW_RAD, round(600 * aspect), 600
    )
    in_view = (points - position) @ view_camera.axes.T
    assert in_view[:, 2].min() > 0.0
    sides = np.abs(in_view[:, :2]) / in_view[:, 2:] * view_camera.focal_px / [300.0 * aspect, 300.0]
    assert np.mean((sides < 1.0).all(axis=1)) > 0.8
    assert np.percentile(sides.max(axis=1), 98.0) > 0.6
    if len(headings_deg) == 3:
        assert position[1] < centre[1] - 2.0  # on the side of the cameras
    else:
        assert position[2] > 2.0  # above
