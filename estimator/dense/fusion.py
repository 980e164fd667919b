"""Fusion of depth maps into one point cloud: the mean of the points in each voxel.

The depth maps have been averaged over the images that confirm them; see `dronevio.estimator.dense.consistency`.
"""

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from dronevio.estimator.dense.consistency import PosedDepth
from dronevio.models.surfaces import PointCloud

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]
Image = npt.NDArray[np.uint8]

_MIN_PENDING = 1_000_000  # points that are collected before they are merged


def fuse(depths: Iterable[tuple[PosedDepth, Image]], spacing: float) -> PointCloud:
    """Return the point cloud of depth maps.

    Points in a voxel are averaged with the weights w² of their inverse depths w, because near images are more accurate.

    Args:
        depths: Depth maps with the undistorted images (H, W, 3).
        spacing: Side of the voxels, about the distance between neighbouring points.
    """
    merged, pending = np.zeros((0, 10), np.float32), []
    for depth, image in depths:
        pending.append(_merged(_rows(depth, image), spacing))
        if sum(map(len, pending)) > max(_MIN_PENDING, len(merged)):  # so that the effort is linear in the points
            merged, pending = _merged(np.concatenate([merged, *pending]), spacing), []
    rows = _merged(np.concatenate([merged, *pending]), spacing).astype(np.float64)
    weight = rows[:, 9:]
    length = np.linalg.norm(rows[:, 3:6], axis=1, keepdims=True)
    normals = np.divide(rows[:, 3:6], length, out=np.tile([0.0, 0.0, 1.0], (len(rows), 1)), where=length > 0.0)
    return PointCloud(rows[:, :3] / weight, normals, np.round(rows[:, 6:9] / weight).astype(np.uint8))


def _rows(depth: PosedDepth, image: Image) -> Floats:
    """Return positions, normals, colours, each multiplied by the weight, and the weight (N, 10) of all pixels."""
    points = depth.points()
    normals = surface_normals(points)
    known = np.isfinite(normals[..., 0])
    T = depth.T_world_cam
    rows = np.empty((int(known.sum()), 10), np.float32)
    rows[:, :3] = points[known] @ T[:3, :3].T + T[:3, 3]
    rows[:, 3:6] = normals[known] @ T[:3, :3].T
    rows[:, 6:9] = image[known]
    rows[:, 9] = depth.inverse_depth[known] ** 2
    rows[:, :9] *= rows[:, 9:]
    return rows


def _merged(rows: Floats, side: float) -> Floats:
    """Return the sums of the rows (N, 10) in each voxel, in the order of the voxels."""
    if not len(rows):
        return rows
    cells = np.floor(rows[:, :3].astype(np.float64) / (rows[:, 9:] * side)).astype(np.int64)
    cells -= cells.min(axis=0)
    keys = np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0) + 1))
    order = np.argsort(keys, kind="stable")
    first = np.flatnonzero(np.diff(keys[order], prepend=-1))
    return np.asarray(np.add.reduceat(rows[order], first, axis=0))


def surface_normals(points: Floats) -> Floats:
    """Return the normals (H, W, 3) of the surface through points (H, W, 3), towards the camera; NaN where unknown.

    They are cross products of the differences of the neighbours on either side, or of one of them and the point.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        normal = np.cross(_difference(points, axis=0), _difference(points, axis=1))
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        facing_away = np.sum(normal * points, axis=-1, keepdims=True) > 0.0
    return np.where(np.isfinite(points), np.where(facing_away, -normal, normal), np.float32(np.nan))


def _difference(points: Floats, axis: int) -> Floats:
    """Return the central difference (H, W, 3) along an axis, a one-sided one where a neighbour is missing."""
    pad = [(0, 0)] * 3
    pad[axis] = (1, 1)
    padded = np.pad(points, pad, constant_values=np.nan)
    count = points.shape[axis]
    before, after = padded.take(range(count), axis), padded.take(range(2, count + 2), axis)
    both = after - before
    return np.where(np.isfinite(both), both, np.where(np.isfinite(after), after - points, points - before))
