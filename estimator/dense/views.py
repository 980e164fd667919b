"""Undistorted images with their poses, the input of multi-view stereo."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np

from dronevio.estimator.array_store import digest
from dronevio.estimator.dense.config import ViewConfig
from dronevio.models.arrays import Array, Floats, Image, Mask
from dronevio.models.camera import CameraModel
from dronevio.models.depth import Pinhole
from dronevio.models.errors import InputError
from dronevio.models.image_sets import ImageSet
from dronevio.models.reconstruction import Reconstruction

_CACHED_VIEWS = 24  # images in memory


@dataclass(frozen=True, eq=False)
class View:
    """An undistorted image with its pose."""

    camera: Pinhole
    """Camera of the undistorted image."""
    T_world_cam: Array
    """(4, 4) Pose of the camera in the world frame."""
    grey: Floats
    """(H, W) Grey values, 0 to 255."""
    mask: Mask
    """(H, W) True where the undistorted image has content."""
    colours: Image
    """(H, W, 3) Red, green and blue."""
    content: str = ""
    """Hash of the image before it was undistorted, and of its mask."""

    def inputs(self) -> tuple[Array, Array, Floats, Mask]:
        """Return what a depth map depends on: intrinsic matrix, pose, grey values and mask."""
        return self.camera.K, self.T_world_cam, self.grey, self.mask

    def halved(self) -> "View":
        """Return the view at half the resolution."""
        camera = self.camera.halved()
        rows, columns = 2 * camera.height - self.camera.height, 2 * camera.width - self.camera.width
        pad = ((0, rows), (0, columns))

        def reduced(image: Floats) -> Floats:
            padded = np.pad(image, pad, mode="edge")
            return np.asarray(cv2.resize(padded, (camera.width, camera.height), interpolation=cv2.INTER_AREA))

        mask = reduced(self.mask.astype(np.float32)) > 0.99
        colours = self.colours[::2, ::2]
        return View(camera, self.T_world_cam, reduced(self.grey), mask, colours)


def undistorted_camera(model: CameraModel, config: ViewConfig) -> Pinhole:
    """Return the camera of the undistorted images of a camera.

    They have the resolution of the camera at its centre, reduced to the largest size. They extend to the middle of each
    side of the image, but not beyond the largest angle; stretched corners are cut.
    """
    low, high = model.normalized_bounds(np.tan(np.radians(config.max_angle_deg)))
    full = np.array(model.central_focal_px) * (high - low)
    f = min(1.0, config.max_side_px / float(full.max())) * np.array(model.central_focal_px)
    width, height = (max(8, int(n)) for n in np.floor(f * (high - low)))
    cx, cy = -f * low - 0.5
    return Pinhole(width, height, np.array([[f[0], 0.0, cx], [0.0, f[1], cy], [0.0, 0.0, 1.0]]))


@dataclass(frozen=True, eq=False)
class Undistortion:
    """Map from the pixels of an undistorted image to those of the image of a camera."""

    camera: Pinhole
    """Camera of the undistorted image."""
    size: tuple[int, int]
    """Width and height to which the image is reduced before it is undistorted [px]."""
    map_px: Floats
    """(H, W, 2) Pixel of the reduced image at each undistorted pixel [px]."""
    mask: Mask
    """(H, W) True where the pixel lies in the image."""

    @classmethod
    def of(cls, model: CameraModel, config: ViewConfig) -> "Undistortion":
        """Return the undistortion of a camera."""
        camera = undistorted_camera(model, config)
        scale = camera.K[0, 0] / model.central_focal_px[0]
        pixels = model.project(camera.rays().astype(np.float64))
        with np.errstate(invalid="ignore"):
            inside = np.all((pixels >= -0.5) & (pixels <= [model.width - 0.5, model.height - 0.5]), axis=-1)
        size = max(1, round(scale * model.width)), max(1, round(scale * model.height))
        factor = np.array(size) / [model.width, model.height]
        reduced = (pixels + 0.5) * factor - 0.5
        return cls(camera, size, np.where(inside[..., None], reduced, -1.0).astype(np.float32), inside)

    def apply(self, image: Image) -> Image:
        """Return the undistorted image (H, W, …) of an image of the camera."""
        if (image.shape[1], image.shape[0]) != self.size:
            image = np.asarray(cv2.resize(image, self.size, interpolation=cv2.INTER_AREA))
        u, v = self.map_px[..., 0], self.map_px[..., 1]
        return np.asarray(cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


class ViewLoader:
    """Reads and undistorts the registered images of a reconstruction on request, and keeps the latest in memory."""

    def __init__(
        self, images: ImageSet, reconstruction: Reconstruction, config: ViewConfig, cached: int = _CACHED_VIEWS
    ) -> None:
        """Take the images and their cameras.

        Args:
            images: The images, of which the reconstruction registers some by name.
            reconstruction: Poses and cameras of the registered images.
            config: Settings.
            cached: Number of undistorted images that are kept in memory.

        Raises:
            InputError: A registered image is not among the images.
        """
        index = {name: i for i, name in enumerate(images.names)}
        missing = [name for name in reconstruction.image_names if name not in index]
        if missing:
            found = f"{len(missing)} images of the reconstruction that are not among the {len(images)} images"
            raise InputError(missing[0], found, "the images from which it was made")
        self._rows = [index[name] for name in reconstruction.image_names]
        self._images, self._reconstruction, self._config = images, reconstruction, config
        self._cameras = [undistorted_camera(model, config) for model in reconstruction.cameras]
        self._undistortion: Callable[[int], Undistortion] = lru_cache(None)(self._undistortion_of)
        self._load: Callable[[int], View] = lru_cache(cached)(self._read)

    def __len__(self) -> int:
        return len(self._rows)

    def __call__(self, index: int) -> View:
        """Return the undistorted image with an index in the reconstruction.

        Raises:
            InputError: The image cannot be read.
        """
        return self._load(index)

    def camera(self, index: int) -> Pinhole:
        """Return the camera of an undistorted image without reading it."""
        return self._cameras[int(self._reconstruction.image_camera[index])]

    def resized(self, max_side_px: int) -> "ViewLoader":
        """Return a loader of the same images with another largest side, which keeps none in memory."""
        config = replace(self._config, max_side_px=max_side_px)
        return ViewLoader(self._images, self._reconstruction, config, cached=0)

    def _undistortion_of(self, camera: int) -> Undistortion:
        return Undistortion.of(self._reconstruction.cameras[camera], self._config)

    def _read(self, index: int) -> View:
        undistortion = self._undistortion(int(self._reconstruction.image_camera[index]))
        row = self._rows[index]
        image, mask = self._images.read(row), self._images.read_mask(row)
        colours = undistortion.apply(image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2))
        grey = cv2.cvtColor(colours, cv2.COLOR_RGB2GRAY).astype(np.float32)
        valid = undistortion.mask
        if mask is not None:
            valid = valid & (undistortion.apply(mask.astype(np.uint8) * np.uint8(255)) > 127)
        T_world_cam = self._reconstruction.Ts_world_cam[index]
        return View(undistortion.camera, T_world_cam, grey, valid, colours, digest(image, image.shape, mask))
