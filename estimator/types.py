"""What passes between the parts of the estimator: observations, frame packets, and the gauge's constants."""

from dataclasses import dataclass, field, fields

import numpy as np
import numpy.typing as npt

from dronevio.estimator.imu.buffer import Increments

Array = npt.NDArray[np.float64]

GAUGE_SIGMA = 1e-4
"""Uncertainty of yaw and position at the start [rad and m]: zero by definition, but for the solver's comfort."""


@dataclass(frozen=True, eq=False)
class Matches:
    """Landmarks that further cameras of the rig see at the same instant as the one that follows them."""

    ids: npt.NDArray[np.int64]
    """(M,) Identities, each among those of the observations they belong to."""
    camera: npt.NDArray[np.int64]
    """(M,) Which camera of the rig sees each."""
    xy: Array
    """(M, 2) Undistorted and normalized: at depth 1 in that camera's frame."""

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
    """(N, 2) Undistorted and normalized: at depth 1 in the camera frame."""
    ages: npt.NDArray[np.int64]
    """(N,) Number of frames in which each has been seen."""
    camera: npt.NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    """(N,) Which camera of the rig follows each; all the first one, if not given."""
    matches: Matches = NO_MATCHES
    """The same landmarks in further cameras; on keyframes."""
    miscalibrated: Matches = NO_MATCHES
    """The same, in cameras that are not where the calibration says: of use for nothing but to calibrate them."""
    zncc: Array = field(default_factory=lambda: np.zeros(0))
    """(N,) How much each looks like what was first seen of it: correlation, up to 1; all 1, if not given."""
    scale: Array = field(default_factory=lambda: np.zeros(0))
    """(N,) How many times larger each looks than when it was first seen; all 1, if not given."""

    def __post_init__(self) -> None:
        """Say that the first camera sees all, and sees it well, where nothing is said."""
        if len(self.camera) != len(self.ids):
            object.__setattr__(self, "camera", np.zeros(len(self.ids), np.int64))
        for name in ("zncc", "scale"):
            if len(getattr(self, name)) != len(self.ids):
                object.__setattr__(self, name, np.ones(len(self.ids)))

    def __len__(self) -> int:
        return len(self.ids)

    def without(self, ids: npt.NDArray[np.int64]) -> "Observations":
        """Return the observations of all but some features."""
        kept = ~np.isin(self.ids, ids)
        left = {f.name: getattr(self, f.name)[kept] for f in fields(self) if f.name not in ("matches", "miscalibrated")}
        return Observations(**left, matches=self.matches.without(ids), miscalibrated=self.miscalibrated.without(ids))


NOTHING_SEEN = Observations(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, np.int64))
"""Of a frame that shows no feature, or none that counts."""


@dataclass(frozen=True, eq=False)
class FramePacket:
    """A frame and the IMU before it."""

    t_ns: int
    """Time of the frame."""
    increments: Increments
    """The IMU since the previous frame."""
    observations: Observations
    """The features seen."""
