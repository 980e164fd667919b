"""Observations of landmarks as a table: landmark, keyframe, camera, image coordinates and uncertainty of each."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Self

import numpy as np
import numpy.typing as npt

from dronevio.estimator.types import Observations
from dronevio.models.arrays import Array, Integers

DECORRELATION_SIGMA_SCALE = 20.0
"""Growth of a track's standard deviation with 1 − ZNCC to the first view, relative to a track whose ZNCC is 1."""

MATCH_SIGMA_SCALE = 2.6
"""Standard deviation of a stereo match relative to that of its track, whose error the match shares."""

CORRELATED_KEYFRAMES = 8.0
"""Number of earlier keyframes that see a landmark at which the variance of the next observation has doubled."""


@dataclass(frozen=True, eq=False)
class ObservationTable:
    """Observations of landmarks, one in each row."""

    landmark: Integers
    """(N,) Identities of the landmarks."""
    keyframe: Integers
    """(N,) Numbers of the keyframes."""
    camera: Integers
    """(N,) Indices of the cameras in the rig."""
    xy: Array
    """(N, 2) Normalized image coordinates: at depth 1 in the camera frame."""
    sigma_scale: Array
    """(N,) Standard deviation of each relative to an observation whose ZNCC is 1 and whose scale is at most 1."""
    earlier: Integers
    """(N,) Number of keyframes of the window that saw the landmark before the keyframe of the observation."""

    def __len__(self) -> int:
        """Return the number of observations."""
        return len(self.landmark)

    def __getitem__(self, rows: Integers | npt.NDArray[np.bool_] | slice) -> Self:
        """Return some of the rows."""
        indices = np.arange(len(self))[rows]
        return type(self)(  # `take` is much faster than a mask
            self.landmark.take(indices),
            self.keyframe.take(indices),
            self.camera.take(indices),
            self.xy.take(indices, axis=0),
            self.sigma_scale.take(indices),
            self.earlier.take(indices),
        )

    def __add__(self, other: Self) -> Self:
        """Return the rows of this table followed by those of another."""
        return self.concatenated([self, other])

    @classmethod
    def concatenated(cls, tables: Sequence[Self]) -> Self:
        """Return the rows of tables, one or more, in succession."""
        return cls(*(np.concatenate([getattr(table, each.name) for table in tables]) for each in fields(cls)))

    @property
    def variance_growth(self) -> Array:
        """(N,) Factors on the variances by which observations are weighted, 1 for the first one of a landmark.

        The errors of one track are correlated: its patch slides along edges, and its aspect changes. The error relative
        to the first keyframe is modelled as one that grows in proportion to the number of keyframes since then.
        """
        return np.asarray(1.0 + (self.earlier / CORRELATED_KEYFRAMES) ** 2)

    def keyframe_counts(self, landmarks: Integers) -> Integers:
        """Return the numbers (M,) of keyframes that observe each of some landmarks (M,)."""
        span = int(self.keyframe.max(initial=0)) + 1
        seen = np.unique(self.landmark * span + self.keyframe) // span
        return np.asarray(np.searchsorted(seen, landmarks, "right") - np.searchsorted(seen, landmarks, "left"))

    def by_landmark(self) -> Self:
        """Return the rows sorted by landmark; rows of the same landmark keep their order."""
        return self[np.argsort(self.landmark, kind="stable")]


def track_sigma_scale(observations: Observations) -> Array:
    """Return standard deviations (N,) of tracks relative to a track whose ZNCC is 1 and whose scale is at most 1.

    They grow with the decorrelation of the patch, and in proportion to its scale where the camera has come closer since
    the first view.
    """
    decorrelation = 1.0 + DECORRELATION_SIGMA_SCALE * (1.0 - observations.zncc)
    return np.asarray(np.maximum(observations.scale, 1.0) * decorrelation)


def observation_table(
    k: int, observations: Observations, match_sigma_scale: float = MATCH_SIGMA_SCALE
) -> ObservationTable:
    """Return the observations of a keyframe in all cameras as a table.

    The standard deviation of a track grows with the decorrelation of its patch, and in proportion to its scale where
    the camera has come closer since the first view. That of a stereo match is a multiple of its track's.

    Args:
        k: Number of the keyframe.
        observations: Tracks and stereo matches of the keyframe.
        match_sigma_scale: Standard deviation of a stereo match relative to that of its track.

    Returns:
        The tracks, then the stereo matches, as if no keyframe had seen them before.
    """
    o, m = observations, observations.matches
    of_tracks = track_sigma_scale(o)
    of_matches = np.maximum(o.scale, 1.0)[np.searchsorted(o.ids, m.ids)] * match_sigma_scale
    return ObservationTable(
        np.concatenate([o.ids, m.ids]),
        np.full(len(o) + len(m), k, dtype=np.int64),
        np.concatenate([o.camera, m.camera]),
        np.concatenate([o.xy, m.xy]),
        np.concatenate([of_tracks, of_matches]),
        np.zeros(len(o) + len(m), np.int64),
    )


NO_OBSERVATIONS = ObservationTable(
    np.zeros(0, np.int64),
    np.zeros(0, np.int64),
    np.zeros(0, np.int64),
    np.zeros((0, 2)),
    np.zeros(0),
    np.zeros(0, np.int64),
)
"""A table without rows."""
