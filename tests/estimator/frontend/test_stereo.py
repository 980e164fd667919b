"""Stereo matches of one pair of images of a textured wall, between cameras side by side."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from dronevio.estimator.frontend import klt
from dronevio.estimator.frontend.stereo import StereoConfig, StereoMatcher
from dronevio.estimator.intrinsics import IntrinsicCorrections
from dronevio.estimator.types import Calibration
from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.rig import Rig, RigCamera
from dronevio.models.rotation import pose_matrix

RenderWall = Callable[[CameraModel, Array], npt.NDArray[np.uint8]]

PINHOLE = CameraModel(376, 240, 229.0, 228.5, 183.5, 124.0)
BASELINE_M, WALL_M = 0.11, 3.0


def test_matches_lead_back_to_their_features(render_wall: RenderWall) -> None:
    """An object in front of the second camera hides a part of the wall.

    What is behind it is not matched: from the most similar place near the line, the way back leads elsewhere.
    """
    c = StereoConfig()
    left, right = (RigCamera(PINHOLE, pose_matrix(np.eye(3), np.array([x, 0.0, 0.0]))) for x in (0.0, BASELINE_M))
    first, second = (render_wall(PINHOLE, camera.T_imu_cam) for camera in (left, right))
    second[60:180, 100:240] = render_wall(PINHOLE, pose_matrix(np.eye(3), np.array([2.0, 1.0, 0.0])))[60:180, 100:240]
    pixels = np.stack(np.meshgrid(np.arange(30.0, 350.0, 6.0), np.arange(20.0, 220.0, 6.0)), axis=-1).reshape(-1, 2)
    xy = PINHOLE.normalize(pixels)
    matcher = StereoMatcher(Calibration(Rig((left, right))), 0, 1, c)
    found = matcher.match(first, second, pixels, xy, np.full(len(pixels), 1.0 / WALL_M))
    shifted = pixels - [PINHOLE.fx * BASELINE_M / WALL_M, 0.0]
    is_hidden = np.all((shifted > [112, 72]) & (shifted < [228, 168]), axis=1)
    is_seen = ~np.all((shifted > [90, 50]) & (shifted < [250, 190]), axis=1)
    assert is_hidden.sum() > 250
    assert np.sum(is_hidden[found.rows]) < 0.02 * is_hidden.sum()
    assert np.sum(is_seen[found.rows]) > 0.98 * is_seen.sum()
    start = pixels[found.rows]
    back, returned = klt.track(second, first, found.pixels, start, c.window_px, 0)
    assert returned.all()
    assert np.linalg.norm(back - start, axis=1).max() < c.max_backward_error_px


def test_search_begins_by_corrected_intrinsics(render_wall: RenderWall) -> None:
    """Without a pyramid, features are matched only where the second camera is expected to show them."""
    c, focal, (dx, dy) = StereoConfig(pyramid_levels=0), 0.03, (0.05, -0.04)
    left, right = (RigCamera(PINHOLE, pose_matrix(np.eye(3), np.array([x, 0.0, 0.0]))) for x in (0.0, BASELINE_M))
    first, second = (render_wall(PINHOLE, camera.T_imu_cam) for camera in (left, right))
    fx, fy = PINHOLE.fx / (1.0 + focal), PINHOLE.fy / (1.0 + focal)
    wrong = replace(PINHOLE, fx=fx, fy=fy, cx=PINHOLE.cx - fx * dx, cy=PINHOLE.cy - fy * dy)
    given = Calibration(Rig((left, replace(right, model=wrong))))
    corrections = IntrinsicCorrections(
        np.array([0.0, focal]), np.array([[0.0, 0.0], [dx, dy]]), np.zeros(2), given.models
    )
    pixels = np.stack(np.meshgrid(np.arange(60.0, 340.0, 20.0), np.arange(40.0, 200.0, 20.0)), axis=-1).reshape(-1, 2)
    found = [
        StereoMatcher(calibration, 0, 1, c).match(
            first, second, pixels, PINHOLE.normalize(pixels), np.full(len(pixels), 1.0 / WALL_M)
        )
        for calibration in (given, replace(given, intrinsics=corrections))
    ]
    assert len(found[0].rows) < 0.1 * len(pixels) and len(found[1].rows) > 0.9 * len(pixels)
    np.testing.assert_allclose(found[1].inverse_depth, 1.0 / WALL_M, atol=0.01)
