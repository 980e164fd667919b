"""Images that equal the previous one although the vehicle moves: a camera or a driver has stopped or stutters.

Tracks on such an image claim that the vehicle does not move. It is therefore left out, as if the camera had no image.
The noise of a camera makes each image differ from the one before, so that an equal image is a copy. While the vehicle
may be at rest, rendered images without noise may be equal; they are used. It moves if it has rotated since the image
was new, or if the estimate has a velocity. From then on, the image is a copy until another one comes.
"""

from dataclasses import dataclass, replace

import numpy as np

from dronevio.models.arrays import Array, Image
from dronevio.models.rotation import log_so3
from dronevio.models.state import NO_IMAGE, CameraFrame

MIN_ROTATION_RAD = 1e-3
"""Smallest rotation since an image was new at which an equal image is a copy [rad]; half a pixel of EuRoC's cameras."""
MIN_CONTRAST = 10
"""Smallest range of grey values of a copy; dark images may be equal."""
ROTATION_SIGMAS = 3.0
"""The rotation must also exceed this number of its standard deviations."""


@dataclass(frozen=True, eq=False)
class _Shown:
    """The image that a camera shows, and the motion since it was new."""

    image: Image
    R_cur_new: Array
    """(3, 3) Rotation since then."""
    sigma_rad: float
    """Standard deviation of the rotation."""
    is_copy: bool
    """Whether the vehicle has moved since then."""

    @property
    def has_rotated(self) -> bool:
        """Whether the vehicle has certainly rotated."""
        angle_rad = float(np.linalg.norm(log_so3(self.R_cur_new)))
        return angle_rad >= MIN_ROTATION_RAD + ROTATION_SIGMAS * self.sigma_rad


class RepetitionFilter:
    """Removes images that repeat the image of the same camera in the last frame."""

    def __init__(self) -> None:
        """Begin before the first frame."""
        self._shown: tuple[_Shown, ...] = ()

    @property
    def repeats(self) -> bool:
        """Whether an image of the last frame was removed."""
        return any(shown.is_copy for shown in self._shown)

    def filtered(
        self, frame: CameraFrame, R_cur_prev: Array, rotation_sigma_rad: float, *, moves: bool = False
    ) -> CameraFrame:
        """Return a frame with `NO_IMAGE` in place of images that are copies.

        Args:
            frame: The frame.
            R_cur_prev: (3, 3) Rotation since the last frame.
            rotation_sigma_rad: Standard deviation of the rotation [rad].
            moves: Whether the vehicle is known to move, whether it rotates or not.
        """
        before = self._shown if len(self._shown) == len(frame.images) else (None,) * len(frame.images)
        self._shown = tuple(
            _next(shown, image, R_cur_prev, rotation_sigma_rad, moves)
            for shown, image in zip(before, frame.images, strict=True)
        )
        if not self.repeats:
            return frame
        images = tuple(NO_IMAGE if s.is_copy else image for s, image in zip(self._shown, frame.images, strict=True))
        return replace(frame, images=images)


def _next(last: _Shown | None, image: Image, R_cur_prev: Array, sigma_rad: float, moves: bool) -> _Shown:
    """Return what a camera shows with its next image."""
    if last is None or not _is_equal(image, last.image):
        return _Shown(image, np.eye(3), 0.0, is_copy=False)
    shown = _Shown(image, R_cur_prev @ last.R_cur_new, last.sigma_rad + sigma_rad, last.is_copy or moves)
    return shown if shown.is_copy else replace(shown, is_copy=shown.has_rotated)


def _is_equal(image: Image, last: Image) -> bool:
    """Return whether an image equals the one before; dark and missing images do not count as equal."""
    if image is None or np.size(image) == 0 or not np.array_equal(image[:1], last[:1]):  # one row is fast to compare
        return False
    if not np.array_equal(image, last):
        return False
    return int(image.max()) - int(image.min()) >= MIN_CONTRAST
