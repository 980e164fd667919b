"""Reconstruction of a scene from images: cameras, poses, points, and the observations that connect them."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError

Indices = npt.NDArray[np.int64]


@dataclass(frozen=True)
class SelfCalibration:
    """Which parameters of a camera without a calibration were estimated from its images."""

    sigmas: Mapping[str, float]
    """Standard deviation of each parameter that was: of ``f`` [px], ``k1``, ``k2`` and so on."""
    held: tuple[str, ...] = ()
    """Parameters that the images do not determine, and which have the value of the first guess."""


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Poses of C images and N points of a scene, with M observations, in a world frame of arbitrary scale.

    Images alone determine neither the position, the orientation nor the scale of the world frame; `transformed`
    changes it.
    """

    cameras: tuple[CameraModel, ...]
    """Camera models; several images may share one."""
    image_names: tuple[str, ...]
    """Name of each image, (C,): its path below the folder of the images."""
    image_camera: Indices
    """(C,) Index of the camera of each image."""
    Ts_world_cam: Array
    """(C, 4, 4) Poses of the cameras in the world frame; x right, y down, z forward."""
    points: Array
    """(N, 3) Points in the world frame."""
    colours: npt.NDArray[np.uint8]
    """(N, 3) Colours of the points: red, green, blue."""
    observation_image: Indices
    """(M,) Index of the image of each observation."""
    observation_point: Indices
    """(M,) Index of the point of each observation."""
    observation_px: Array
    """(M, 2) Observed pixels; pixel centres have integer coordinates [px]."""

    def __post_init__(self) -> None:
        """Check shapes and indices.

        Raises:
            ConfigError: A shape or an index contradicts the others; the message names the field.
        """
        images, points, observations = len(self.image_names), len(self.points), len(self.observation_px)
        shapes = {
            "image_camera": (images,),
            "Ts_world_cam": (images, 4, 4),
            "points": (points, 3),
            "colours": (points, 3),
            "observation_image": (observations,),
            "observation_point": (observations,),
            "observation_px": (observations, 2),
        }
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise ConfigError(f"reconstruction: {name} has shape {getattr(self, name).shape}; expected {shape}")
        counts = {
            "image_camera": len(self.cameras),
            "observation_image": images,
            "observation_point": points,
        }
        for name, count in counts.items():
            index = getattr(self, name)
            if len(index) and not (index.min() >= 0 and index.max() < count):
                raise ConfigError(
                    f"reconstruction: {name} has values from {index.min()} to {index.max()}; expected 0 to {count - 1}"
                )

    @property
    def positions(self) -> Array:
        """(C, 3) Positions of the cameras in the world frame."""
        return self.Ts_world_cam[:, :3, 3]

    def track_lengths(self) -> Indices:
        """Return the number of observations (N,) of each point."""
        return np.bincount(self.observation_point, minlength=len(self.points)).astype(np.int64)

    def points_in_cameras(self) -> Array:
        """Return the observed point of each observation in the frame of its camera (M, 3)."""
        T_world_cam = self.Ts_world_cam[self.observation_image]
        relative = self.points[self.observation_point] - T_world_cam[:, :3, 3]
        return np.asarray(np.einsum("mji,mj->mi", T_world_cam[:, :3, :3], relative))

    def reprojection_residuals_px(self) -> Array:
        """Return the vector (M, 2) from each observation to the projection of its point [px].

        The vector is NaN where the point does not project into the image, for example behind a camera.
        """
        in_cameras = self.points_in_cameras()
        projected = np.full_like(self.observation_px, np.nan)
        camera_of_observation = self.image_camera[self.observation_image]
        for index, camera in enumerate(self.cameras):
            mask = camera_of_observation == index
            projected[mask] = camera.project(in_cameras[mask])
        return np.asarray(projected - self.observation_px)

    def reprojection_errors_px(self) -> Array:
        """Return the length (M,) of the vectors of `reprojection_residuals_px` [px]; NaN where they are NaN."""
        return np.asarray(np.linalg.norm(self.reprojection_residuals_px(), axis=1))

    def transformed(self, scale: float, R: Array, t: Array) -> Self:
        """Return the reconstruction in a new world frame.

        Args:
            scale: Factor on all lengths, above zero.
            R: (3, 3) Rotation from the present world frame to the new one.
            t: (3,) Origin of the present world frame in the new one.
        """
        Ts_world_cam = self.Ts_world_cam.copy()
        Ts_world_cam[:, :3, :3] = R @ self.Ts_world_cam[:, :3, :3]
        Ts_world_cam[:, :3, 3] = scale * self.positions @ R.T + t
        return replace(self, Ts_world_cam=Ts_world_cam, points=scale * self.points @ R.T + t)
