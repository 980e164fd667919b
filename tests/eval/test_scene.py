"""Geometry of drawings: up direction, upright frame, robust limits, frusta, viewpoints, and the style of residuals."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dronevio.eval import colours
from dronevio.eval.images import downscaled
from dronevio.eval.scene import (
    ResidualStyle,
    frusta,
    frustum_depth,
    reconstruction_view,
    robust_limits,
    round_down,
    scene_points,
    up_direction,
    upright_rotation,
    view_azimuth_deg,
)
from dronevio.models.arrays import Array
from dronevio.models.recordings.images import encode_jpeg
from dronevio.models.rotation import exp_so3, pose_matrix

if TYPE_CHECKING:
    from tests.eval.conftest import SyntheticReconstruction

LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Orientation of a camera without pitch and roll that looks along y; z is up."""
NADIR = np.diag([1.0, -1.0, -1.0])
"""Orientation of a camera that looks down, with the upper side of the image towards y."""


def poses(R: Array, yaws_deg: list[float], pitch_deg: float = 0.0) -> Array:
    """Return poses of cameras that are pitched upwards about their x axis and then turned about z."""
    pitch = exp_so3(np.array([np.radians(pitch_deg), 0.0, 0.0]))
    Rs = [exp_so3(np.array([0.0, 0.0, np.radians(yaw)])) @ R @ pitch for yaw in yaws_deg]
    return pose_matrix(np.stack(Rs), np.zeros((len(Rs), 3)))


@pytest.mark.parametrize(
    ("R", "yaws_deg", "pitch_deg"),
    [
        (LEVEL, [0.0, 40.0, 200.0], 0.0),
        (LEVEL, [-20.0, 0.0, 25.0], -30.0),
        (LEVEL, [0.0, 0.0], 0.0),
        (NADIR, [0.0, 90.0, 180.0], 0.0),
        (NADIR, [0.0, 60.0, -60.0, 180.0], 15.0),
    ],
)
def test_up_is_orthogonal_to_cameras_without_roll(R: Array, yaws_deg: list[float], pitch_deg: float) -> None:
    world = exp_so3(np.array([0.5, -0.8, 1.3]))
    Ts = poses(R, yaws_deg, pitch_deg)
    Ts[:, :3, :3] = world @ Ts[:, :3, :3]
    up = up_direction(Ts)
    assert np.linalg.norm(up) == pytest.approx(1.0)
    assert np.degrees(np.linalg.norm(np.cross(up, world[:, 2]))) < 0.25  # the prior has some influence
    assert up @ world[:, 2] > 0.0


def test_the_upright_frame_has_z_up_and_looks_along_y(synthetic: "SyntheticReconstruction") -> None:
    r = synthetic.reconstruction
    R = upright_rotation(r)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    np.testing.assert_allclose(R @ synthetic.up, [0.0, 0.0, 1.0], atol=1e-6)
    forward = R @ r.Ts_world_cam[:, :3, 2].mean(axis=0)
    assert forward[1] > 0.9 * np.linalg.norm(forward)
    extent = np.ptp(r.points @ R.T, axis=0)
    assert extent[0] > 2.0 * max(extent[1:])  # the wall is 6 m wide
    np.testing.assert_allclose(upright_rotation(r, 3.0 * synthetic.up), R, atol=1e-6)


def test_limits_leave_out_outliers() -> None:
    uniform = np.tile(np.arange(101.0)[:, None], (1, 3))
    low, high = robust_limits(uniform)
    np.testing.assert_allclose([low, high], [[-70.0] * 3, [170.0] * 3])
    low, high = robust_limits(np.concatenate([uniform, [[1e6, 50.0, 50.0]]]))
    assert high[0] < 200.0


def test_the_scene_has_cameras_but_no_outliers(synthetic: "SyntheticReconstruction") -> None:
    r = synthetic.reconstruction
    points = r.points.copy()
    points[3], points[4] = 1e6, np.nan
    shown = scene_points(replace(r, points=points))
    assert len(shown) == len(r.points) - 2 + len(r.image_names)
    np.testing.assert_array_equal(shown[-len(r.image_names) :], r.positions)


def test_frusta_by_hand(synthetic: "SyntheticReconstruction") -> None:
    r = synthetic.reconstruction
    camera = replace(r.cameras[0], fx=188.0, fy=120.0, cx=187.5, cy=119.5)  # the corners are at 45°
    level = replace(r, cameras=(camera,), Ts_world_cam=np.tile(np.eye(4), (len(r.image_names), 1, 1)))
    edges = frusta(level, 2.0)
    assert edges.shape == (8 * len(r.image_names), 2, 3)
    np.testing.assert_allclose(edges[:4, 0], 0.0)
    np.testing.assert_allclose(edges[:4, 1], [[-2, -2, 2], [2, -2, 2], [2, 2, 2], [-2, 2, 2]])
    np.testing.assert_allclose(edges[4:8, 1], edges[[1, 2, 3, 0], 1])


def test_frusta_are_small_beside_the_scene(synthetic: "SyntheticReconstruction") -> None:
    r = synthetic.reconstruction
    diagonal = np.linalg.norm(np.ptp(scene_points(r), axis=0))
    assert 0.015 * diagonal <= frustum_depth(r) <= 0.04 * diagonal
    assert frustum_depth(r.transformed(7.0, np.eye(3), np.zeros(3))) == pytest.approx(7.0 * frustum_depth(r))


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_the_viewpoint_sees_all_at_any_scale(synthetic: "SyntheticReconstruction", scale: float) -> None:
    r = synthetic.reconstruction.transformed(scale, np.eye(3), np.array([5.0, 0.0, 0.0]))
    R = upright_rotation(r)
    position, target = reconstruction_view(r, R)
    forward = (target - position) / np.linalg.norm(target - position)
    angles = np.arccos((scene_points(r) - position) @ forward / np.linalg.norm(scene_points(r) - position, axis=1))
    assert np.degrees(angles.max()) < 45.0
    assert forward @ R[2] == pytest.approx(-np.sin(np.radians(25.0)))
    assert forward @ R[1] > 0.5  # it looks as the cameras do


def test_viewpoints_of_cameras_in_all_directions_have_a_default() -> None:
    around = poses(LEVEL, [0.0, 90.0, 180.0, 270.0])[:, :3, :3]
    assert view_azimuth_deg(around) == 40.0
    assert view_azimuth_deg(poses(LEVEL, [0.0])[:, :3, :3]) == pytest.approx(90.0 + 35.0)


@pytest.mark.parametrize(
    ("value", "rounded"), [(0.0, 0.0), (1.0, 1.0), (1.99, 1.0), (2.0, 2.0), (49.0, 20.0), (0.07, 0.05), (5e3, 5e3)]
)
def test_lengths_are_rounded_down(value: float, rounded: float) -> None:
    assert round_down(value) == pytest.approx(rounded)


def test_large_residuals_are_visible(synthetic: "SyntheticReconstruction") -> None:
    r = synthetic.reconstruction
    style = ResidualStyle.of([r])
    assert style.limit_px == pytest.approx(np.percentile(r.reprojection_errors_px(), 95.0))
    assert 0.005 * 376 < style.factor * style.limit_px <= 0.02 * 376
    assert ResidualStyle.of([]) == ResidualStyle(1.0, 1.0)


def test_residual_colours_run_from_blue_to_yellow() -> None:
    rgb = colours.residual_colours(np.array([0.0, 2.0, 50.0, np.nan]), 2.0)
    assert rgb.tolist() == [[70, 110, 200], [253, 231, 37], [253, 231, 37], list(colours.rgb(colours.SURROUNDINGS))]


def test_images_are_reduced_but_never_enlarged() -> None:
    image = np.zeros((30, 60, 3), np.uint8)
    image[:, 30:] = 200
    small = downscaled(image, 20)
    assert small.shape == (10, 20, 3)
    assert small[0, 0].tolist() == [0, 0, 0] and small[0, -1].tolist() == [200, 200, 200]
    assert downscaled(image, 60) is image
    assert downscaled(image[:, :, 0], 6).shape == (3, 6)
    assert encode_jpeg(image[:, :, 0]).startswith(b"\xff\xd8\xff")
