"""Geometry of the plots of the book's experiments."""

import numpy as np

from dronevio.book.sfm_plots import frustum


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
