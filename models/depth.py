"""Depth images with their standard deviations, and the pinhole cameras of undistorted images."""

from dataclasses import dataclass

import numpy as np

from dronevio.models.arrays import Array, Floats, Image, Mask
from dronevio.models.errors import ConfigError


@dataclass(frozen=True, eq=False)
class Pinhole:
    """Pinhole camera without distortion; pixel centres have integer coordinates."""

    width: int
    """Number of columns [px]."""
    height: int
    """Number of rows [px]."""
    K: Array
    """(3, 3) Intrinsic matrix [px]."""

    def halved(self) -> "Pinhole":
        """Return the camera of the image at half the resolution, in which a pixel is the mean of four."""
        width, height = -(-self.width // 2), -(-self.height // 2)
        S = np.array([[0.5, 0.0, -0.25], [0.0, 0.5, -0.25], [0.0, 0.0, 1.0]])
        return Pinhole(width, height, S @ self.K)

    def rays(self) -> Floats:
        """Return the rays (H, W, 3) of all pixels in the camera frame, at depth 1."""
        u, v = np.meshgrid(np.arange(self.width, dtype=np.float64), np.arange(self.height, dtype=np.float64))
        x, y = (u - self.K[0, 2]) / self.K[0, 0], (v - self.K[1, 2]) / self.K[1, 1]
        return np.stack([x, y, np.ones_like(x)], axis=-1).astype(np.float32)


@dataclass(frozen=True, eq=False)
class DepthImage:
    """Depth of the pixels of an undistorted image, with its standard deviation and the pose of the camera."""

    t_ns: int
    """Time stamp of the frame [ns]."""
    camera: Pinhole
    """Camera of the undistorted image."""
    T_odom_cam: Array
    """(4, 4) Estimated pose of the camera in the odometry frame, in the middle of the exposure."""
    depth_m: Floats
    """(H, W) Depth along the optical axis; 0 where it is unknown [m]."""
    sigma_m: Floats
    """(H, W) Standard deviation of the depth; 0 where it is unknown [m]."""
    grey: Image
    """(H, W) Undistorted image."""
    least_m: Floats | None = None
    """(H, W) Least depth that the surface at a pixel of unknown depth can have, 0 where it may have any; None if it may
    have any everywhere [m]."""

    def __post_init__(self) -> None:
        """Check the shapes.

        Raises:
            ConfigError: An array does not have the size of the camera's image.
        """
        expected = (self.camera.height, self.camera.width)
        for name in ("depth_m", "sigma_m", "grey", "least_m"):
            image = getattr(self, name)
            if image is not None and image.shape != expected:
                raise ConfigError(f"depth image whose {name} has shape {image.shape}; expected {expected}")

    @property
    def known(self) -> Mask:
        """(H, W) Whether the depth is known."""
        return self.depth_m > 0.0

    def points_odom(self) -> Array:
        """Return the points (N, 3) of the pixels with a known depth in the odometry frame [m]."""
        known = self.known
        points = (self.camera.rays()[known] * self.depth_m[known][:, None]).astype(np.float64)
        return np.asarray(points @ self.T_odom_cam[:3, :3].T + self.T_odom_cam[:3, 3])
