"""Maps from above: planes and boxes by hand, and the colours of points."""

import numpy as np
import pytest

from dronevio.estimator.dense import overhead
from dronevio.estimator.dense.overhead import overhead_map
from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.surfaces import Mesh, PointCloud

NO_POINTS = PointCloud(np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3), np.uint8))


def mesh_of(vertices: Array, triangles: list[tuple[int, int, int]], colours: Array | None = None) -> Mesh:
    normals = np.repeat([[0.0, 0.0, 1.0]], len(vertices), axis=0)
    found = np.full((len(vertices), 3), 100) if colours is None else colours
    return Mesh(vertices, normals, found.astype(np.uint8), np.array(triangles, np.int64).reshape(-1, 3))


def ground(z: float, low: float, high: float) -> tuple[Array, list[tuple[int, int, int]]]:
    corners = np.array([[low, low, z], [high, low, z], [high, high, z], [low, high, z]])
    return corners, [(0, 1, 2), (0, 2, 3)]


@pytest.mark.parametrize("samples", [1 << 22, 50], ids=["at once", "in parts"])
def test_a_tilted_plane_is_exact(samples: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten thousand random triangles of the plane z = 0.3 x − 0.2 y + 5, with colours that change along x."""
    monkeypatch.setattr(overhead, "_SAMPLES", samples)
    xy = np.random.default_rng(0).uniform(-2.0, 3.0, (60, 2))
    xy = np.concatenate([xy, [[-2, -2], [3, -2], [3, 3], [-2, 3]]])
    from scipy.spatial import Delaunay

    z = 0.3 * xy[:, 0] - 0.2 * xy[:, 1] + 5.0
    colours = np.repeat((40.0 * (xy[:, :1] + 2.0)), 3, axis=1)
    triangles = Delaunay(xy).simplices.tolist()
    view = overhead_map(NO_POINTS, mesh_of(np.column_stack([xy, z]), triangles, colours), 0.1)
    assert view.heights.shape == (50, 50) and view.west_north == pytest.approx((-2.0, 3.0))
    row, column = np.mgrid[:50, :50]
    x, y = -2.0 + 0.1 * (column + 0.5), 3.0 - 0.1 * (row + 0.5)
    np.testing.assert_allclose(view.heights, 0.3 * x - 0.2 * y + 5.0, atol=1e-5)
    assert np.abs(view.colours[..., 1] - 40.0 * (x + 2.0)).max() < 2.0  # rounded at the vertices


@pytest.mark.parametrize("samples", [1 << 22, 50], ids=["at once", "in parts"])
@pytest.mark.parametrize("order", [1, -1])
def test_the_highest_surface_is_seen(order: int, samples: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A roof of 2 × 2 at height 3 above ground of 10 × 10 at height 1, whatever comes first; a wall is not seen."""
    monkeypatch.setattr(overhead, "_SAMPLES", samples)
    low, faces = ground(1.0, 0.0, 10.0)
    high, _ = ground(3.0, 4.0, 6.0)
    wall = np.array([[4.25, 4.25, 1.0], [5.75, 4.25, 1.0], [5.75, 4.25, 9.0]])  # through centres of cells
    triangles = [*faces, *((a + 4, b + 4, c + 4) for a, b, c in faces), (8, 9, 10)]
    view = overhead_map(NO_POINTS, mesh_of(np.concatenate([low, high, wall]), triangles[::order]), 0.5)
    assert (view.heights == 3.0).sum() == 16 and (view.heights == 1.0).sum() == 400 - 16
    assert (view.heights[8:12, 8:12] == 3.0).all()


def test_north_is_up_and_cells_without_a_surface_are_empty() -> None:
    corners = np.array([[0.0, 0.0, 1.0], [4.0, 0.0, 1.0], [4.0, 4.0, 2.0], [9.0, 9.0, 9.0]])
    view = overhead_map(NO_POINTS, mesh_of(corners, [(0, 1, 2)]), 1.0)
    assert view.heights.shape == (4, 4)  # a vertex without a triangle does not extend the map
    expected = np.array(
        [[False, False, False, True], [False, False, True, True], [False, True, True, True], [True] * 4]
    )
    assert (np.isfinite(view.heights) == expected).all()
    assert (view.colours[~expected] == 0).all()


def test_points_near_the_surface_give_the_colour() -> None:
    corners, triangles = ground(1.0, 0.0, 2.0)
    points = np.array([[0.5, 1.5, 1.1], [0.6, 1.4, 0.9], [1.5, 1.5, 9.0], [7.0, 1.0, 1.0]])
    colours = np.array([[10, 20, 30], [20, 40, 60], [1, 1, 1], [2, 2, 2]], np.uint8)
    cloud = PointCloud(points, np.zeros_like(points), colours)
    view = overhead_map(cloud, mesh_of(corners, triangles), 1.0)
    np.testing.assert_array_equal(view.colours[0, 0], [15, 30, 45])
    assert (view.colours[0, 1] == 100).all() and (view.colours[1] == 100).all()


def test_large_maps_have_larger_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(overhead, "LARGEST_SIDE", 20)
    corners, triangles = ground(1.0, 0.3, 10.0)
    view = overhead_map(NO_POINTS, mesh_of(corners, triangles), 0.001)
    assert max(view.heights.shape) <= 20 and np.isfinite(view.heights).mean() > 0.9
    with pytest.raises(ConfigError, match="without triangles"):
        overhead_map(NO_POINTS, mesh_of(corners, []), 1.0)
