"""Depth maps of synthetic scenes, semi-global matching by hand, orientations of surfaces, and views."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dronevio.estimator.dense.config import DepthConfig, ViewConfig
from dronevio.estimator.dense.depth import estimate_depth
from dronevio.estimator.dense.directions import dominant_normals
from dronevio.estimator.dense.neighbours import observed_points, select_neighbours
from dronevio.estimator.dense.sgm import aggregate, subpixel_minimum
from dronevio.estimator.dense.views import Undistortion, ViewLoader
from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.errors import InputError
from dronevio.models.image_sets import ImageSet

MakeScene = Callable[..., Any]
Scene = Any  # the class of conftest, which cannot be imported

SMALL = DepthConfig(levels=2, directions=0)


def relative_errors(scene: Scene, config: DepthConfig, normals: Array) -> tuple[Array, Array]:
    """Return the relative errors (N,) of the depths below 4 of the middle image, and the correlations (N,)."""
    load = ViewLoader(scene.images, scene.reconstruction, ViewConfig())
    sources = [load(i) for i in (0, 1, 3, 4)]
    found = estimate_depth(load(2), sources, observed_points(scene.reconstruction, 2), normals, config)
    true = scene.depths(scene.reconstruction.Ts_world_cam[2], load.camera(2).rays().astype(np.float64))
    near = true < 4.5
    return np.abs(found.inverse_depth[near] * true[near] - 1.0), found.correlation[near]


def test_depths_of_a_slanted_plane(slanted: Scene) -> None:
    errors, correlation = relative_errors(slanted, SMALL, np.zeros((0, 3)))
    assert np.median(errors) < 0.008  # 0.15 px
    assert np.mean(errors < 0.02) > 0.93
    assert np.median(correlation) > 0.9


def test_neighbours_that_look_away_do_not_matter(slanted: Scene) -> None:
    load = ViewLoader(slanted.images, slanted.reconstruction, ViewConfig())
    points = observed_points(slanted.reconstruction, 2)
    behind = np.diag([-1.0, 1.0, -1.0, 1.0])
    away = [replace(load(i), T_world_cam=load(i).T_world_cam @ behind) for i in (0, 3, 4)]
    with_them = estimate_depth(load(2), [load(1), *away], points, np.zeros((0, 3)), SMALL)
    true = slanted.depths(slanted.reconstruction.Ts_world_cam[2], load.camera(2).rays().astype(np.float64))
    errors = np.abs(with_them.inverse_depth * true - 1.0)[:, 30:130]
    assert np.median(errors) < 0.02
    alone = estimate_depth(load(2), away, points, np.zeros((0, 3)), SMALL)
    assert not alone.inverse_depth.any()
    assert not alone.correlation.any()


def test_depths_of_a_ball_and_a_wall(ball: Scene) -> None:
    errors, _ = relative_errors(ball, SMALL, np.zeros((0, 3)))
    assert np.median(errors) < 0.008  # 0.15 px
    assert np.mean(errors < 0.02) > 0.85  # the rest is beside the outline of the ball


def test_a_grazing_plane_needs_its_normal(make_dense_scene: MakeScene, make_plane: MakeScene) -> None:
    scene = make_dense_scene(make_plane((0.0, 1.0, 0.05), 0.5))
    along_axis = np.mean(relative_errors(scene, SMALL, np.zeros((0, 3)))[0] < 0.03)
    along_normal = np.mean(relative_errors(scene, SMALL, np.array([[0.0, 1.0, 0.0]]))[0] < 0.03)
    assert along_normal > 0.9 > along_axis + 0.05


def test_paths_prefer_smooth_depths_by_hand() -> None:
    costs = np.full((1, 3, 3), 100, np.uint8)  # one row of three pixels, three depths
    costs[0, 0, [0, 2]] = 0
    costs[0, 1, 1] = 98
    grey = np.zeros((1, 3), np.float32)
    assert subpixel_minimum(aggregate(costs, grey, 0.0, 0.0))[0].tolist() == [[0, 1, 0]]
    total = aggregate(costs, grey, 10.0, 40.0)
    assert subpixel_minimum(total)[0].tolist() == [[0, 0, 0]]
    assert total[0, :2, 1].tolist() == [8 * 100, 8 * 98 + 2 * 10]  # two of the eight paths have a predecessor


def test_penalties_are_smaller_at_edges() -> None:
    costs = np.zeros((1, 3, 2), np.uint8)
    costs[0, 2, 0], costs[0, 0, 1] = 200, 100
    flat, edge = np.zeros((1, 2), np.float32), np.array([[0.0, 200.0]], np.float32)
    assert aggregate(costs, edge, 10.0, 80.0)[0, 2, 1] <= aggregate(costs, flat, 10.0, 80.0)[0, 2, 1]


def test_the_vertex_of_a_parabola() -> None:
    positions = np.arange(5.0)
    costs = np.round(100.0 * (positions - 2.3) ** 2).astype(np.uint16).reshape(1, 5, 1)
    index, offset = subpixel_minimum(costs)
    assert index.item() + offset.item() == pytest.approx(2.3, abs=0.01)


def test_normals_of_a_room() -> None:
    rng = np.random.default_rng(0)
    walls = [np.insert(rng.uniform(0.0, 3.0, (n, 2)), k, 1.0 * k, axis=1) for k, n in ((0, 300), (1, 400), (2, 500))]
    noisy = np.concatenate(walls) + rng.normal(scale=1e-3, size=(1200, 3))
    normals = dominant_normals(noisy, 3)
    np.testing.assert_allclose(np.abs(normals), np.eye(3)[::-1], atol=0.03)
    assert len(dominant_normals(noisy, 2)) == 2
    assert len(dominant_normals(noisy[:5], 3)) == 0


def test_neighbours_have_the_preferred_angle(slanted: Scene) -> None:
    near = select_neighbours(slanted.reconstruction, ViewConfig(neighbours=2, angle_deg=5.0))
    far = select_neighbours(slanted.reconstruction, ViewConfig(neighbours=2, angle_deg=25.0))
    assert set(near[0]) == {1, 2}
    assert 4 in far[0]
    assert all(i not in row for i, row in enumerate(near))


def test_images_without_common_points_are_no_neighbours(slanted: Scene) -> None:
    model = slanted.reconstruction
    seen = model.observation_image != 0
    alone = replace(
        model,
        observation_image=model.observation_image[seen],
        observation_point=model.observation_point[seen],
        observation_px=model.observation_px[seen],
    )
    neighbours = select_neighbours(alone, ViewConfig())
    assert len(neighbours[0]) == 0
    assert 0 not in neighbours[1]


@pytest.mark.parametrize(
    "model",
    [
        CameraModel(160, 120, 150.0, 150.0, 79.5, 59.5, (-0.3, 0.08, 1e-3, -1e-3)),
        CameraModel(160, 120, 60.0, 60.0, 79.5, 59.5, (0.02, 0.01, 0.0, 0.0), "equidistant"),
    ],
)
def test_undistorted_pixels_have_their_bearing(model: CameraModel) -> None:
    found = Undistortion.of(model, ViewConfig())
    pixels = model.project(found.camera.rays().astype(np.float64))
    np.testing.assert_allclose(found.map_px[found.mask], pixels[found.mask], atol=1e-4)
    assert found.mask.mean() > 0.8
    rays = found.camera.rays()
    assert np.degrees(np.arctan(np.abs(rays[..., 0]).max())) <= 60.5  # a fisheye is cut there


def test_large_photographs_are_reduced() -> None:
    model = CameraModel(400, 300, 380.0, 380.0, 199.5, 149.5)
    found = Undistortion.of(model, ViewConfig(max_side_px=100))
    assert (found.camera.width, found.camera.height) == (100, 75)
    ramp = np.tile(np.arange(400) // 2, (300, 1)).astype(np.uint8)
    centre = found.apply(ramp)[37].astype(float)
    np.testing.assert_allclose(centre, np.arange(100) * 2.0 + 0.75, atol=0.8)


def test_masked_pixels_have_no_depth(slanted: Scene) -> None:
    mask = np.ones((120, 160), bool)
    mask[:, :40] = False
    masked = replace(slanted.images, read_mask=lambda index: mask)
    view = ViewLoader(masked, slanted.reconstruction, ViewConfig())(2)
    assert not view.mask[:, :39].any()
    assert view.mask[:, 41:].all()


def test_missing_images_are_named(slanted: Scene) -> None:
    renamed: ImageSet = replace(slanted.images, names=("a", "b", "c", "d", "e"))
    with pytest.raises(InputError, match=r"0\.png: 5 images of the reconstruction"):
        ViewLoader(renamed, slanted.reconstruction, ViewConfig())


def test_halved_cameras_project_to_the_same_places(slanted: Scene) -> None:
    view = ViewLoader(slanted.images, slanted.reconstruction, ViewConfig())(0)
    half = view.halved()
    ray = view.camera.rays()[31, 41]
    u, v, _ = half.camera.K @ ray
    assert (u, v) == pytest.approx(((41 - 0.5) / 2, (31 - 0.5) / 2), abs=1e-5)
    assert half.grey.shape == (half.camera.height, half.camera.width)
    np.testing.assert_allclose(half.grey[5, 7], view.grey[10:12, 14:16].mean(), atol=1e-3)
