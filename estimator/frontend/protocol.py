"""The interface of a visual front end: from images to observations of features."""

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from dronevio.estimator.types import Calibration, ExpectedFeatures, Observations
from dronevio.models.arrays import Array, Image, Mask
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError
from dronevio.models.state import NO_IMAGE, CameraFrame

AtExposure = Callable[[int, Observations], Array]
"""Function that returns the coordinates (N, 2) of features when another camera, given by its index, is exposed, by the
calibration in use."""


class FrontEnd(Protocol):
    """Detects and tracks features in the images of a rig."""

    def track(
        self,
        frame: CameraFrame,
        R_cur_prev: Array,
        rotation_sigma_rad: float = 0.0,
        calibration: Calibration | None = None,
    ) -> Observations:
        """Track the features into a frame.

        A camera without an image in a frame observes no features there, and continues with them in its next image.

        Args:
            frame: The new frame.
            R_cur_prev: (3, 3) Rotation of the first camera from the previous frame to this one, by the gyroscope.
            rotation_sigma_rad: Standard deviation of that rotation [rad].
            calibration: The calibration in use; by default the one that the front end was made for.

        Returns:
            The tracked features.
        """

    def replenish(
        self, calibration: Calibration | None = None, at_exposure_of: AtExposure | None = None
    ) -> Observations:
        """Detect new features in the last frame, and match features between cameras.

        Args:
            calibration: The calibration in use; by default the one that the front end was made for.
            at_exposure_of: Moves features to the exposure of another camera; by default all cameras are exposed at one
                time.

        Returns:
            All features of the last frame, with their matches.
        """

    def discard(self, ids: npt.NDArray[np.int64]) -> None:
        """Stop tracking the given features (N,)."""


@runtime_checkable
class PredictingFrontEnd(FrontEnd, Protocol):
    """A front end that uses where features are expected, so that images between keyframes may be left out."""

    def track(
        self,
        frame: CameraFrame,
        R_cur_prev: Array,
        rotation_sigma_rad: float = 0.0,
        calibration: Calibration | None = None,
        expected: ExpectedFeatures | None = None,
    ) -> Observations:
        """Track the features into a frame; see `FrontEnd.track`.

        Args:
            frame: The new frame.
            R_cur_prev: As there.
            rotation_sigma_rad: As there.
            calibration: As there.
            expected: Where features are expected if the frames before have been left out; they are searched there.
        """

    def verified(
        self,
        frame: CameraFrame,
        expected: ExpectedFeatures,
        R_cur_prev: Array,
        calibration: Calibration | None = None,
    ) -> Observations | None:
        """Return the features that a frame shows where they are expected, if these are most of all.

        The features are not moved there: a frame that is not tracked afterwards counts as one without images.

        Args:
            frame: The frame after the last one.
            expected: Where the features are expected.
            R_cur_prev: (3, 3) Rotation of the first camera from the last frame to this one, by the gyroscope.
            calibration: The calibration in use; by default the last one.

        Returns:
            The features at the expected positions; None where the frame has to be tracked.
        """


def image_of(frame: CameraFrame, index: int, camera: CameraModel) -> Image | None:
    """Return a camera's image of a frame; None if it is `NO_IMAGE`. OpenCV would block on an image of another type.

    Raises:
        ConfigError: The frame has no entry of the camera, or its image is not uint8 or has not the camera's size.
    """
    image: object = frame.images[index] if index < len(frame.images) else None
    if isinstance(image, np.ndarray) and image.shape == NO_IMAGE.shape:
        return None
    shape = (camera.height, camera.width)
    if isinstance(image, np.ndarray) and image.shape == shape and image.dtype == np.uint8:
        return image
    found = type(image).__name__
    if isinstance(image, np.ndarray):
        found = f"{image.dtype} array of shape {image.shape}"
    raise ConfigError(f"frame at {frame.t_ns} ns whose image {index} is {found}; expected uint8 of shape {shape}")


def is_inside(pixels: Array, camera: CameraModel, border_px: float) -> Mask:
    """Return whether positions (N, 2) [px] are at least a border away from the outermost pixels; false where NaN."""
    x, y = pixels.T  # by coordinate, since `numpy.all` over the last axis takes twice as long
    right, bottom = camera.width - 1 - border_px, camera.height - 1 - border_px
    with np.errstate(invalid="ignore"):
        return np.asarray((x >= border_px) & (x <= right) & (y >= border_px) & (y <= bottom))
