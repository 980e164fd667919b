"""Geometric consistency of depth maps: a depth is kept if the depth maps of other images confirm it.

Source: Galliani, Lasinger and Schindler, "Massively parallel multiview stereopsis by surface normal diffusion", ICCV
2015, section 5; Yao et al., "MVSNet", ECCV 2018, section 4.3.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from dronevio.estimator.dense.config import ConsistencyConfig
from dronevio.models.arrays import Array, Floats, Mask
from dronevio.models.depth import Pinhole

MAX_DEPTH_RATIO = 0.01
"""Largest relative difference between a depth and that of the other depth map."""
_SAME_SURFACE = 0.01  # relative difference of inverse depths of neighbouring pixels that are interpolated
_OUTSIDE_PX = -10.0


@dataclass(frozen=True, eq=False)
class PosedDepth:
    """Depth map of an undistorted image with its pose."""

    camera: Pinhole
    """Camera of the undistorted image."""
    T_world_cam: Array
    """(4, 4) Pose of the camera in the world frame."""
    inverse_depth: Floats
    """(H, W) Inverse depth; 0 where it is unknown."""

    def points(self) -> Floats:
        """Return the points (H, W, 3) of the pixels in the camera frame; NaN where the depth is unknown."""
        known = self.inverse_depth > 0.0
        depth = np.divide(1.0, self.inverse_depth, out=np.full_like(self.inverse_depth, np.nan), where=known)
        return np.asarray(self.camera.rays() * depth[..., None])


def consistent_depth(
    reference: PosedDepth, others: Sequence[PosedDepth], config: ConsistencyConfig
) -> tuple[Floats, npt.NDArray[np.uint8]]:
    """Return the mean of the inverse depths that agree at each pixel, and how many other depth maps agree.

    An inverse depth w has the weight w² of the depth map that it is from, because the error of a depth grows with it.

    Args:
        reference: Depth map to confirm.
        others: Depth maps of other images.
        config: Tolerances.

    Returns:
        (H, W) Inverse depths, 0 where fewer than `min_views` agree; (H, W) numbers of other depth maps.
    """
    w = reference.inverse_depth
    weights = w * w
    sums, count = w * weights, np.zeros(w.shape, np.uint8)
    for other in others:
        agrees, seen, weight = confirm(reference, other, config)
        weight *= agrees
        weights += weight
        sums += np.where(agrees, seen, np.float32(0.0)) * weight
        count += agrees
    is_kept = count >= config.min_views
    return np.divide(sums, weights, out=np.zeros_like(w), where=is_kept & (weights > 0.0)), count


def confirm(reference: PosedDepth, other: PosedDepth, config: ConsistencyConfig) -> tuple[Mask, Floats, Floats]:
    """Return where another depth map confirms the depths of a reference.

    A point of the reference is projected into the other image; the point of the other depth map at this pixel is
    projected back. The depths agree if it returns to its pixel and has nearly the same depth.

    Args:
        reference: Depth map to confirm.
        other: Depth map of another image.
        config: Tolerances.

    Returns:
        (H, W) Where they agree; (H, W) inverse depth of the other points in the reference; (H, W) weight w² of these,
        with w in the other depth map.
    """
    T = np.asarray(np.linalg.inv(other.T_world_cam) @ reference.T_world_cam, dtype=np.float64)
    T_reference_other = np.asarray(np.linalg.inv(T), dtype=np.float64)
    height, width = reference.inverse_depth.shape
    x, y = np.arange(width, dtype=np.float32)[None], np.arange(height, dtype=np.float32)[:, None]
    w = reference.inverse_depth
    u, v, z = _transferred(reference.camera, other.camera, T, x, y, w)
    ahead = (z > 0.0) & (w > 0.0)
    u, v = (np.where(ahead, a, np.float32(_OUTSIDE_PX)) for a in (u, v))
    w_other = _sampled(other.inverse_depth, u, v)
    known = w_other > 0.0
    back_u, back_v, back_z = _transferred(other.camera, reference.camera, T_reference_other, u, v, w_other)
    seen = np.divide(w_other, back_z, out=np.zeros_like(w_other), where=known & (back_z > 0.0))
    agrees = known & ((back_u - x) ** 2 + (back_v - y) ** 2 <= np.float32(config.max_reprojection_px**2))
    agrees &= np.abs(seen - w) <= np.float32(MAX_DEPTH_RATIO) * w
    return agrees, seen, w_other * w_other


def _transferred(
    camera: Pinhole, other: Pinhole, T_other_cam: Array, x: Floats, y: Floats, inverse_depth: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return columns and rows in another image of pixels with inverse depths w, and z · w with the depth z there."""
    H = (other.K @ T_other_cam[:3, :3] @ np.linalg.inv(camera.K)).astype(np.float32)
    e = (other.K @ T_other_cam[:3, 3]).astype(np.float32)
    a, b, z = ((H[k, 0] * x + (H[k, 1] * y + H[k, 2])) + inverse_depth * e[k] for k in range(3))
    scale = np.divide(1.0, z, out=np.zeros_like(z), where=z > 1e-9)
    return a * scale, b * scale, z


def _sampled(inverse_depth: Floats, u: Floats, v: Floats) -> Floats:
    """Return inverse depths (H, W) at pixels: interpolated on a surface, else the nearest; 0 for none."""
    linear = np.asarray(cv2.remap(inverse_depth, u, v, cv2.INTER_LINEAR, borderValue=0.0))
    nearest = np.asarray(cv2.remap(inverse_depth, u, v, cv2.INTER_NEAREST, borderValue=0.0))
    return np.where(np.abs(linear - nearest) <= _SAME_SURFACE * nearest, linear, nearest)
