"""Images of two cameras at one scale and of one size, between which Lucas-Kanade can track.

Lucas-Kanade compares patches that differ by a translation. Where the focal lengths of two cameras differ, the finer
image is reduced to the scale of the coarser one. OpenCV also needs images of one size: the smaller one is extended.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from dronevio.models.arrays import Array, Image
from dronevio.models.camera import CameraModel

MIN_RATIO = 0.85
"""Ratio of two focal lengths below which the finer image is reduced; smaller differences are tracked well."""


@dataclass(frozen=True, eq=False)
class ReducedImage:
    """The reduction of the images of one camera."""

    size: tuple[int, int]
    """Width and height after the reduction [px]."""
    scale: Array
    """(2,) Size after the reduction relative to that before it, along x and y."""

    @classmethod
    def of(cls, camera: CameraModel, scale: float) -> "ReducedImage":
        """Return the reduction of a camera's images by about a scale, at most 1."""
        size = (max(round(camera.width * scale), 1), max(round(camera.height * scale), 1))
        return cls(size, np.array(size) / (camera.width, camera.height))

    @property
    def is_reduced(self) -> bool:
        """Whether the images change at all."""
        return bool((self.scale != 1.0).any())

    def image(self, image: Image) -> Image:
        """Return a reduced image."""
        return np.asarray(cv2.resize(image, self.size, interpolation=cv2.INTER_AREA)) if self.is_reduced else image

    def pixels(self, pixels: Array) -> Array:
        """Return positions (N, 2) in the reduced image [px]. Pixel centres have integer coordinates in both."""
        return (pixels + 0.5) * self.scale - 0.5 if self.is_reduced else pixels

    def restored(self, pixels: Array) -> Array:
        """Return positions (N, 2) in the image of the camera, from those in the reduced one [px]."""
        return (pixels + 0.5) / self.scale - 0.5 if self.is_reduced else pixels


class CommonScale:
    """The reduction of the images of two cameras to one scale."""

    def __init__(self, first: CameraModel, second: CameraModel) -> None:
        """Choose the scale of the camera with the smaller focal length."""
        ratio = second.central_focal_px[0] / first.central_focal_px[0]
        alike = MIN_RATIO < ratio < 1.0 / MIN_RATIO
        self.first = ReducedImage.of(first, 1.0 if alike else min(ratio, 1.0))
        """Reduction of the images of the first camera."""
        self.second = ReducedImage.of(second, 1.0 if alike else min(1.0 / ratio, 1.0))
        """Reduction of the images of the second camera."""

    def images(self, first: Image, second: Image) -> tuple[Image, Image]:
        """Return an image of each camera at the common scale, extended to a common size on the right and below."""
        first, second = self.first.image(first), self.second.image(second)
        height, width = (max(a, b) for a, b in zip(first.shape, second.shape, strict=True))
        return _extended(first, height, width), _extended(second, height, width)


def _extended(image: Image, height: int, width: int) -> Image:
    """Return an image that is extended by its last row and column to a size."""
    below, right = height - image.shape[0], width - image.shape[1]
    if not below and not right:
        return image
    return np.asarray(cv2.copyMakeBorder(image, 0, below, 0, right, cv2.BORDER_REPLICATE), np.uint8)
