"""Geometric consistency of depth maps: a depth is kept if the depth maps of other images confirm it.

Source: Galliani, Lasinger and Schindler, "Massively parallel multiview stereopsis by surface normal diffusion", ICCV
2015, section 5; Yao et al., "MVSNet", ECCV 2018, section 4.3.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from dronevio.estimator.dense.config import ConsistencyConfig
from dronevio.estimator.dense.views import Pinhole

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

_SAME_SURFACE = 0.01  # relative difference of inverse depths of neighbouring pixels that are interpolated


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


@dataclass(frozen=True, eq=False)
class Confirmation:
    """What another depth map says about the depths of a reference."""

    confirmed: Mask
    """(H, W) True where the depths agree."""
    points: Floats
    """(H, W, 3) Points of the other depth map in the camera frame of the reference; NaN where it has none."""
    pixels: Floats
    """(H, W, 2) Projection of the points of the reference in the other image [px]."""


def confirm(reference: PosedDepth, other: PosedDepth, config: ConsistencyConfig) -> Confirmation:
    """Return where another depth map confirms the depths of a reference.

    A point of the reference is projected into the other image; the point of the other depth map at this pixel is
    projected back. The depths agree if it returns to its pixel and has nearly the same depth.

    Args:
        reference: Depth map to confirm.
        other: Depth map of another image.
        config: Tolerances.
    """
    T = np.linalg.inv(other.T_world_cam) @ reference.T_world_cam
    points = reference.points()
    in_other = points @ T[:3, :3].T.astype(np.float32) + T[:3, 3].astype(np.float32)
    pixels = _projected(other.camera, in_other)
    inverse_depth = _sampled(other.inverse_depth, pixels)
    known = inverse_depth > 0.0
    depth = np.divide(1.0, inverse_depth, out=np.full_like(inverse_depth, np.nan), where=known)
    x = (pixels[..., 0] - other.camera.K[0, 2]) / other.camera.K[0, 0]
    y = (pixels[..., 1] - other.camera.K[1, 2]) / other.camera.K[1, 1]
    seen = np.stack([x * depth, y * depth, depth], axis=-1)
    back = np.linalg.inv(T)
    returned = (seen @ back[:3, :3].T + back[:3, 3]).astype(np.float32)
    moved = _projected(reference.camera, returned) - _grid(reference.camera)
    with np.errstate(invalid="ignore"):
        near = np.hypot(moved[..., 0], moved[..., 1]) <= config.max_reprojection_px
        same = np.abs(returned[..., 2] - points[..., 2]) <= config.max_depth_ratio * points[..., 2]
    return Confirmation(near & same, returned, pixels)


def _projected(camera: Pinhole, points: Floats) -> Floats:
    """Return pixels (H, W, 2) of points (H, W, 3) in the camera frame; NaN behind the camera."""
    z = np.where(points[..., 2] > 0.0, points[..., 2], np.nan)
    u = camera.K[0, 0] * points[..., 0] / z + camera.K[0, 2]
    v = camera.K[1, 1] * points[..., 1] / z + camera.K[1, 2]
    return np.stack([u, v], axis=-1).astype(np.float32)


def _sampled(inverse_depth: Floats, pixels: Floats) -> Floats:
    """Return inverse depths (H, W) at pixels (H, W, 2): interpolated on a surface, else the nearest; 0 for none."""
    at = np.nan_to_num(pixels, nan=-10.0, posinf=-10.0, neginf=-10.0)
    linear = np.asarray(cv2.remap(inverse_depth, at, None, cv2.INTER_LINEAR, borderValue=0.0))
    nearest = np.asarray(cv2.remap(inverse_depth, at, None, cv2.INTER_NEAREST, borderValue=0.0))
    return np.where(np.abs(linear - nearest) <= _SAME_SURFACE * nearest, linear, nearest)


def _grid(camera: Pinhole) -> Floats:
    """Return the coordinates (H, W, 2) of all pixels."""
    u, v = np.meshgrid(np.arange(camera.width, dtype=np.float32), np.arange(camera.height, dtype=np.float32))
    return np.stack([u, v], axis=-1)
