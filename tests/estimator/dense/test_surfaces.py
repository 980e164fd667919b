"""Consistency of depth maps, their fusion, signed distances and meshes, and the whole of multi-view stereo."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dronevio.estimator.array_store import ArrayStore
from dronevio.estimator.dense import fusion
from dronevio.estimator.dense.config import ConsistencyConfig, DenseConfig, DepthConfig, MeshConfig
from dronevio.estimator.dense.consistency import PosedDepth, consistent_depth
from dronevio.estimator.dense.fusion import fuse, surface_normals
from dronevio.estimator.dense.meshing.mesh import build_mesh, vertex_normals, without_small_parts
from dronevio.estimator.dense.meshing.tsdf import integrate, pixel_size
from dronevio.estimator.dense.pipeline import DenseResult, densify, estimate_depths
from dronevio.estimator.dense.views import ViewLoader
from dronevio.models.depth import Pinhole
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.surfaces import PointCloud

Scene = Any  # the class of conftest, which cannot be imported

CAMERA = Pinhole(40, 30, np.array([[40.0, 0.0, 19.5], [0.0, 40.0, 14.5], [0.0, 0.0, 1.0]]))
SMALL = DenseConfig(depth=DepthConfig(levels=2), mesh=MeshConfig(min_triangles=20))


def facing(x: float, depth: float = 2.0) -> PosedDepth:
    """Return the depth map of a wall z = 2 or at another depth, from a position along x."""
    T = np.eye(4)
    T[0, 3] = x
    return PosedDepth(CAMERA, T, np.full((30, 40), 1.0 / depth, np.float32))


@pytest.fixture(scope="module")
def surfaces(slanted: Scene) -> DenseResult:
    """The surfaces of the slanted plane."""
    return densify(slanted.images, slanted.reconstruction, SMALL)


def test_depths_that_others_confirm_are_kept() -> None:
    found, count = consistent_depth(facing(0.0), [facing(0.1), facing(-0.1)], ConsistencyConfig())
    inside = (slice(None), slice(2, 38))  # a shift by 0.1 is two pixels
    np.testing.assert_allclose(found[inside], 0.5, rtol=1e-5)
    assert count[inside].min() == 2
    assert not found[:, 0].any()  # seen by one other image only


def test_wrong_depths_are_dropped() -> None:
    wrong = facing(0.0)
    wrong.inverse_depth[10:20, 10:20] = 1.0 / 2.5
    found, _ = consistent_depth(wrong, [facing(0.1), facing(-0.1)], ConsistencyConfig())
    assert not found[10:20, 10:20].any()
    assert found[:, 2:38].astype(bool).sum() == 30 * 36 - 100


def test_weighted_means_of_depths_by_hand() -> None:
    behind = facing(0.0, 3.02)
    behind.T_world_cam[2, 3] = -1.0  # sees the wall at 2.02 from 1 behind
    found, _ = consistent_depth(facing(0.0), [behind], ConsistencyConfig(min_views=1))
    weights = np.array([1.0 / 2.0, 1.0 / 3.02]) ** 2
    assert found[15, 20] == pytest.approx(np.average([1.0 / 2.0, 1.0 / 2.02], weights=weights), rel=1e-4)


def test_normals_are_those_of_the_surface() -> None:
    n = np.array([0.0, -0.6, -0.8])
    inverse_depth = CAMERA.rays() @ n / -1.6  # of the plane n · X = −1.6
    inverse_depth[10, 10:12] = 0.0
    normals = surface_normals(PosedDepth(CAMERA, np.eye(4), inverse_depth.astype(np.float32)))
    known = inverse_depth > 0.0
    np.testing.assert_allclose(normals[known], np.broadcast_to(n, normals[known].shape), atol=2e-3)
    assert np.isnan(normals[~known]).all()


def test_fused_points_have_their_spacing_and_colours() -> None:
    image = np.zeros((30, 40, 3), np.uint8)
    image[:, :, 0] = 200
    cloud = fuse([(facing(0.0), image), (facing(0.1), image)], spacing=0.1)
    np.testing.assert_allclose(cloud.points[:, 2], 2.0, atol=1e-6)
    np.testing.assert_allclose(cloud.normals, [[0.0, 0.0, -1.0]] * len(cloud), atol=1e-6)
    assert (cloud.colours == [200, 0, 0]).all()
    assert len(np.unique(np.floor(cloud.points[:, :2] / 0.1), axis=0)) == len(cloud)
    width, height = 2.1, 1.5  # of the wall that both see, at two metres
    assert 0.8 < len(cloud) * 0.1**2 / (width * height) < 1.2


def sphere_depths() -> list[PosedDepth]:
    """Return depth maps of the unit ball from all sides."""
    camera = Pinhole(120, 120, np.array([[150.0, 0.0, 59.5], [0.0, 150.0, 59.5], [0.0, 0.0, 1.0]]))
    depths = []
    for direction in [*np.eye(3), *-np.eye(3), *(np.array([[1, 1, 1], [-1, 1, 1], [1, -1, 1], [1, 1, -1]]) / 3**0.5)]:
        z = -direction
        x = np.cross(z, [0.36, 0.48, 0.8])
        x /= np.linalg.norm(x)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), 3.0 * direction
        rays = camera.rays().astype(np.float64) @ T[:3, :3].T
        a, b = (rays**2).sum(axis=-1), rays @ T[:3, 3]
        inside = b * b - 8.0 * a
        t = (-b - np.sqrt(np.maximum(inside, 0.0))) / a
        depths.append(PosedDepth(camera, T, np.where(inside > 0.05, 1.0 / t, 0.0).astype(np.float32)))
    return depths


def test_the_mesh_of_a_ball_is_closed_and_round() -> None:
    depths = sphere_depths()
    nothing = PointCloud(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    mesh = build_mesh(integrate(depths, MeshConfig(voxel=0.06)), nothing, 100)
    radius = np.linalg.norm(mesh.vertices, axis=1)
    assert abs(radius.mean() - 1.0) < 0.01
    assert np.abs(radius - 1.0).max() < 0.03
    assert np.sum(mesh.normals * mesh.vertices, axis=1).min() > 0.8  # outward
    edges = np.sort(mesh.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    assert (count == 2).all()


def test_voxels_are_larger_if_there_are_too_many() -> None:
    volume = integrate(sphere_depths(), MeshConfig(voxel=0.02, max_voxels=100_000))
    assert volume.distances.size <= 100_000
    assert volume.voxel > 0.02


def test_pixel_size_by_hand() -> None:
    assert pixel_size([facing(0.0)]) == pytest.approx(2.0 / 40.0)
    assert pixel_size([]) == 1.0


def test_small_parts_are_removed() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [5, 0, 0], [6, 0, 0], [5, 1, 0]], float)
    triangles = np.array([[0, 1, 2], [1, 3, 2], [4, 5, 6]])
    kept, faces = without_small_parts(vertices, triangles, 2)
    np.testing.assert_array_equal(kept, vertices[:4])
    np.testing.assert_array_equal(faces, triangles[:2])
    np.testing.assert_allclose(vertex_normals(kept, faces), [[0.0, 0.0, 1.0]] * 4)


def test_points_and_mesh_lie_on_the_plane(surfaces: DenseResult) -> None:
    n = np.array([0.0, 0.5**0.5, 0.5**0.5])
    for points in (surfaces.cloud.points, surfaces.mesh.vertices):
        distance = np.abs(points @ n - 2.0)
        assert np.median(distance) < 0.012  # at distances of 1.5 to 5
        assert np.mean(distance < 0.04) > 0.97
    assert np.median(surfaces.cloud.normals @ -n) > 0.99
    assert len(surfaces.mesh.triangles) > 1000


def test_the_same_input_gives_the_same_surfaces(slanted: Scene, surfaces: DenseResult, tmp_path: Path) -> None:
    again = densify(slanted.images, slanted.reconstruction, replace(SMALL, threads=1), store=ArrayStore(tmp_path))
    np.testing.assert_array_equal(again.cloud.points, surfaces.cloud.points)
    np.testing.assert_array_equal(again.mesh.vertices, surfaces.mesh.vertices)
    # An interrupted computation continues with the depth maps that are complete.
    stored = {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    assert sorted(stored) == [f"depth-{k:06d}.npz" for k in range(5)]
    damaged = tmp_path / "depth-000002.npz"
    damaged.write_bytes(damaged.read_bytes()[:1000])
    continued = densify(slanted.images, slanted.reconstruction, SMALL, store=ArrayStore(tmp_path))
    assert {path.name for path in tmp_path.iterdir() if path.stat().st_mtime_ns != stored[path.name]} == {damaged.name}
    np.testing.assert_array_equal(continued.cloud.points, surfaces.cloud.points)


def test_stored_depths_belong_to_their_input(slanted: Scene, tmp_path: Path) -> None:
    config = replace(SMALL, depth=DepthConfig(levels=2, directions=0))
    neighbours = [np.array([1]), *[np.empty(0, np.int64)] * 4]  # one depth map

    def key(reconstruction: Reconstruction, settings: DenseConfig) -> str:
        load = ViewLoader(slanted.images, reconstruction, settings.views)
        estimate_depths(load, reconstruction, neighbours, settings, store=ArrayStore(tmp_path))
        with np.load(tmp_path / "depth-000000.npz") as file:
            return str(file["key"])

    Ts_moved = slanted.reconstruction.Ts_world_cam.copy()
    Ts_moved[1, 0, 3] += 1e-9
    first = key(slanted.reconstruction, config)
    assert key(slanted.reconstruction, config) == first
    assert key(replace(slanted.reconstruction, Ts_world_cam=Ts_moved), config) != first
    assert key(slanted.reconstruction, replace(config, depth=replace(config.depth, window_px=9))) != first


def test_points_do_not_depend_on_the_slabs(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    depths = sphere_depths()
    images = [rng.integers(0, 256, (120, 120, 3), dtype=np.uint8) for _ in depths]
    whole = fuse(zip(depths, images, strict=True), 0.02)
    monkeypatch.setattr(fusion, "_SLAB", 3)
    monkeypatch.setattr(fusion, "_MIN_PENDING", 100)
    divided = fuse(zip(depths, images, strict=True), 0.02)
    np.testing.assert_allclose(divided.points, whole.points, atol=1e-5)
    np.testing.assert_allclose(divided.normals, whole.normals, atol=1e-4)
    assert np.abs(divided.colours.astype(int) - whole.colours).max() <= 1
