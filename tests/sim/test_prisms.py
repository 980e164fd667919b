"""Prisms: collision boxes, lateral surfaces, and their lightmaps and textures."""

import numpy as np
import pytest

from dronevio.models.arrays import Image
from dronevio.sim.appearance.cutouts import Cutouts, Print, joined
from dronevio.sim.appearance.lightmap import AreaLight, bake
from dronevio.sim.appearance.prisms import lateral_surface, prism_boxes
from dronevio.sim.appearance.scenery import facing, paint_pages
from dronevio.sim.appearance.solids import Face, Sheet, size_m
from dronevio.sim.paths.space import Space


def ramp(rng: np.random.Generator, height: int, width: int) -> Image:
    """Return an image whose red grows to the right, and green downward."""
    image = np.zeros((height, width, 3), np.uint8)
    image[..., 0] = np.linspace(0, 255, width).astype(np.uint8)
    image[..., 1] = np.linspace(0, 255, height).astype(np.uint8)[:, None]
    return image


@pytest.mark.parametrize("sides", [4, 8, 10, 16])
def test_boxes_cover_exactly_the_prism(sides: int) -> None:
    boxes = prism_boxes(1.3, 0.0, 2.0, sides)
    space = Space(
        np.full(3, -9.0),
        np.full(3, 9.0),
        np.array([box.centre for box in boxes]),
        np.array([box.half for box in boxes]),
        np.array([box.R for box in boxes]),
    )
    points = np.random.default_rng(0).uniform([-1.5, -1.5, 0.5], [1.5, 1.5, 1.5], (4000, 3))
    angle = (np.arange(sides) + 0.5) * 2.0 * np.pi / sides
    normals = np.stack([np.cos(angle), np.sin(angle)])
    beyond = (points[:, :2] @ normals).max(axis=1) - 1.3 * np.cos(np.pi / sides)
    clearance = space.clearance(points)
    np.testing.assert_array_equal(clearance < 0.0, beyond < 0.0)
    near = (beyond > 0.0) & (beyond < 0.05)
    assert clearance[near].max() < 0.1


def test_a_lateral_surface_is_closed_and_faces_outward() -> None:
    grid = lateral_surface(np.array([2.0, 1.0, 0.0]), np.array([0.0, 1.0, 1.0]), 12)
    np.testing.assert_allclose(grid[:, 0], grid[:, -1], atol=1e-12)
    quads = np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]], axis=2).reshape(-1, 4, 3)
    normals = facing(quads)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    assert (np.sum(normals * (quads.mean(axis=1) - [0.0, 0.0, 0.5]), axis=1) > 0.0).all()


def test_a_flat_sheet_equals_a_face() -> None:
    face = Face(np.array([-1.0, 1.0, 0.0]), np.array([2.0, 0.0, 0.0]), np.array([0.0, -2.0, 0.0]), ramp)
    u, v = np.meshgrid(np.linspace(0.0, 1.0, 5), np.linspace(0.0, 1.0, 4))
    sheet = Sheet(face.corner + u[..., None] * face.right + v[..., None] * face.down, ramp)
    assert size_m(sheet) == pytest.approx(size_m(face))
    lamp = AreaLight(np.array([[0.3, 0.2, 1.5]]), 1.0)
    flat, gridded = (bake([surface], [], [lamp])[0] for surface in (face, sheet))
    np.testing.assert_allclose(flat, gridded, rtol=1e-5)
    (page,) = paint_pages([sheet], [gridded], np.random.default_rng(0))
    # The texture at a vertex of the grid is that of the face at the same position
    shape = page.texture.shape
    at = (page.texture_coordinates * [shape[1], shape[0]]).astype(int)
    red = page.texture[np.minimum(at[:, 1], shape[0] - 1), at[:, 0] - 1, 0].astype(float)
    right = (page.vertices[:, 0] + 1.0) / 2.0
    inner = (right > 0.1) & (right < 0.9)
    assert np.corrcoef(red[inner], right[inner])[0, 1] > 0.9


def test_texture_size_follows_the_resolution() -> None:
    faces = [
        Face(np.zeros(3), np.array([2.0, 0.0, 0.0]), np.array([0.0, -1.0, 0.0]), ramp, 1.0, ppm)
        for ppm in (50.0, 100.0)
    ]
    coarse, fine = bake(faces, [], [])
    assert fine.size > 2 * coarse.size
    (page,) = paint_pages(faces, [coarse, fine], np.random.default_rng(0))
    spans = np.ptp(page.texture_coordinates.reshape(2, 4, 2) * page.texture.shape[1::-1], axis=1)
    np.testing.assert_allclose(np.sort(spans[:, 0]), [100.0, 200.0])


def test_cutouts_share_a_texture() -> None:
    grid = lateral_surface(np.array([1.0, 0.0]), np.full(2, 0.5), 8)
    left, right = Cutouts.of_grid(grid, 0.0, 0.5), Cutouts.of_grid(grid + [3.0, 0.0, 0.0], 0.5, 1.0)
    whole = joined([left, right])
    page = Print(ramp, 10, 20, (left, right)).page(np.random.default_rng(0))
    assert page.texture.shape == (10, 20, 3)
    assert len(page.vertices) == 4 * 16
    assert page.texture_coordinates[:32, 0].max() == pytest.approx(0.5)
    assert page.texture_coordinates[32:, 0].min() == pytest.approx(0.5)
    reversed_sides = whole.turned_over()
    np.testing.assert_allclose(facing(reversed_sides.corners), -facing(whole.corners), atol=1e-12)
