"""Optical flow of the images of environments: the motion of the visible surfaces since the previous image."""

from dataclasses import dataclass, replace

import numpy as np

from dronevio.models.arrays import Array, Mask
from dronevio.models.imu import Times
from dronevio.sim.cameras.atlas_renderer import MoverPoses
from dronevio.sim.cameras.camera import OffscreenCamera
from dronevio.sim.cameras.surfaces import Flow, Surfaces
from dronevio.sim.physics.vehicle_states import Table

_INFINITELY_FAR_M = 1e6


@dataclass(frozen=True, eq=False)
class ImagePoses(Table):
    """Poses and times of the images of n environments."""

    T_world_imu: Array
    """(n, 4, 4) Poses of the IMUs from which the calibrated cameras saw the images, with the mounting errors."""
    t_ns: Times
    """(n,) Times since the starts of the episodes [ns]."""
    exists: Mask
    """(n,) Whether there is an image of the episode."""

    @classmethod
    def none(cls, count: int) -> "ImagePoses":
        """Return the poses of ``count`` environments without images."""
        return cls(np.tile(np.eye(4), (count, 1, 1)), np.zeros(count, np.int64), np.zeros(count, np.bool_))


def flow_since(
    camera: OffscreenCamera,
    seen: Surfaces,
    poses: tuple[Array, Array],
    movers: tuple[MoverPoses, MoverPoses],
) -> Flow:
    """Return the flow (H, W, 2) from the previous image of a camera to the current one [px].

    The surface that a pixel of the current image shows was at the place ``pixel − flow`` of the previous image, whether
    it was visible there or not. What is infinitely far away moves by the rotation alone.

    Args:
        camera: The camera.
        seen: Surfaces in the current image.
        poses: Poses (4, 4) of the camera at the previous image and now.
        movers: Poses of moving objects at the previous image and now.

    Returns:
        Motion to the right and down, at most the width and the height of the image; 0 where the lens has no ray, or
        had none for the place of the surface at the previous image.
    """
    (T_before, T_now), (movers_before, movers_now) = poses, movers
    depth_m = np.where(np.isposinf(seen.depth_m), np.float32(_INFINITELY_FAR_M), seen.depth_m)
    back = camera.flow(replace(seen, depth_m=depth_m), T_now, T_before, movers_now, movers_before)
    bound = np.array([camera.camera.width, camera.camera.height], np.float32)
    return np.asarray(np.clip(np.nan_to_num(-back, nan=0.0), -bound, bound))
