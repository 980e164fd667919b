"""State of an incremental reconstruction, an immutable value that each step replaces."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.estimator.sfm.intrinsics import IntrinsicsPrior
from dronevio.estimator.sfm.tracks import Tracks
from dronevio.models.arrays import Array, Mask
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError

Indices = npt.NDArray[np.int64]

RAYLEIGH_MEDIAN = 1.1774
"""Median of the length of a vector of two normally distributed coordinates of standard deviation 1."""
MIN_NOISE_PX = 0.05
"""Smallest noise of observations that is assumed [px]; synthetic observations may have none."""


@dataclass(frozen=True, eq=False)
class KnownPoses:
    """Known poses of images, exact or with standard deviations."""

    Ts_world_cam: Array
    """(I, 4, 4) Pose of each image; NaN for images whose pose is unknown."""
    sigma_rad: float = 0.0
    """Standard deviation of the rotations [rad]; 0 if the poses are exact."""
    sigma_m: float = 0.0
    """Standard deviation of the positions [m]; 0 if the poses are exact."""
    is_vertical: bool = False
    """Whether the z axis of the world frame points up."""

    def __post_init__(self) -> None:
        """Check the standard deviations.

        Raises:
            ConfigError: One of them is negative, or only one is zero.
        """
        if min(self.sigma_rad, self.sigma_m) < 0.0 or (self.sigma_rad > 0.0) != (self.sigma_m > 0.0):
            raise ConfigError(
                f"standard deviations of {self.sigma_m:g} m and {np.degrees(self.sigma_rad):g}° of known poses;"
                " expected both above zero, or both zero for poses that are exact"
            )

    @property
    def is_exact(self) -> bool:
        """Whether the poses are exact and stay fixed."""
        return self.sigma_m == 0.0

    @property
    def is_known(self) -> Mask:
        """(I,) Whether the pose of each image is known."""
        return np.isfinite(self.Ts_world_cam[:, 0, 3])


@dataclass(frozen=True, eq=False)
class PositionPriors:
    """Measured positions of images and of tracks in the world frame, with a robust loss."""

    cameras: Array
    """(I, 3) Positions of the cameras; NaN where there is none."""
    camera_sigmas: Array
    """(I, 3) Their standard deviations along the axes of the world frame."""
    points: Array
    """(G, 3) Positions of the points of the last G tracks."""
    point_sigmas: Array
    """(G, 3) Their standard deviations."""
    cauchy_sigmas: float
    """Scale of the Cauchy loss, relative to the standard deviations."""


@dataclass(frozen=True, eq=False)
class Scene:
    """The measurements: I images with M observations of T tracks. They do not change while the scene is mapped."""

    tracks: Tracks
    """Tracks of features."""
    pixels: Array
    """(M, 2) Pixel of each observation."""
    sigmas: Array
    """(M,) Standard deviation of each observation, relative to that of small features."""
    image_camera: Indices
    """(I,) Index of the camera of each image."""
    is_calibrated: Mask
    """(K,) Whether the model of each camera is known and stays fixed."""
    priors: tuple[IntrinsicsPrior, ...] = ()
    """(K,) What is known beforehand of cameras that are not calibrated; empty if all are."""
    fixed_images: Mask | None = None
    """(I,) Images whose poses are known and stay fixed; None if there are none."""

    @property
    def is_fixed(self) -> Mask:
        """(I,) Whether the pose of each image is known and stays fixed."""
        return np.zeros(self.images, np.bool_) if self.fixed_images is None else self.fixed_images

    @property
    def images(self) -> int:
        """Number of images I."""
        return len(self.image_camera)


@dataclass(frozen=True, eq=False)
class SfmState:
    """Cameras, poses and points that have been estimated so far, in a frame of arbitrary scale."""

    cameras: tuple[CameraModel, ...]
    """(K,) Models of the cameras."""
    Ts_world_cam: Array
    """(I, 4, 4) Poses of the cameras; NaN for images that are not registered."""
    points: Array
    """(T, 3) Points of the tracks; NaN for tracks that are not triangulated."""
    is_inlier: Mask
    """(M,) Whether an observation belongs to the point of its track."""

    @property
    def is_registered(self) -> Mask:
        """(I,) Whether the pose of each image is known."""
        return np.isfinite(self.Ts_world_cam[:, 0, 3])

    @property
    def has_point(self) -> Mask:
        """(T,) Whether each track is triangulated."""
        return np.isfinite(self.points[:, 0])

    def used(self, scene: Scene, selected: Indices | None = None) -> Mask:
        """Return which observations, all by default, are inliers of a point in a registered image."""
        rows = slice(None) if selected is None else selected
        is_registered, has_point = self.is_registered, self.has_point
        image, track = scene.tracks.image[rows], scene.tracks.track[rows]
        return np.asarray(self.is_inlier[rows] & is_registered[image] & has_point[track])

    def bearings(self, scene: Scene, selected: Mask | Indices) -> Array:
        """Return unit vectors (S, 3) in the camera frames of the selected observations, NaN where there is none."""
        camera = scene.image_camera[scene.tracks.image[selected]]
        pixels = scene.pixels[selected]
        result = np.full((len(pixels), 3), np.nan)
        for index in np.unique(camera):
            mask = camera == index
            result[mask] = self.cameras[index].unproject(pixels[mask])
        return result

    def errors_px(self, scene: Scene, selected: Mask | Indices, points: Array | None = None) -> Array:
        """Return reprojection errors (S,) of the selected observations [px]; infinite where there is no projection.

        Args:
            scene: The measurements.
            selected: The observations.
            points: (S, 3) The point of each observation; by default that of its track.
        """
        image, track = scene.tracks.image[selected], scene.tracks.track[selected]
        T = self.Ts_world_cam[image]
        observed = self.points[track] if points is None else points
        in_camera = np.einsum("mji,mj->mi", T[:, :3, :3], observed - T[:, :3, 3])
        camera, pixels = scene.image_camera[image], scene.pixels[selected]
        errors = np.full(len(pixels), np.inf)
        for index in np.unique(camera):
            mask = camera == index
            errors[mask] = np.linalg.norm(self.cameras[index].project(in_camera[mask]) - pixels[mask], axis=1)
        return np.where(np.isfinite(errors), errors, np.inf)

    def noise_px(self, scene: Scene) -> float:
        """Return the standard deviation of the coordinates of small features [px], a robust estimate.

        It is that of normally distributed coordinates whose errors have the same median.
        """
        used = self.used(scene)
        if not used.any():
            return MIN_NOISE_PX
        relative = self.errors_px(scene, used) / scene.sigmas[used]
        return max(float(np.median(relative)) / RAYLEIGH_MEDIAN, MIN_NOISE_PX)

    def focal_px(self, scene: Scene, selected: Mask | Indices) -> Array:
        """Return the focal length (S,) of the camera of the selected observations, near its axis [px]."""
        focal = np.array([np.sqrt(np.prod(camera.central_focal_px)) for camera in self.cameras])
        return np.asarray(focal[scene.image_camera[scene.tracks.image[selected]]])


def initial_state(scene: Scene, cameras: tuple[CameraModel, ...], Ts_world_cam: Array) -> SfmState:
    """Return a state without points.

    Args:
        scene: The measurements.
        cameras: (K,) Camera models.
        Ts_world_cam: (I, 4, 4) Known poses; NaN for images that are not registered.
    """
    points = np.full((scene.tracks.count, 3), np.nan)
    return SfmState(cameras, Ts_world_cam, points, np.zeros(len(scene.pixels), np.bool_))
