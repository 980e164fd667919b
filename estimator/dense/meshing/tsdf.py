"""Truncated signed distance function of depth maps, in blocks of voxels near the surface.

Source: Curless and Levoy, "A volumetric method for building complex models from range images", SIGGRAPH 1996; Nießner
et al., "Real-time 3D reconstruction at scale using voxel hashing", ACM Transactions on Graphics 2013, for the blocks.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.estimator.dense.config import MeshConfig
from dronevio.estimator.dense.consistency import PosedDepth
from dronevio.models.arrays import Floats
from dronevio.models.progress import Progress, silent

Indices = npt.NDArray[np.int64]

BLOCK = 8
"""Number of voxels along each side of a block."""
VOXEL_PX = 2.0
"""Side of a voxel in pixels of the undistorted images, at the median depth [px]."""
TRUNCATION_VOXELS = 4.0
"""Distance from the surface at which the function is truncated, in voxels."""
_MIN_GROWTH = 1.1  # smallest factor on the side of the voxels if there are too many
_BITS = 20  # of each coordinate of a block in one number
_MASK, _HALF = (1 << _BITS) - 1, 1 << (_BITS - 1)
_CHUNK = 1024  # blocks that are updated at a time
_STRIDE = 2  # of the pixels whose points allocate blocks


@dataclass(frozen=True, eq=False)
class Volume:
    """Truncated signed distances of B blocks of voxels, above zero in front of surfaces."""

    voxel: float
    """Side of a voxel in the unit of the reconstruction."""
    blocks: Indices
    """(B, 3) Integer coordinates of the blocks, in lexicographic order."""
    distances: Floats
    """(B, 8, 8, 8) Distances from the surface divided by the truncation distance, −1 to 1."""
    weights: Floats
    """(B, 8, 8, 8) Sum of the weights of the depths; 0 where no image has seen the voxel."""

    def corners(self) -> Indices:
        """Return the integer coordinates (B, 3) of the first voxel of each block."""
        return self.blocks * BLOCK


def integrate(depths: Sequence[PosedDepth], config: MeshConfig, progress: Progress = silent) -> Volume:
    """Return the volume of depth maps.

    The voxels are larger than the settings ask for if there were too many.

    Args:
        depths: Depth maps.
        config: Settings.
        progress: Called with the number of integrated depth maps.
    """
    voxel = config.voxel or VOXEL_PX * pixel_size(depths)
    blocks = _occupied_blocks(depths, voxel)
    while len(blocks) * BLOCK**3 > config.max_voxels:
        growth = max(_MIN_GROWTH, 0.9 * np.sqrt(len(blocks) * BLOCK**3 / config.max_voxels))  # surfaces are areas
        voxel *= growth
        blocks = _occupied_blocks(depths, voxel)
    shape = (len(blocks), BLOCK, BLOCK, BLOCK)
    volume = Volume(voxel, blocks, np.zeros(shape, np.float32), np.zeros(shape, np.float32))
    for done, depth in enumerate(depths, 1):
        _update(volume, depth, TRUNCATION_VOXELS * voxel)
        progress(done, len(depths))
    return volume


def pixel_size(depths: Sequence[PosedDepth]) -> float:
    """Return the median length of a pixel on the surface, in the unit of the reconstruction; 1 without depths."""
    sizes = [
        1.0 / (depth.inverse_depth[known] * depth.camera.K[0, 0])
        for depth in depths
        if (known := depth.inverse_depth > 0.0).any()
    ]
    return float(np.median(np.concatenate(sizes))) if sizes else 1.0


def _occupied_blocks(depths: Sequence[PosedDepth], voxel: float) -> Indices:
    """Return the blocks (B, 3) within the truncation distance of a surface along a ray."""
    side = BLOCK * voxel
    blocks = [np.zeros(0, np.int64)]
    for depth in depths:
        T = depth.T_world_cam
        points = depth.points()[::_STRIDE, ::_STRIDE].reshape(-1, 3)
        points = points[np.isfinite(points[:, 0])].astype(np.float64)
        direction = points / np.linalg.norm(points, axis=1, keepdims=True)
        for k in (-1.0, 0.0, 1.0):
            along = points + k * TRUNCATION_VOXELS * voxel * direction
            cells = np.floor((along @ T[:3, :3].T + T[:3, 3]) / side).astype(np.int64)
            blocks.append(np.unique(_keys(cells)))
    keys = np.unique(np.concatenate(blocks))
    return np.stack([(keys >> shift & _MASK) - _HALF for shift in (2 * _BITS, _BITS, 0)], axis=1)


def _keys(cells: Indices) -> Indices:
    """Return one number (N,) for each cell (N, 3), in lexicographic order."""
    x, y, z = (np.clip(cells + _HALF, 0, _MASK)).T
    return np.asarray(x << 2 * _BITS | y << _BITS | z)


def _update(volume: Volume, depth: PosedDepth, truncation: float) -> None:
    """Add a depth map to the distances. Its weight is z⁻² at depth z, because errors grow with the depth."""
    camera, T = depth.camera, depth.T_world_cam
    R, p = T[:3, :3].astype(np.float32), T[:3, 3].astype(np.float32)
    K = camera.K.astype(np.float32)
    grid = np.stack(np.meshgrid(*[np.arange(BLOCK)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    offsets = (grid * volume.voxel).astype(np.float32) @ R
    for rows in _visible(volume, depth, truncation):
        # Projection of the voxels
        first = (volume.corners()[rows] * volume.voxel).astype(np.float32) - p
        points = (first @ R)[:, None] + offsets
        z = points[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            u = np.rint(K[0, 0] * points[..., 0] / z + K[0, 2])
            v = np.rint(K[1, 1] * points[..., 1] / z + K[1, 2])
            inside = (z > 0.0) & (u >= 0.0) & (u < camera.width) & (v >= 0.0) & (v < camera.height)
        w = depth.inverse_depth[np.where(inside, v, 0.0).astype(np.int32), np.where(inside, u, 0.0).astype(np.int32)]
        seen = inside & (w > 0.0)
        # Truncated distance along the optical axis; what is far behind a surface is unseen
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (1.0 / w - z) / np.float32(truncation)
            seen &= distance > -1.0
        weight = np.where(seen, w * w, np.float32(0.0))
        # Weighted mean with the distances so far
        old = volume.weights[rows].reshape(len(rows), -1)
        total = old + weight
        mean = (
            volume.distances[rows].reshape(len(rows), -1) * old
            + np.where(seen, np.minimum(distance, 1.0), 0.0) * weight
        )
        shape = (len(rows), BLOCK, BLOCK, BLOCK)
        volume.distances[rows] = np.divide(mean, total, out=np.zeros_like(mean), where=total > 0.0).reshape(shape)
        volume.weights[rows] = total.reshape(shape)


def _visible(volume: Volume, depth: PosedDepth, truncation: float) -> Iterator[Indices]:
    """Yield the blocks that may lie in the image of a depth map and in front of its surfaces, in chunks."""
    camera, T = depth.camera, depth.T_world_cam
    half = 0.5 * BLOCK * volume.voxel
    centres = ((volume.corners() * volume.voxel + half) - T[:3, 3]) @ T[:3, :3]
    radius = np.sqrt(3.0) * half
    known = depth.inverse_depth[depth.inverse_depth > 0.0]
    if not len(known):
        return
    farthest = 1.0 / float(known.min()) + truncation
    z = centres[:, 2]
    inside = (z > -radius) & (z < farthest + radius)
    for k, side in enumerate((camera.width, camera.height)):  # the slab between the planes through two image borders
        at = camera.K[k, k] * centres[:, k] + camera.K[k, 2] * z
        margin = radius * (camera.K[k, k] + side)
        inside &= (at > -margin) & (at < side * z + margin)
    rows = np.flatnonzero(inside)
    for start in range(0, len(rows), _CHUNK):
        yield rows[start : start + _CHUNK]
