"""Surfaces: what a camera sees, how far it is, and where it goes.

Depth is planar, the z of the camera frame, for a ``radtan`` lens; for a fisheye, to which z means nothing at 90° off
the axis, it is the length of the ray.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from dronevio.models.camera import CameraModel
from dronevio.models.rotation import inverse_pose
from dronevio.sim.cameras.views import pixel_rays

Array = npt.NDArray[np.float64]
Depth = npt.NDArray[np.float32]
Flow = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Surfaces:
    """What each pixel of a camera sees, at its very middle: nothing is mixed at an edge."""

    depth_m: Depth
    """(H, W) z in the camera frame for ``radtan``, the ray's length for ``equidistant`` [m]; inf where nothing is seen,
    NaN where the lens sees nothing."""
    geom: npt.NDArray[np.int32]
    """(H, W) Number of the geom in the world's model; −1 where nothing is seen."""


@lru_cache(maxsize=4)
def depth_rays(camera: CameraModel) -> Array:
    """Return rays (H, W, 3) in the camera frame whose length is that of one metre of depth; not to be written to."""
    rays = pixel_rays(camera)
    rays = rays / rays[..., 2:] if camera.lens == "radtan" else rays
    rays.flags.writeable = False
    return rays


def points_in_camera(camera: CameraModel, depth_m: Depth) -> Array:
    """Return the points (H, W, 3) in the camera frame that an image of depths (H, W) shows [m]; NaN where none is."""
    depth = np.where(np.isfinite(depth_m), depth_m, np.nan).astype(np.float64)
    return np.asarray(depth_rays(camera) * depth[..., None])


def optical_flow(
    camera: CameraModel,
    seen: Surfaces,
    T_world_cam: Array,
    T_world_cam_next: Array,
    Ts_next_now: Mapping[int, Array] | None = None,
) -> Flow:
    """Return how far what each pixel sees moves in the image (H, W, 2) [px] until the camera is elsewhere.

    It is the motion of the thing, whether the camera still sees it then or something else stands before it.

    Args:
        camera: The camera.
        seen: What it sees now.
        T_world_cam: (4, 4) Where it is now.
        T_world_cam_next: (4, 4) Where it will be.
        Ts_next_now: For each geom that moves, what maps its points in the world (4, 4) from now to then.

    Returns:
        The displacement x, y; NaN where nothing is seen, or where the lens will not see it.
    """
    p_world = points_in_camera(camera, seen.depth_m) @ T_world_cam[:3, :3].T + T_world_cam[:3, 3]
    for geom, T_next_now in (Ts_next_now or {}).items():
        moving = seen.geom == geom
        p_world[moving] = p_world[moving] @ T_next_now[:3, :3].T + T_next_now[:3, 3]
    T_next_world = inverse_pose(T_world_cam_next)
    pixels = camera.project(p_world @ T_next_world[:3, :3].T + T_next_world[:3, 3])
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return np.asarray(pixels - np.stack([u, v], axis=-1), dtype=np.float32)
