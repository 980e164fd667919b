"""Surfaces of worlds for drawings: their size, their position, and the side from which they are visible."""

import numpy as np
import pytest

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.scenery import TexturedMesh
from dronevio.sim.world import _painted, moving_scenery, scenery_of
from dronevio.sim.worlds.drawn_scenery import MARGIN_M, MAX_CUTOUTS, MAX_PIXELS


def corners(meshes: tuple[TexturedMesh, ...]) -> Array:
    """Return the corners (F, 3, 3) of the triangles of meshes."""
    return np.concatenate([mesh.vertices[mesh.triangles] for mesh in meshes]).astype(np.float64)


def normals(triangles: Array) -> Array:
    """Return the unit normals (F, 3) of triangles (F, 3, 3) on the side from which they are counterclockwise."""
    found = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return np.asarray(found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-12))


@pytest.mark.parametrize("name", ["room", "forest"])
@pytest.mark.slow
def test_size_is_limited(name: str) -> None:
    scenery = scenery_of(name, 0)
    pixels = sum(mesh.texture.shape[0] * mesh.texture.shape[1] for mesh in scenery.meshes)
    assert 0.6 * MAX_PIXELS < pixels < 1.05 * MAX_PIXELS
    assert all(0 < len(mesh.triangles) <= 2 * MAX_CUTOUTS for mesh in scenery.meshes)
    size = sum(a.nbytes for mesh in scenery.meshes for a in vars(mesh).values())
    assert size < 3e6  # in memory; files are compressed


@pytest.mark.slow
def test_walls_floor_and_ceiling_are_visible_from_inside_only() -> None:
    triangles = corners(scenery_of("room", 0).meshes)
    layout = _painted("room", 0, 0)[0]
    for axis in range(3):
        for bound, sign in ((layout.low, 1.0), (layout.high, -1.0)):
            on_bound = np.all(np.abs(triangles[:, :, axis] - bound[axis]) < 1e-6, axis=1)
            assert on_bound.any()
            assert np.all(sign * normals(triangles[on_bound])[:, axis] > 0.999)


def test_textures_are_upright() -> None:
    """The landing pad is where it is painted: its texture is that of the page at full resolution."""
    page, mesh = _painted("room", 0, 0)[1].pages[0], scenery_of("room", 0).meshes[0]
    np.testing.assert_allclose(mesh.texture_coordinates, page.texture_coordinates, atol=1e-6)
    np.testing.assert_allclose(mesh.vertices, page.vertices, atol=1e-5)
    height, width = (round(n / 10) for n in page.texture.shape[:2])
    assert np.allclose(mesh.texture.shape[:2], (height, width), rtol=0.3)
    assert np.allclose(mesh.texture.mean(axis=(0, 1)), page.texture.mean(axis=(0, 1)), atol=1.0)


@pytest.mark.slow
def test_tree_tops_do_not_hide_the_flight_space() -> None:
    layout, appearance = _painted("forest", 0, 0)
    foliage = len(layout.prints)
    drawn = scenery_of("forest", 0).meshes[:foliage]
    assert foliage == 2 and sum(len(p.vertices) for p in appearance.pages[:foliage]) > 60_000
    middles = corners(drawn).mean(axis=1)
    assert np.all(middles[:, 2] < layout.high[2] + 1.0)
    assert np.all(np.abs(middles[:, :2]) < layout.high[:2] + MARGIN_M + 1.0)


def test_moving_objects_have_surfaces_in_their_own_frame() -> None:
    found = moving_scenery("moving", 0)
    assert len(found) > 3
    for mover, meshes in found:
        assert mover.poses(np.zeros(1)).shape == (1, 4, 4)
        assert np.abs(corners(meshes)).max() < 10.0


def test_unknown_worlds_are_refused() -> None:
    for function in (scenery_of, moving_scenery):
        with pytest.raises(ConfigError, match="unknown world 'moon'"):
            function("moon", 0)
