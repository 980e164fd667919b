"""Visible surfaces of a camera: depth, geom and optical flow.

Depth is the z coordinate in the camera frame for ``radtan`` lenses, and the length of the ray for fisheye lenses, where
z is not meaningful at 90° from the optical axis.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.rotation import inverse_pose
from dronevio.sim.cameras.views import pixel_rays

Depth = npt.NDArray[np.float32]
Flow = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Depth and geom at the centre of each pixel of a camera, without blending at edges."""

    depth_m: Depth
    """(H, W) Depth: z in the camera frame for ``radtan``, length of the ray for fisheyes [m]; inf without a
    surface, NaN outside the field of view."""
    geom: npt.NDArray[np.int32]
    """(H, W) Index of the geom in the model of the world; −1 without a surface."""


@lru_cache(maxsize=4)
def depth_rays(camera: CameraModel) -> Array:
    """Return rays (H, W, 3) in the camera frame, scaled to one metre of depth; the array is read-only."""
    rays = pixel_rays(camera)
    rays = rays / rays[..., 2:] if camera.lens == "radtan" else rays
    rays.flags.writeable = False
    return rays


def points_in_camera(camera: CameraModel, depth_m: Depth) -> Array:
    """Return the points (H, W, 3) of a depth image (H, W) in the camera frame [m]; NaN without depth."""
    depth = np.where(np.isfinite(depth_m), depth_m, np.nan).astype(np.float64)
    return np.asarray(depth_rays(camera) * depth[..., None])


def optical_flow(
    camera: CameraModel,
    seen: Surfaces,
    T_world_cam: Array,
    T_world_cam_next: Array,
    Ts_next_now: Mapping[int, Array] | None = None,
) -> Flow:
    """Return the optical flow (H, W, 2) of each pixel to another camera pose [px].

    The flow is the motion of the visible point, regardless of later occlusion.

    Args:
        camera: The camera model.
        seen: Surfaces at the current pose.
        T_world_cam: (4, 4) Current pose of the camera.
        T_world_cam_next: (4, 4) Next pose of the camera.
        Ts_next_now: Transformation (4, 4) of the points of each moving geom in the world from now to the next time.

    Returns:
        The displacement x, y; NaN without a surface, or where the point leaves the field of view.
    """
    p_world = points_in_camera(camera, seen.depth_m) @ T_world_cam[:3, :3].T + T_world_cam[:3, 3]
    moved = Ts_next_now or {}
    for geom in moved.keys() & set(np.unique(seen.geom).tolist()):
        moving, T_next_now = seen.geom == geom, moved[geom]
        p_world[moving] = p_world[moving] @ T_next_now[:3, :3].T + T_next_now[:3, 3]
    T_next_world = inverse_pose(T_world_cam_next)
    pixels = camera.project(p_world @ T_next_world[:3, :3].T + T_next_world[:3, 3])
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return np.asarray(pixels - np.stack([u, v], axis=-1), dtype=np.float32)
