"""Texture of a mesh from the images that it was made from.

Each triangle is shown by one image (`view_selection`). Connected triangles of one image are a chart: its rectangle is
copied from the undistorted image into the texture. Images are brought to the brightness that the points of the scene
have on average. Triangles that no image shows have the colours of their vertices, in patches of two by two pixels.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from dronevio.estimator.dense.config import ViewConfig
from dronevio.estimator.dense.consistency import PosedDepth
from dronevio.estimator.dense.meshing.atlas import pack
from dronevio.estimator.dense.meshing.view_selection import (
    adjacent,
    agreement,
    candidate_views,
    projected,
    select_views,
)
from dronevio.estimator.dense.views import ViewLoader
from dronevio.models.arrays import Array, Image
from dronevio.models.progress import Progress, silent
from dronevio.models.surfaces import Mesh, Texture

Indices = npt.NDArray[np.int64]

TOLERANCE_VOXELS = 2.0
"""Largest distance of a visible vertex from the surface of a depth map, in voxels of the mesh."""
_BORDER_PX = 2  # around the corners of a chart
_GAIN_BOUNDS = (0.5, 2.0)
_SCALE_STEP = 0.9  # by which images are reduced until their charts fit
_NO_VIEW = -1


@dataclass(frozen=True, eq=False)
class _Charts:
    """Connected triangles that one image shows, C charts with T corners."""

    view: Indices
    """(C,) Image of each chart."""
    corner_chart: Indices
    """(T,) Chart of each corner."""
    corner_vertex: Indices
    """(T,) Vertex of each corner."""
    triangles: Indices
    """(N,) Indices of the triangles that have a chart."""
    corners: Indices
    """(N, 3) Corners of these triangles."""


def textured(
    mesh: Mesh,
    load: ViewLoader,
    depths: Sequence[PosedDepth],
    voxel: float,
    side_px: int,
    progress: Progress = silent,
) -> Mesh:
    """Return a mesh with a texture from the images.

    Args:
        mesh: The mesh.
        load: Returns undistorted images, also larger ones than those of the depth maps.
        depths: (I,) Consistent depth maps of the images.
        voxel: Side of the voxels of the mesh.
        side_px: Largest width and height of the texture [px].
        progress: Called with the number of images that have been copied.

    Raises:
        InputError: An image cannot be read.
    """
    if not len(mesh.triangles):
        return mesh
    tolerance = TOLERANCE_VOXELS * voxel
    views, areas = candidate_views(mesh.vertices, mesh.triangles, depths, tolerance)
    pairs = adjacent(mesh.triangles)
    view = select_views(views, areas, pairs)
    charts = _charts(mesh.triangles, view, pairs)
    bare = np.flatnonzero(view == _NO_VIEW)
    # The largest images whose charts fit beside the patches of bare triangles
    patches = 2 * (side_px // 2)
    rows_of_patches = 2 * -(-2 * len(bare) // patches)
    for large in _reduced(load):
        pixels, lows, sizes = _rectangles(mesh.vertices, charts, large, depths)
        if sizes.max(initial=0) > side_px:
            continue
        corners, height = pack(sizes, side_px)
        if height + rows_of_patches <= side_px:
            break
    image = np.zeros((height + rows_of_patches, side_px, 3), np.uint8)
    by_view = np.argsort(charts.view, kind="stable")
    bounds = np.searchsorted(charts.view[by_view], np.arange(len(depths) + 1))
    for i, depth in enumerate(depths):
        own = by_view[bounds[i] : bounds[i + 1]]
        if len(own):
            colours = _matched(large.read(i), load(i).colours, depth, mesh, tolerance)
            for n in own.tolist():
                _copy(image, colours, corners[n], lows[n], sizes[n])
        progress(i + 1, len(depths))
    chart_pixels = pixels - lows[charts.corner_chart] + corners[charts.corner_chart]
    bare_pixels = _paint_patches(image[height:], mesh.colours[mesh.triangles[bare]]) + [0.0, height]
    triangles = np.empty_like(mesh.triangles)
    triangles[charts.triangles] = charts.corners
    triangles[bare] = len(chart_pixels) + np.arange(3 * len(bare)).reshape(-1, 3)
    texture = Texture(
        image=image,
        pixels=np.concatenate([chart_pixels, bare_pixels]),
        vertices=np.concatenate([charts.corner_vertex, mesh.triangles[bare].ravel()]),
        triangles=triangles,
    )
    return replace(mesh, texture=texture)
