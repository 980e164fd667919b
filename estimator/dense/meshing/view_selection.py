"""Which image shows each triangle of a mesh best.

An image shows a triangle if its depth map agrees with at least one corner and contradicts none. The image in which it
is largest, near and seen from the front, is the best one. Each border between images is a visible seam: neighbouring
triangles prefer the same image, by iterated conditional modes of a Potts model over the best candidates of each.

Sources: Lempitsky and Ivanov, "Seamless mosaicing of image-based texture maps", CVPR 2007, for the problem; Waechter,
Moehrle and Goesele, "Let there be color! Large-scale texturing of 3D reconstructions", ECCV 2014, for the quality of
images; Besag, "On the statistical analysis of dirty pictures", 1986, for the optimization.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from dronevio.estimator.dense.consistency import PosedDepth
from dronevio.models.arrays import Array, Floats, Mask
from dronevio.models.depth import Pinhole

Indices = npt.NDArray[np.int64]

CANDIDATES = 6
"""Number of images among which a triangle chooses."""
SEAM_COST = 1.0
"""Cost of three neighbours with other images, relative to the gain of the largest area of the triangle over none."""
_SWEEPS = 20
_MARGIN_PX = 2.0  # from the border of an image, within which corners have to lie


def projected(camera: Pinhole, T_world_cam: Array, points: Array) -> tuple[Array, Array]:
    """Return the pixels (N, 2) and the depths (N,) of points (N, 3) in the world frame, NaN behind the camera."""
    in_camera = (points - T_world_cam[:3, 3]) @ T_world_cam[:3, :3]
    depth = np.where(in_camera[:, 2] > 0.0, in_camera[:, 2], np.nan)
    pixels = in_camera[:, :2] / depth[:, None] * [camera.K[0, 0], camera.K[1, 1]] + camera.K[:2, 2]
    return pixels, depth


def agreement(depth: PosedDepth, points: Array, tolerance: float) -> tuple[Array, npt.NDArray[np.int8]]:
    """Return the pixels (N, 2) of points in an image, and what its depth map says of them.

    Args:
        depth: Depth map of the image.
        points: (N, 3) Points in the world frame.
        tolerance: Largest distance along the optical axis from the surface of the depth map.

    Returns:
        (N, 2) Pixels, NaN behind the camera; (N,) 1 where the point is on the surface, 0 where the depth is unknown, −1
        where the point is hidden, before the surface or outside the image.
    """
    pixels, z = projected(depth.camera, depth.T_world_cam, points)
    high = np.array([depth.camera.width, depth.camera.height]) - 1.0 - _MARGIN_PX
    with np.errstate(invalid="ignore"):
        inside = np.all((pixels >= _MARGIN_PX) & (pixels <= high), axis=1)
    says = np.full(len(points), -1, np.int8)
    column, row = np.rint(pixels[inside]).astype(np.int64).T
    w = depth.inverse_depth[row, column]
    surface = np.divide(1.0, w, out=np.zeros(w.shape), where=w > 0.0)
    agrees = np.abs(z[inside] - surface) <= tolerance
    says[inside] = np.where(w > 0.0, np.where(agrees, 1, -1), 0)
    return pixels, says


def candidate_views(
    vertices: Array, triangles: Indices, depths: Sequence[PosedDepth], tolerance: float
) -> tuple[Indices, Floats]:
    """Return the images that show each triangle best, and how well.

    Args:
        vertices: (V, 3) Vertices in the world frame.
        triangles: (F, 3) Indices of the vertices of each triangle, counterclockwise as seen from outside.
        depths: (I,) Depth maps of the images.
        tolerance: Largest distance of a visible vertex from the surface of a depth map.

    Returns:
        (F, CANDIDATES) Indices of images in no order, −1 for none; (F, CANDIDATES) areas of the triangle in them
        [px²].
    """
    views = np.full((len(triangles), CANDIDATES), -1, np.int64)
    areas = np.zeros((len(triangles), CANDIDATES), np.float32)
    for i, depth in enumerate(depths):
        pixels, says = agreement(depth, vertices, tolerance)
        corners = says[triangles]
        shown = np.flatnonzero((corners.min(axis=1) >= 0) & (corners.max(axis=1) > 0))
        a, b, c = (pixels[triangles[shown, k]] for k in range(3))
        # Rows grow downwards: triangles that face the camera are clockwise in pixels.
        area = 0.5 * ((c - a)[:, 0] * (b - a)[:, 1] - (b - a)[:, 0] * (c - a)[:, 1])
        worst = np.argmin(areas[shown], axis=1)
        better = area > areas[shown, worst]
        rows, slots = shown[better], worst[better]
        views[rows, slots], areas[rows, slots] = i, area[better]
    return views, areas


def adjacent(triangles: Indices) -> Indices:
    """Return the pairs (A, 2) of triangles (F, 3) that have an edge in common."""
    edges = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    keys = edges[:, 0] * (int(triangles.max(initial=0)) + 1) + edges[:, 1]
    order = np.argsort(keys, kind="stable")
    same = np.flatnonzero(keys[order][1:] == keys[order][:-1])
    return np.stack([order[same], order[same + 1]], axis=1) // 3


def select_views(views: Indices, areas: Floats, pairs: Indices) -> Indices:
    """Return the image (F,) of each triangle, −1 for none, so that triangles are large in them and seams are few.

    Args:
        views: (F, K) Candidates of each triangle, −1 for none.
        areas: (F, K) Areas of the triangle in them [px²].
        pairs: (A, 2) Adjacent triangles.
    """
    rows = np.arange(len(views))
    gain = areas / np.maximum(areas.max(axis=1, keepdims=True, initial=0.0), np.finfo(np.float32).tiny)
    gain[views < 0] = -np.inf
    slot = np.argmax(gain, axis=1)
    first, second = np.concatenate([pairs, pairs[:, ::-1]]).T
    odd: Mask = np.random.default_rng(0).random(len(views)) < 0.5  # neighbours must not change at once
    for sweep in range(_SWEEPS):
        label = views[rows, slot]
        votes = np.zeros(views.shape, np.float32)
        for k in range(views.shape[1]):
            agrees = views[first, k] == label[second]
            votes[:, k] = np.bincount(first[agrees], minlength=len(views))
        best = np.argmax(gain + SEAM_COST / 3.0 * votes, axis=1)
        changes = (best != slot) & (odd if sweep % 2 else ~odd)
        slot[changes] = best[changes]
    return np.asarray(views[rows, slot])
