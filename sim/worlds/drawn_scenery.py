"""The visible surfaces of a world as textured triangles of limited size, for drawings outside MuJoCo."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.scenery import TexturedMesh
from dronevio.sim.appearance.scenery import Page, reduced_image
from dronevio.sim.worlds.layout import Mirror

MAX_PIXELS = 320_000
"""Largest number of pixels of all textures of a world."""
MAX_CUTOUTS = 5000
"""Number of quadrangles of a page above which only some of them are drawn, which are larger."""
MARGIN_M = 2.0
"""Width of the strip around a flight space in which trees are drawn [m]."""
_MIN_REDUCTION = 4


def cut_pages(pages: Sequence[Page], low: Array, high: Array) -> list[Page]:
    """Return pages without the quadrangles that would hide a flight space from a viewpoint outside, such as tree tops.

    Args:
        pages: The pages.
        low: (3,) Lower corner of the flight space [m].
        high: (3,) Upper corner of the flight space [m]; quadrangles above are left out.
    """
    margin = np.array([MARGIN_M, MARGIN_M, 0.0])
    cut = []
    for page in pages:
        middle = page.vertices.reshape(-1, 4, 3).mean(axis=1)
        inside = np.all((middle[:, :2] > (low - margin)[:2]) & (middle[:, :2] < (high + margin)[:2]), axis=1)
        rows = np.repeat(inside & (middle[:, 2] < high[2]), 4)
        cut.append(Page(page.texture, page.vertices[rows], page.texture_coordinates[rows], page.normals[rows]))
    return cut


def drawn_pages(pages: Sequence[Page], max_pixels: int = MAX_PIXELS) -> tuple[TexturedMesh, ...]:
    """Return the pages of a world with smaller textures.

    Args:
        pages: Pages at full resolution.
        max_pixels: Largest number of pixels of all textures.
    """
    pixels = sum(page.texture.shape[0] * page.texture.shape[1] for page in pages)
    factor = max(_MIN_REDUCTION, int(np.ceil(np.sqrt(pixels / max_pixels))))
    return tuple(_drawn(page, factor) for page in pages)


def drawn_mirror(mirror: Mirror, texture: npt.NDArray[np.uint8]) -> TexturedMesh:
    """Return a reflecting floor with a smaller texture (H, W, 3), without reflections."""
    face = mirror.face
    corners = np.stack([face.corner, face.corner + face.right, face.corner + face.right + face.down])
    corners = np.concatenate([corners, [face.corner + face.down]])
    whole = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
    factor = max(_MIN_REDUCTION, int(np.ceil(np.sqrt(texture[..., 0].size / MAX_PIXELS))))
    return _drawn(Page(texture, corners, whole, np.repeat([[0.0, 0.0, 1.0]], 4, axis=0)), factor)


def _drawn(page: Page, factor: int) -> TexturedMesh:
    """Return a page with a texture that is smaller by a factor, and without too many quadrangles."""
    corners, on_page = page.vertices.reshape(-1, 4, 3), page.texture_coordinates.reshape(-1, 4, 2)
    every = -(-len(corners) // MAX_CUTOUTS) or 1
    if every > 1:  # of foliage: as much of the view is covered
        corners, on_page = corners[::every], on_page[::every]
        middle = corners.mean(axis=1, keepdims=True)
        corners = middle + np.sqrt(every) * (corners - middle)
    numbers = np.arange(4 * len(corners), dtype=np.uint32).reshape(-1, 4)
    return TexturedMesh(
        corners.reshape(-1, 3).astype(np.float32),
        on_page.reshape(-1, 2).astype(np.float32),
        np.concatenate([numbers[:, [0, 2, 1]], numbers[:, [0, 3, 2]]]),
        reduced_image(page.texture, factor),
    )
