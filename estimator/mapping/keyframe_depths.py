"""Depth images of a flight, kept for its surfaces: where the camera has moved, and as many as memory allows."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array, Image
from dronevio.models.depth import DepthImage, Pinhole
from dronevio.models.rotation import log_so3

_DISTANCE_M, _ANGLE_RAD = 0.1, np.radians(6.0)  # motion since the image before, of which one is enough


@dataclass(frozen=True, eq=False)
class KeptDepth:
    """A depth image in three bytes a pixel."""

    t_ns: int
    """Time stamp of the frame [ns]."""
    camera: Pinhole
    """Camera of the undistorted image."""
    T_odom_cam: Array
    """(4, 4) Estimated pose of the camera in the odometry frame."""
    inverse_depth: npt.NDArray[np.float16]
    """(H, W) Inverse depth; 0 where it is unknown [1/m]."""
    grey: Image
    """(H, W) Undistorted image."""


class KeyframeDepths:
    """Keeps depth images between which the camera has moved; the motion doubles whenever the memory is full."""

    def __init__(self, max_pixels: int = 100_000_000) -> None:
        """Begin without images.

        Args:
            max_pixels: Largest number of pixels of all images, each of which takes three bytes.
        """
        self._max_pixels = max_pixels
        self._motion = 1.0
        self._kept: list[KeptDepth] = []

    def add(self, depth: DepthImage, range_m: float) -> None:
        """Keep a depth image if its camera has moved since the last one that was kept.

        Args:
            depth: The image.
            range_m: Distance from which on depths are left out [m].
        """
        if self._kept and _motion(self._kept[-1].T_odom_cam, depth.T_odom_cam) < self._motion:
            return
        used = depth.known & (depth.depth_m <= range_m)
        inverse = np.divide(1.0, depth.depth_m, out=np.zeros_like(depth.depth_m), where=used)
        kept = KeptDepth(depth.t_ns, depth.camera, depth.T_odom_cam, inverse.astype(np.float16), depth.grey)
        self._kept.append(kept)
        while len(self._kept) > 2 and sum(each.grey.size for each in self._kept) > self._max_pixels:
            self._kept = self._kept[::2]
            self._motion *= 2.0

    @property
    def kept(self) -> tuple[KeptDepth, ...]:
        """The images that are kept, in the order of time."""
        return tuple(self._kept)


def _motion(T_odom_a: Array, T_odom_b: Array) -> float:
    """Return the motion between two poses, of which 1 makes another image worth keeping."""
    distance_m = float(np.linalg.norm(T_odom_b[:3, 3] - T_odom_a[:3, 3]))
    angle_rad = float(np.linalg.norm(log_so3(T_odom_a[:3, :3].T @ T_odom_b[:3, :3])))
    return max(distance_m / _DISTANCE_M, angle_rad / float(_ANGLE_RAD))
