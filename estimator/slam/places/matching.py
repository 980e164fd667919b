"""Matching of the landmarks of one keyframe with the corners of another one, by their descriptors."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt

from dronevio.estimator.backend.observations import ObservationTable
from dronevio.estimator.slam.map.keyframe import MapKeyframe
from dronevio.estimator.slam.places.vocabulary import hamming_distances
from dronevio.models.arrays import Array, Integers
from dronevio.models.ranges import Range, Settings


@dataclass(frozen=True)
class DescriptorMatchingConfig(Settings):
    """When a landmark and a corner match."""

    max_distance: Annotated[int, Range(0, 256)] = 64
    """Largest number of bits in which the descriptors of a match differ."""
    ratio: Annotated[float, Range(0.0, 1.0)] = 0.85
    """Largest ratio of the distance of a match to that of the second-nearest corner."""


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Landmarks of one keyframe that are matched with corners of another one."""

    landmark: Integers
    """(N,) Identities of the landmarks."""
    points: Array
    """(N, 3) Positions of the landmarks in the IMU frame of their keyframe [m]."""
    point_camera: Integers
    """(N,) Index of the camera that observes each landmark in its own keyframe."""
    xy: Array
    """(N, 2) Normalized coordinates of the corners in the other keyframe."""
    camera: Integers
    """(N,) Index of the camera of each corner."""

    def __len__(self) -> int:
        """Return the number of correspondences."""
        return len(self.points)

    def __getitem__(self, rows: npt.NDArray[np.bool_] | Integers) -> "Correspondences":
        """Return some of the correspondences."""
        return Correspondences(
            self.landmark[rows], self.points[rows], self.point_camera[rows], self.xy[rows], self.camera[rows]
        )

    def observed_by(self, keyframe: int, sigma_px: float) -> ObservationTable:
        """Return the corners as observations of the landmarks by a keyframe.

        Args:
            keyframe: Number of the keyframe of the corners.
            sigma_px: Standard deviation of a corner [px], the scale of the observations' standard deviations.
        """
        count, none = len(self), np.zeros(len(self), np.int64)
        return ObservationTable(
            self.landmark, np.full(count, keyframe), self.camera, self.xy, np.full(count, sigma_px), none
        )


def match_landmarks(owner: MapKeyframe, other: MapKeyframe, config: DescriptorMatchingConfig) -> Correspondences:
    """Return the landmarks of one keyframe that match a corner of another one.

    A match is the nearest corner of a landmark, clearly nearer than the second-nearest one (Lowe, IJCV 2004), and the
    landmark is the nearest one of the corner.

    Args:
        owner: The keyframe whose landmarks are used.
        other: The keyframe whose corners are used.
        config: Settings.
    """
    rows, landmark = described_landmarks(owner)
    corners = other.features
    if not len(rows) or len(corners) < 2:
        nothing = np.zeros(0, np.int64)
        return Correspondences(nothing, np.zeros((0, 3)), nothing, np.zeros((0, 2)), nothing)
    distance = hamming_distances(owner.features.descriptors[rows], corners.descriptors)
    two = np.argpartition(distance, 1, axis=1)[:, :2]
    pair = np.take_along_axis(distance, two, axis=1).astype(np.float64)
    # Of two equally near corners, none passes the test of the ratio.
    nearest = np.where(pair[:, 0] <= pair[:, 1], two[:, 0], two[:, 1])
    best, second = pair.min(axis=1), pair.max(axis=1)
    of_corner = distance.argmin(axis=0)
    is_match = (best <= config.max_distance) & (best < config.ratio * second)
    is_match &= of_corner[nearest] == np.arange(len(rows))
    rows, landmark, nearest = rows[is_match], landmark[is_match], nearest[is_match]
    return Correspondences(
        owner.landmark_ids[landmark],
        owner.landmarks_imu[landmark],
        owner.features.camera[rows],
        corners.xy[nearest],
        corners.camera[nearest],
    )


def described_landmarks(keyframe: MapKeyframe) -> tuple[Integers, Integers]:
    """Return the rows (N,) of the corners of a keyframe with a triangulated landmark, and the rows (N,) of those."""
    identities = keyframe.features.landmark
    if not len(keyframe.landmark_ids):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    place = np.minimum(np.searchsorted(keyframe.landmark_ids, identities), len(keyframe.landmark_ids) - 1)
    rows = np.flatnonzero((keyframe.landmark_ids[place] == identities) & (identities >= 0))
    return rows, place[rows]
