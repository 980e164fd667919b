"""Geometry of the plots of the book's experiments."""

import re

import numpy as np
import pytest

from dronevio.book.sfm_page import sfm_page, sfm_scene
from dronevio.book.sfm_plots import frustum
from dronevio.estimator.book.sfm import SfmExperiment, run_sfm_experiment


def test_frustum_spans_from_the_camera_to_the_image_plane() -> None:
    T = np.eye(4)
    T[:3, 3] = [1.0, 2.0, 3.0]
    edges = frustum(T, focal_px=100.0, width_px=80, height_px=60, depth=0.5)
    assert edges.shape == (8, 2, 3)
    np.testing.assert_allclose(edges[:4, 0], np.broadcast_to(T[:3, 3], (4, 3)))
    corners = edges[:4, 1] - T[:3, 3]
    np.testing.assert_allclose(100.0 * corners[:, :2] / corners[:, 2:], [[-40, -30], [40, -30], [40, 30], [-40, 30]])
    np.testing.assert_allclose(edges[4:, 0], edges[:4, 1])
    np.testing.assert_allclose(edges[4:, 1], np.roll(edges[:4, 1], -1, axis=0))


@pytest.fixture(scope="module")
def villa() -> SfmExperiment:
    """The adjusted reconstruction."""
    return run_sfm_experiment(np.random.default_rng(0))


def test_scene_has_a_dot_for_each_point_and_a_number_at_each_camera(villa: SfmExperiment) -> None:
    scene = sfm_scene(villa)
    before, cameras_before, *dots, cameras = scene.paths
    assert len(cameras.points) == len(cameras_before.points) == 5 * 8 * 2
    assert 400 < len(before.points) / 2 == sum(len(path.points) for path in dots) / 2 <= 544
    assert all(np.array_equal(path.points[::2], path.points[1::2]) for path in [before, *dots])
    assert [mark.text for mark in scene.marks] == list("12345")
    # The frame is that of the first camera but for a translation, with distances as in the reconstruction.
    places = np.stack([mark.point for mark in scene.marks])
    R_world_view = villa.Ts_world_cam[0, :3, :3] @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    moved = villa.Ts_world_cam[:, :3, 3] - villa.Ts_world_cam[0, :3, 3]
    np.testing.assert_allclose((places - places[0]) @ R_world_view.T, moved, atol=1e-9)
    every = np.concatenate([path.points for path in (*dots, cameras)])
    assert np.linalg.norm(every[:, :2], axis=1).max() < scene.half_width_m  # at every rotation


def test_colours_of_the_dots_are_those_of_the_points(villa: SfmExperiment) -> None:
    dots = sfm_scene(villa).paths[2:-1]
    colours = [[int(path.style[i : i + 2], 16) for i in (9, 11, 13)] for path in dots]  # stroke: #rrggbb
    counts = [len(path.points) // 2 for path in dots]
    np.testing.assert_allclose(np.average(colours, axis=0, weights=counts), villa.colours.mean(axis=0), atol=10.0)
    everywhere = np.concatenate([np.repeat([c], n, axis=0) for c, n in zip(colours, counts, strict=True)])
    np.testing.assert_allclose(everywhere.std(axis=0), villa.colours.std(axis=0), rtol=0.15)


def test_page_refers_to_no_other_file(villa: SfmExperiment) -> None:
    page = sfm_page(villa)
    assert "125.5" in page and 'svg class="spatial"' in page and "keydown" in page
    assert not re.findall(r"""(?:src|href)=|https?://|url\(|@import""", page)
