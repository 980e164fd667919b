"""The front end: from images to features.

What passes to those who use it: where features are seen, under which identity and for how long, and where further
cameras see the same at the same instant.
"""

from dataclasses import dataclass, field, fields
from typing import Protocol

import numpy as np
import numpy.typing as npt

from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError
from dronevio.models.rig import Rig
from dronevio.models.state import CameraFrame

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Matches:
    """Landmarks that further cameras of the rig see at the same instant as the one that follows them."""

    ids: npt.NDArray[np.int64]
    """(M,) Identities, each among those of the observations they belong to."""
    camera: npt.NDArray[np.int64]
    """(M,) Which camera of the rig sees each."""
    xy: Array
    """(M, 2) Undistorted and normalised: at depth 1 in that camera's frame."""

    def __len__(self) -> int:
        return len(self.ids)

    def without(self, ids: npt.NDArray[np.int64]) -> "Matches":
        """Return all but those of some features."""
        kept = ~np.isin(self.ids, ids)
        return Matches(self.ids[kept], self.camera[kept], self.xy[kept])


NO_MATCHES = Matches(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2)))
"""Of a single camera, and between keyframes."""


@dataclass(frozen=True, eq=False)
class Observations:
    """Where the tracked features are seen in one frame."""

    ids: npt.NDArray[np.int64]
    """(N,) Identities, in increasing order."""
    pixels: Array
    """(N, 2) In the image [px]."""
    xy: Array
    """(N, 2) Undistorted and normalised: at depth 1 in the camera frame."""
    ages: npt.NDArray[np.int64]
    """(N,) Number of frames in which each has been seen."""
    camera: npt.NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    """(N,) Which camera of the rig follows each; all the first one, if not given."""
    matches: Matches = NO_MATCHES
    """The same landmarks in further cameras; on keyframes."""
    doubted: Matches = NO_MATCHES
    """The same, in cameras that are not where the calibration says: of use for nothing but to calibrate them."""
    quality: Array = field(default_factory=lambda: np.zeros(0))
    """(N,) How much each looks like what was first seen of it: correlation, up to 1; all 1, if not given."""
    zoom: Array = field(default_factory=lambda: np.zeros(0))
    """(N,) How many times larger each looks than when it was first seen; all 1, if not given."""

    def __post_init__(self) -> None:
        """Say that the first camera sees all, and sees it well, where nothing is said."""
        if len(self.camera) != len(self.ids):
            object.__setattr__(self, "camera", np.zeros(len(self.ids), np.int64))
        for name in ("quality", "zoom"):
            if len(getattr(self, name)) != len(self.ids):
                object.__setattr__(self, name, np.ones(len(self.ids)))

    def __len__(self) -> int:
        return len(self.ids)

    def without(self, ids: npt.NDArray[np.int64]) -> "Observations":
        """Return the observations of all but some features."""
        kept = ~np.isin(self.ids, ids)
        left = {f.name: getattr(self, f.name)[kept] for f in fields(self) if f.name not in ("matches", "doubted")}
        return Observations(**left, matches=self.matches.without(ids), doubted=self.doubted.without(ids))


NOTHING_SEEN = Observations(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, np.int64))
"""Of a frame that shows no feature, or none that counts."""


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
