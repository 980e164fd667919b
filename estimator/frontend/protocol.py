"""The front end's contract: what the odometry asks of whatever turns images into observations of features."""

from typing import Protocol

import numpy as np
import numpy.typing as npt

from dronevio.estimator.types import Observations
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError
from dronevio.models.rig import Rig
from dronevio.models.state import CameraFrame

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]


class FrontEnd(Protocol):
    """Turns frames into observations of features."""

    def track(self, frame: CameraFrame, R_cur_prev: Array, rotation_sigma_rad: float = 0.0) -> Observations:
        """Follow the features into a frame.

        Args:
            frame: The new frame.
            R_cur_prev: (3, 3) Rotation of the previous camera frame into this one, from the gyroscope.
            rotation_sigma_rad: How far it may be off.
        """

    def replenish(self) -> Observations:
        """Look for new features in the last frame, and return all that are seen in it."""

    def discard(self, ids: npt.NDArray[np.int64]) -> None:
        """Follow some features no further."""

    def recalibrate(self, rig: Rig) -> None:
        """Take over a better calibration of the cameras' mounting; those that match cameras need it.

        Args:
            rig: The rig, as it is now believed to be.
        """


def image_of(frame: CameraFrame, index: int, camera: CameraModel) -> Image:
    """Return the image that a camera of the rig has in a frame; OpenCV would wait for ever for one that is none.

    Raises:
        ConfigError: There is no grey one of the camera's size.
    """
    image: object = frame.images[index] if index < len(frame.images) else None
    shape = (camera.height, camera.width)
    if isinstance(image, np.ndarray) and image.shape == shape and image.dtype == np.uint8:
        return image
    found = type(image).__name__
    if isinstance(image, np.ndarray):
        found = f"{image.dtype} array of shape {image.shape}"
    raise ConfigError(f"frame at {frame.t_ns} ns whose image {index} is {found}; expected uint8 of shape {shape}")
