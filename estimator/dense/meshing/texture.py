"""Texture of a mesh from the images that it was made from.

Each triangle is shown by one image (`view_selection`). Connected triangles of one image are a chart, whose rectangle is
copied from the undistorted image into the texture. Exposure, white balance and vignetting differ between images: each
neighbourhood is brought to the colour that the points of the scene have on average. Triangles that no image shows have
the colours of their vertices, in patches of two by two pixels.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

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
from dronevio.models.surfaces import Colours, Mesh, Texture

Indices = npt.NDArray[np.int64]

TOLERANCE_VOXELS = 2.0
"""Largest distance of a visible vertex from the surface of a depth map, in voxels of the mesh."""
LEVELLING_SHARE = 0.02
"""Standard deviation of the neighbourhoods whose brightness is levelled, as a share of the longer side of an image."""
GAIN_BOUNDS = (0.5, 2.0)
"""Bounds of the factor on the brightness of a neighbourhood."""
_BORDER_PX = 2  # of a rectangle, around its corners
_MAX_SIDE_PX, _MIN_SIDE_PX = 10_000, 16  # of an undistorted image
_PRIOR_SHARE = 0.01  # weight of the whole image beside a neighbourhood
_REDUCTION = 0.9  # of the images, until their charts fit


@dataclass(frozen=True, eq=False)
class _Charts:
    """Connected triangles that one image shows: C charts with T corners of N triangles."""

    view: Indices
    """(C,) Image of each chart."""
    chart: Indices
    """(T,) Chart of each corner."""
    vertex: Indices
    """(T,) Vertex of each corner."""
    triangles: Indices
    """(N,) Indices of the triangles in the mesh."""
    corners: Indices
    """(N, 3) Their corners."""


@dataclass(frozen=True, eq=False)
class _Layout:
    """Where the charts are in the images and in the texture."""

    load: ViewLoader
    """Returns the images, of the size that fits."""
    pixels: Array
    """(T, 2) Pixels of the corners in their images."""
    low: Indices
    """(C, 2) Upper left pixel of each rectangle in its image."""
    size: Indices
    """(C, 2) Width and height of each rectangle [px]."""
    place: Indices
    """(C, 2) Upper left pixel of each rectangle in the texture."""
    height: int
    """Number of rows of the texture that the charts need."""


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
        load: Returns undistorted images.
        depths: (I,) Consistent depth maps of the images.
        voxel: Side of the voxels of the mesh.
        side_px: Largest width and height of the texture [px]; the images are reduced until it suffices. Where even
            tiny ones do not fit, the mesh stays without a texture.
        progress: Called with the number of images that have been copied.

    Raises:
        InputError: An image cannot be read.
    """
    if not len(mesh.triangles):
        return mesh
    # An image for each triangle, and charts
    tolerance = TOLERANCE_VOXELS * voxel
    views, areas = candidate_views(mesh.vertices, mesh.triangles, depths, tolerance)
    pairs = adjacent(mesh.triangles)
    view = select_views(views, areas, pairs)
    charts = _charts(mesh.triangles, view, pairs)
    bare = np.flatnonzero(view < 0)
    patch_rows = 2 * -(-len(bare) // (side_px // 2))
    layout = _arranged(mesh.vertices, charts, load, depths, side_px, side_px - patch_rows)
    if layout is None:
        return mesh
    # The texture: rectangles of the images, then patches
    image = np.zeros((layout.height + patch_rows, side_px, 3), np.uint8)
    for i, depth in enumerate(depths):
        own = np.flatnonzero(charts.view == i)
        if len(own):
            colours = _levelled(layout.load(i).colours, load(i).colours, depth, mesh, tolerance)
            for n in own.tolist():
                _copy(image, colours, layout.place[n], layout.low[n], layout.size[n])
        progress(i + 1, len(depths))
    bare_pixels = _paint(image[layout.height :], mesh.colours[mesh.triangles[bare]])
    chart_pixels = layout.pixels + (layout.place - layout.low)[charts.chart]
    triangles = np.empty_like(mesh.triangles)
    triangles[charts.triangles] = charts.corners
    triangles[bare] = len(chart_pixels) + np.arange(3 * len(bare)).reshape(-1, 3)
    pixels = np.concatenate([chart_pixels, bare_pixels + [0.0, layout.height]])
    vertices = np.concatenate([charts.vertex, mesh.triangles[bare].ravel()])
    return replace(mesh, texture=Texture(image, pixels, vertices, triangles))


def _charts(triangles: Indices, view: Indices, pairs: Indices) -> _Charts:
    """Return the connected triangles of the same image, of those that have one."""
    same = pairs[view[pairs[:, 0]] == view[pairs[:, 1]]]
    graph = coo_array((np.ones(len(same), bool), (same[:, 0], same[:, 1])), shape=(len(view),) * 2)
    _, part = connected_components(graph, directed=False)
    shown = np.flatnonzero(view >= 0)
    _, first, chart = np.unique(part[shown], return_index=True, return_inverse=True)
    count = int(triangles.max()) + 1
    keys, corners = np.unique(chart[:, None] * count + triangles[shown], return_inverse=True)
    return _Charts(view[shown[first]], keys // count, keys % count, shown, corners.reshape(-1, 3).astype(np.int64))


def _arranged(
    vertices: Array, charts: _Charts, load: ViewLoader, depths: Sequence[PosedDepth], width: int, height: int
) -> _Layout | None:
    """Return a layout of the charts from the largest images with which they fit into some pixels, None if none do."""
    if not len(charts.view):
        none = np.zeros((0, 2), np.int64)
        return _Layout(load, np.zeros((0, 2)), none, none, none, 0) if height >= 0 else None
    order = np.argsort(charts.chart, kind="stable")
    starts = np.searchsorted(charts.chart[order], np.arange(len(charts.view)))
    view, used = charts.view[charts.chart], np.unique(charts.view).tolist()
    max_side = float(_MAX_SIDE_PX)
    while max_side >= _MIN_SIDE_PX:
        large = load.resized(round(max_side))
        pixels = np.empty((len(charts.vertex), 2))
        for i in used:
            rows = view == i
            pixels[rows] = projected(large.camera(i), depths[i].T_world_cam, vertices[charts.vertex[rows]])[0]
        low = np.floor(np.minimum.reduceat(pixels[order], starts)).astype(np.int64) - _BORDER_PX
        high = np.ceil(np.maximum.reduceat(pixels[order], starts)).astype(np.int64) + _BORDER_PX
        size = high - low + 1
        if size[:, 0].max() <= width:
            place, needed = pack(size, width)
            if needed <= height:
                return _Layout(large, pixels, low, size, place, needed)
        max_side = _REDUCTION * max(max(large.camera(i).width, large.camera(i).height) for i in used)
    return None


def _levelled(image: Image, small: Image, depth: PosedDepth, mesh: Mesh, tolerance: float) -> Image:
    """Return an image in which each neighbourhood is as bright as the points that it shows, which are means of images.

    Args:
        image: The image.
        small: The same image in the size of the depth map.
        depth: Its depth map.
        mesh: Mesh with the colours of its vertices.
        tolerance: Largest distance of a visible vertex from the surface of the depth map.
    """
    pixels, says = agreement(depth, mesh.vertices, tolerance)
    column, row = np.rint(pixels[says > 0]).astype(np.int64).T
    sigma_px = LEVELLING_SHARE * max(small.shape[:2])
    own, expected = np.zeros(small.shape, np.float32), np.zeros(small.shape, np.float32)
    own[row, column], expected[row, column] = small[row, column], mesh.colours[says > 0]
    own_mean, expected_mean = (values.mean(axis=(0, 1)) for values in (own, expected))
    own_near, expected_near = (cv2.GaussianBlur(values, (0, 0), sigma_px) for values in (own, expected))
    # Where no vertex is near, the gain is that of the whole image
    gain = (expected_near + _PRIOR_SHARE * expected_mean) / np.maximum(own_near + _PRIOR_SHARE * own_mean, 1e-3)
    gain = np.clip(gain, *GAIN_BOUNDS).astype(np.float32)
    height, width = image.shape[:2]
    large = cv2.resize(gain, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(np.clip(np.rint(image * large), 0, 255), np.uint8)


def _copy(texture: Image, image: Image, place: Indices, low: Indices, size: Indices) -> None:
    """Copy a rectangle of an image into the texture; what lies beyond the image repeats its border."""
    columns, rows = (np.clip(np.arange(low[k], low[k] + size[k]), 0, image.shape[1 - k] - 1) for k in (0, 1))
    texture[place[1] : place[1] + size[1], place[0] : place[0] + size[0]] = image[rows[:, None], columns]


def _paint(texture: Image, colours: Colours) -> Array:
    """Paint a patch for each triangle, and return the pixels (3 N, 2) of their corners.

    Three pixels of a patch have the colours (N, 3, 3) of the corners; the fourth is that which makes them a plane, so
    that interpolation between the pixels is that between the corners.
    """
    row, column = (2 * index for index in np.divmod(np.arange(len(colours)), texture.shape[1] // 2))
    a, b, c = (colours[:, k].astype(np.int64) for k in range(3))
    for value, right, below in ((a, 0, 0), (b, 1, 0), (c, 0, 1), (b + c - a, 1, 1)):
        texture[row + below, column + right] = np.clip(value, 0, 255)
    corners = np.stack([column, row], axis=1)[:, None] + np.array([[0, 0], [1, 0], [0, 1]])
    return np.asarray(corners.reshape(-1, 2), np.float64)
