"""The keyframes of a map: poses, described corners of their images, and the landmarks that they observe."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array, Integers

Descriptors = npt.NDArray[np.uint8]

DESCRIPTOR_BYTES = 32
"""Number of bytes of a descriptor."""


@dataclass(frozen=True, eq=False)
class KeyframeFeatures:
    """Corners of the images of a keyframe."""

    pixels: Array
    """(N, 2) Image coordinates [px]."""
    xy: Array
    """(N, 2) Normalized, undistorted image coordinates."""
    camera: Integers
    """(N,) Index of the camera of each corner."""
    descriptors: Descriptors
    """(N, 32) Binary descriptors, 256 bits each."""
    landmark: Integers
    """(N,) Identity of the tracked landmark at the corner, -1 without one."""

    def __len__(self) -> int:
        """Return the number of corners."""
        return len(self.pixels)


NO_KEYFRAME_FEATURES = KeyframeFeatures(
    np.zeros((0, 2)),
    np.zeros((0, 2)),
    np.zeros(0, np.int64),
    np.zeros((0, DESCRIPTOR_BYTES), np.uint8),
    np.zeros(0, np.int64),
)
"""The features of a keyframe without images."""


@dataclass(frozen=True, eq=False)
class MapKeyframe:
    """A keyframe of the map."""

    number: int
    """Number of the keyframe, unique in the map and increasing."""
    t_ns: int
    """Time of the keyframe by the IMU's clock [ns]."""
    T_odom_imu: Array
    """(4, 4) Pose of the IMU in the odometry frame when the keyframe left the window."""
    features: KeyframeFeatures
    """Corners of its images."""
    landmark_ids: Integers
    """(L,) Identities of the triangulated landmarks that it observes, in increasing order."""
    landmarks_imu: Array
    """(L, 3) Positions of these landmarks in the IMU frame of the keyframe [m]."""
    track: int = 0
    """Number of the odometry frame. Each loss of the odometry begins another one."""

    @property
    def without_features(self) -> "MapKeyframe":
        """The keyframe without corners and landmarks, by which it can no longer be recognized."""
        none = np.zeros(0, np.int64), np.zeros((0, 3))
        return MapKeyframe(self.number, self.t_ns, self.T_odom_imu, NO_KEYFRAME_FEATURES, *none, self.track)
