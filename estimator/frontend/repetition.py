"""Images that repeat the image before, although the vehicle rotates: a camera or a driver that has stopped.

Tracks on such an image claim that the vehicle does not move. It is therefore left out, as if the camera had no image.
The noise of a camera makes each image differ from the one before, so that an equal image is a copy. While the vehicle
does not rotate, rendered images without noise may be equal; they are used.
"""

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from dronevio.models.rotation import log_so3
from dronevio.models.state import NO_IMAGE, CameraFrame

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]

MIN_ROTATION_RAD = 1e-3
"""Smallest rotation between two images at which an equal image is a copy [rad]; half a pixel of EuRoC's cameras."""
MIN_CONTRAST = 10
"""Smallest range of grey values of a copy; dark images may be equal."""
ROTATION_SIGMAS = 3.0
"""The rotation must also exceed this number of its standard deviations."""


class RepetitionFilter:
    """Removes images that repeat the image of the same camera in the last frame."""

    def __init__(self) -> None:
        """Begin before the first frame."""
        self._images: tuple[Image, ...] = ()
        self._repeats = False

    @property
    def repeats(self) -> bool:
        """Whether an image of the last frame was removed."""
        return self._repeats

    def filtered(self, frame: CameraFrame, R_cur_prev: Array, rotation_sigma_rad: float) -> CameraFrame:
        """Return a frame with `NO_IMAGE` in place of images that are copies.

        Args:
            frame: The frame.
            R_cur_prev: (3, 3) Rotation since the last frame.
            rotation_sigma_rad: Standard deviation of the rotation [rad].
        """
        before, self._images = self._images, frame.images
        self._repeats = False
        if len(before) != len(frame.images):
            return frame
        copies = [_is_copy(image, last) for image, last in zip(frame.images, before, strict=True)]
        least_rad = MIN_ROTATION_RAD + ROTATION_SIGMAS * rotation_sigma_rad
        if not any(copies) or float(np.linalg.norm(log_so3(R_cur_prev))) < least_rad:
            return frame
        self._repeats = True
        images = tuple(NO_IMAGE if copy else image for image, copy in zip(frame.images, copies, strict=True))
        return replace(frame, images=images)


def _is_copy(image: Image, last: Image) -> bool:
    """Return whether an image equals the one before; dark and missing images are no copies."""
    if image is None or np.size(image) == 0 or not np.array_equal(image[:1], last[:1]):  # one row is fast to compare
        return False
    if not np.array_equal(image, last):
        return False
    return int(image.max()) - int(image.min()) >= MIN_CONTRAST
