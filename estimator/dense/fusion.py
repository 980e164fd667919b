"""Fusion of depth maps into one point cloud: the mean of the points in each voxel.

The depth maps have been averaged over the images that confirm them; see `dronevio.estimator.dense.consistency`.
"""

from collections.abc import Iterable, Iterator
from dataclasses import fields

import numpy as np
import numpy.typing as npt

from dronevio.estimator.dense.consistency import PosedDepth
from dronevio.models.arrays import Floats, Image
from dronevio.models.surfaces import PointCloud

Indices = npt.NDArray[np.int64]

_SLAB = 64  # thickness of the slabs of space that are merged apart, in voxels, so that memory is needed for one
_MIN_PENDING = 100_000  # points of a slab that are collected before they are merged


def fuse(depths: Iterable[tuple[PosedDepth, Image]], spacing: float) -> PointCloud:
    """Return the point cloud of depth maps.

    Points in a voxel are averaged with the weights w² of their inverse depths w, because near images are more accurate.

    Args:
        depths: Depth maps with the undistorted images (H, W, 3).
        spacing: Side of the voxels, about the distance between neighbouring points.
    """
    slabs: dict[int, _Slab] = {}
    for depth, image in depths:
        for key, rows in _by_slab(_merged(_rows(depth, image), spacing), spacing):
            slabs.setdefault(key, _Slab()).add(rows, spacing)
    clouds = [_cloud(slabs.pop(key).merged(spacing)) for key in sorted(slabs)]
    nothing = PointCloud(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    return PointCloud(*(np.concatenate([getattr(c, f.name) for c in (nothing, *clouds)]) for f in fields(PointCloud)))


class _Slab:
    """Sums of the points in the voxels of a slab."""

    def __init__(self) -> None:
        self._rows = np.zeros((0, 10), np.float32)
        self._pending: list[Floats] = []

    def add(self, rows: Floats, side: float) -> None:
        """Add points (N, 10), and merge them if they are many, so that the effort is linear in the points."""
        self._pending.append(rows)
        if sum(map(len, self._pending)) > max(_MIN_PENDING, len(self._rows)):
            self.merged(side)

    def merged(self, side: float) -> Floats:
        """Return the sums (N, 10) in each voxel."""
        self._rows, self._pending = _merged(np.concatenate([self._rows, *self._pending]), side), []
        return self._rows


def _by_slab(rows: Floats, side: float) -> Iterator[tuple[int, Floats]]:
    """Yield the slabs along x that contain points, with their points, of rows (N, 10) in the order of the voxels."""
    if len(rows):
        slab = _cells(rows[:, 0], rows[:, 9], side) // _SLAB
        starts = np.flatnonzero(np.diff(slab, prepend=slab[0] - 1))
        yield from zip(slab[starts].tolist(), np.split(rows, starts[1:]), strict=True)


def _cloud(rows: Floats) -> PointCloud:
    """Return the means of rows (N, 10) as points."""
    sums = rows.astype(np.float64)
    weight = sums[:, 9:]
    length = np.linalg.norm(sums[:, 3:6], axis=1, keepdims=True)
    normals = np.divide(sums[:, 3:6], length, out=np.tile([0.0, 0.0, 1.0], (len(sums), 1)), where=length > 0.0)
    return PointCloud(sums[:, :3] / weight, normals, np.round(sums[:, 6:9] / weight).astype(np.uint8))


def _rows(depth: PosedDepth, image: Image) -> Floats:
    """Return positions, normals, colours, each multiplied by the weight, and the weight (N, 10) of all pixels."""
    normals = surface_normals(depth)
    known = np.isfinite(normals[..., 0])
    w = depth.inverse_depth[known]
    T = depth.T_world_cam
    rows = np.empty((len(w), 10), np.float32)
    rows[:, :3] = (depth.camera.rays()[known] / w[:, None]) @ T[:3, :3].T + T[:3, 3]
    rows[:, 3:6] = normals[known] @ T[:3, :3].T
    rows[:, 6:9] = image[known]
    rows[:, 9] = w * w
    rows[:, :9] *= rows[:, 9:]
    return rows


def _merged(rows: Floats, side: float) -> Floats:
    """Return the sums of the rows (N, 10) in each voxel, in the order of the voxels."""
    if not len(rows):
        return rows
    x, y, z = (_cells(rows[:, k], rows[:, 9], side) for k in range(3))
    x, y, z = (cells - cells.min() for cells in (x, y, z))
    keys = (x * (y.max() + 1) + y) * (z.max() + 1) + z
    order = np.argsort(keys, kind="stable")
    first = np.flatnonzero(np.diff(keys[order], prepend=-1))
    return np.asarray(np.add.reduceat(rows[order], first, axis=0))


def _cells(sums: Floats, weights: Floats, side: float) -> Indices:
    """Return the coordinates (N,) of the voxels of weighted means."""
    return np.floor(sums.astype(np.float64) / (weights * side)).astype(np.int64)


def surface_normals(depth: PosedDepth) -> Floats:
    """Return the normals (H, W, 3) of the surface in the camera frame, towards the camera; NaN where unknown.

    On the plane n · X = 1, the inverse depth at the ray r of depth 1 is n · r. Its derivatives with respect to the
    pixel give n = (fx w_u, fy w_v, w − (u − cx) w_u − (v − cy) w_v), which points away from the camera.
    """
    K, w = depth.camera.K.astype(np.float32), depth.inverse_depth
    w_u, w_v = _derivative(w), _derivative(w.T).T
    u, v = np.arange(w.shape[1], dtype=np.float32)[None], np.arange(w.shape[0], dtype=np.float32)[:, None]
    normal = np.stack([K[0, 0] * w_u, K[1, 1] * w_v, w - (u - K[0, 2]) * w_u - (v - K[1, 2]) * w_v], axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        normal /= -np.sqrt(np.einsum("ijk,ijk->ij", normal, normal))[..., None]
    return normal


def _derivative(w: Floats) -> Floats:
    """Return the derivative (H, W) of inverse depths along the rows, one-sided where a neighbour is unknown, or NaN."""
    known = np.pad(np.where(w > 0.0, w, np.float32(np.nan)), ((0, 0), (1, 1)), constant_values=np.nan)
    before, here, after = known[:, :-2], known[:, 1:-1], known[:, 2:]
    forward, backward = after - here, here - before
    both = 0.5 * (forward + backward)
    one = np.where(np.isfinite(forward), forward, backward)
    return np.asarray(np.where(np.isfinite(both), both, one), dtype=np.float32)
