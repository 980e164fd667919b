"""Textures of meshes: images of triangles, packing, and colours on surfaces of known colour."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates

from dronevio.estimator.dense.config import ViewConfig
from dronevio.estimator.dense.consistency import PosedDepth
from dronevio.estimator.dense.meshing.atlas import pack
from dronevio.estimator.dense.meshing.mesh import vertex_normals
from dronevio.estimator.dense.meshing.texture import textured
from dronevio.estimator.dense.meshing.view_selection import adjacent, agreement, candidate_views, select_views
from dronevio.estimator.dense.views import ViewLoader
from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.depth import Pinhole
from dronevio.models.surfaces import Mesh, Texture
from tests.estimator.dense.conftest import DenseScene, build_dense_scene, plane, sphere, texture

VOXEL = 0.05
FINE = CameraModel(640, 480, 600.0, 600.0, 319.5, 239.5)
"""A camera whose pixels are much smaller than the wavelengths of the surfaces."""
SQUARE = np.array([[0, 1, 2], [1, 3, 2]])
"""Two triangles with a common edge."""


def look(points: Array) -> Array:
    """Return the grey values (…) of points (…, 3) in an image."""
    return np.clip(texture(points), 0.0, 255.0)


def grid_mesh(depth: float, extent: tuple[float, float] = (1.5, 1.1), colour: int = 128) -> Mesh:
    """Return a plane at a depth, towards the cameras, with triangles of the size of a voxel."""
    x, y = (np.arange(-size, size + 1e-9, VOXEL) for size in extent)
    X, Y = np.meshgrid(x, y)
    vertices = np.stack([X.ravel(), Y.ravel(), np.full(X.size, depth)], axis=1)
    corner = (np.arange(len(y) - 1)[:, None] * len(x) + np.arange(len(x) - 1)).ravel()
    lower = np.stack([corner, corner + len(x), corner + 1], axis=1)  # counterclockwise as seen against z
    upper = np.stack([corner + 1, corner + len(x), corner + len(x) + 1], axis=1)
    triangles = np.concatenate([lower, upper])
    normals = vertex_normals(vertices, triangles)
    assert np.allclose(normals, [0.0, 0.0, -1.0])
    return Mesh(vertices, normals, np.full(vertices.shape, colour, np.uint8), triangles)


def true_depths(scene: DenseScene, load: ViewLoader) -> list[PosedDepth]:
    depths = []
    for i in range(len(load)):
        camera, T = load.camera(i), scene.reconstruction.Ts_world_cam[i]
        z = scene.depths(T, camera.rays().astype(np.float64))
        depths.append(PosedDepth(camera, T, np.where(np.isfinite(z), 1.0 / z, 0.0).astype(np.float32)))
    return depths


def sampled(found: Texture, weights: tuple[float, float, float]) -> Array:
    """Return the grey values (F,) of the texture at points of the triangles, by barycentric coordinates."""
    column, row = np.einsum("k,fkd->df", weights, found.pixels[found.triangles])
    return np.asarray(map_coordinates(found.image[..., 0].astype(np.float64), [row, column], order=1))


@pytest.mark.parametrize("weights", [(1 / 3, 1 / 3, 1 / 3), (1.0, 0.0, 0.0), (0.1, 0.2, 0.7)])
def test_the_texture_of_a_plane_is_what_its_points_look_like(weights: tuple[float, float, float]) -> None:
    scene = build_dense_scene(plane((0.0, 0.0, 1.0), 4.0), camera=FINE)
    load = ViewLoader(scene.images, scene.reconstruction, ViewConfig())
    mesh = grid_mesh(4.0)
    mesh = replace(mesh, colours=np.repeat(look(mesh.vertices)[:, None], 3, axis=1).astype(np.uint8))
    found = textured(mesh, load, true_depths(scene, load), VOXEL, 1024).texture
    assert found is not None and found.image.shape[1] == 1024
    np.testing.assert_array_equal(found.vertices[found.triangles], mesh.triangles)
    points = np.einsum("k,fkd->fd", weights, mesh.vertices[mesh.triangles])
    errors = np.abs(sampled(found, weights) - look(points))
    assert np.median(errors) < 2.0 and np.percentile(errors, 99.0) < 10.0


def test_hidden_triangles_do_not_show_what_hides_them() -> None:
    """A ball before a plane, with colours of its own: the plane is shown by images that see it."""
    ball = sphere((0.3, 0.0, 2.5), 0.4)
    scene = build_dense_scene(plane((0.0, 0.0, 1.0), 4.0), ball, camera=FINE)
    load = ViewLoader(scene.images, scene.reconstruction, ViewConfig())
    mesh, depths = grid_mesh(4.0), true_depths(scene, load)
    mesh = replace(mesh, colours=np.repeat(look(mesh.vertices)[:, None], 3, axis=1).astype(np.uint8))
    views, areas = candidate_views(mesh.vertices, mesh.triangles, depths, 2.0 * VOXEL)
    view = select_views(views, areas, adjacent(mesh.triangles))
    centres = mesh.vertices[mesh.triangles].mean(axis=1)
    for i, T in enumerate(scene.reconstruction.Ts_world_cam):
        shown = np.flatnonzero(view == i)
        rays = (centres[shown] - T[:3, 3]) @ T[:3, :3]
        seen = scene.depths(T, rays / rays[:, 2:])
        assert np.mean(np.abs(seen - rays[:, 2]) < 2.0 * VOXEL) > 0.97  # but for corners beside the outline
    found = textured(mesh, load, depths, VOXEL, 1024).texture
    assert found is not None
    assert np.percentile(np.abs(sampled(found, (1 / 3, 1 / 3, 1 / 3)) - look(centres)), 95.0) < 12.0


def test_exposures_are_levelled() -> None:
    """One image is half as bright: the texture has the brightness of the points everywhere."""
    scene = build_dense_scene(plane((0.0, 0.0, 1.0), 4.0), camera=FINE)
    read = scene.images.read
    darker = replace(scene.images, read=lambda i: (read(i) * (0.6 if i == 2 else 1.0)).astype(np.uint8))
    load = ViewLoader(darker, scene.reconstruction, ViewConfig())
    mesh = grid_mesh(4.0)
    mesh = replace(mesh, colours=np.repeat(look(mesh.vertices)[:, None], 3, axis=1).astype(np.uint8))
    found = textured(mesh, load, true_depths(scene, load), VOXEL, 1024).texture
    assert found is not None
    centres = mesh.vertices[mesh.triangles].mean(axis=1)
    expected = look(centres)
    ratio = (sampled(found, (1 / 3, 1 / 3, 1 / 3)) / np.maximum(expected, 1.0))[expected > 60.0]
    assert np.percentile(ratio, 2.0) > 0.9 and np.percentile(ratio, 98.0) < 1.1


def test_triangles_that_no_image_shows_have_the_colours_of_their_vertices() -> None:
    scene = build_dense_scene(plane((0.0, 0.0, 1.0), 4.0), camera=FINE)
    load = ViewLoader(scene.images, scene.reconstruction, ViewConfig())
    mesh = grid_mesh(3.0, (0.3, 0.3))  # a metre before the surface
    colours = np.random.default_rng(0).integers(90, 170, mesh.colours.shape, dtype=np.uint8)  # b + c − a is a colour
    mesh = replace(mesh, colours=colours)
    found = textured(mesh, load, true_depths(scene, load), VOXEL, 128).texture
    assert found is not None
    for k, weights in enumerate(np.eye(3)):
        np.testing.assert_array_equal(sampled(found, tuple(weights)), colours[mesh.triangles[:, k], 0])
    middle = sampled(found, (0.0, 0.5, 0.5))
    np.testing.assert_allclose(middle, colours[mesh.triangles[:, 1:], 0].mean(axis=1), atol=1e-9)


def test_a_texture_that_is_too_small_reduces_the_images() -> None:
    scene = build_dense_scene(plane((0.0, 0.0, 1.0), 4.0), camera=FINE)
    load = ViewLoader(scene.images, scene.reconstruction, ViewConfig())
    depths = true_depths(scene, load)
    small = textured(grid_mesh(4.0), load, depths, VOXEL, 128).texture
    assert small is not None and max(small.image.shape) <= 128
    hidden = grid_mesh(3.0)  # a patch of 2 × 2 px for each of 5280 triangles
    assert textured(hidden, load, depths, VOXEL, 128).texture is None


def test_neighbours_have_an_edge_in_common() -> None:
    np.testing.assert_array_equal(np.sort(adjacent(SQUARE), axis=1), [[0, 1]])
    assert len(adjacent(np.array([[0, 1, 2], [2, 3, 4]]))) == 0  # a corner alone
    assert len(adjacent(np.zeros((0, 3), np.int64))) == 0


def test_a_neighbour_decides_between_images_that_are_nearly_as_good() -> None:
    views = np.array([[0, 1], [0, 1]])
    pairs = adjacent(SQUARE)
    assert select_views(views, np.array([[100.0, 0.0], [90.0, 100.0]], np.float32), pairs).tolist() == [0, 0]
    assert select_views(views, np.array([[100.0, 10.0], [10.0, 100.0]], np.float32), pairs).tolist() == [0, 1]
    alone = np.array([[-1, -1], [3, -1]])
    assert select_views(alone, np.array([[0.0, 0.0], [5.0, 0.0]], np.float32), pairs).tolist() == [-1, 3]


def test_what_a_depth_map_says_of_points() -> None:
    camera = Pinhole(20, 10, np.array([[10.0, 0.0, 9.5], [0.0, 10.0, 4.5], [0.0, 0.0, 1.0]]))
    inverse_depth = np.full((10, 20), 0.5, np.float32)
    inverse_depth[:, 12:] = 0.0
    depth = PosedDepth(camera, np.eye(4), inverse_depth)
    points = np.array(
        [[0.0, 0.0, 2.0], [0.0, 0.0, 2.05], [0.0, 0.0, 3.0], [0.0, 0.0, 1.0], [0.9, 0.0, 2.0], [0, 0, -2.0]]
    )
    pixels, says = agreement(depth, points, 0.1)
    assert says.tolist() == [1, 1, -1, -1, 0, -1]
    np.testing.assert_allclose(pixels[4], [14.0, 4.5])
    assert agreement(depth, np.array([[5.0, 0.0, 2.0]]), 0.1)[1].tolist() == [-1]  # outside the image


@given(st.lists(st.tuples(st.integers(1, 60), st.integers(1, 60)), min_size=1, max_size=40))
def test_packed_rectangles_do_not_overlap(sizes: list[tuple[int, int]]) -> None:
    corners, height = pack(np.array(sizes), 64)
    covered = np.zeros((height, 64), np.int64)
    for (x, y), (w, h) in zip(corners.tolist(), sizes, strict=True):
        assert 0 <= x <= 64 - w and 0 <= y <= height - h
        covered[y : y + h, x : x + w] += 1
    assert covered.max() == 1
