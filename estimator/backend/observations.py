"""Sightings: which landmark was seen from which keyframe, by which camera, and where in its image."""

from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from dronevio.estimator.types import Observations

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

DOUBT_OF_UNLIKENESS = 20.0
"""How the error of a track grows with 1 − correlation between what is seen now and what was seen first: measured on
rendered flights, from .06 px above .98 to .4 px at .90."""

DOUBT_OF_MATCHES = 2.6
"""What a further camera sees was looked for with the patch of the first: where that was off, both are. With this,
positions of simulated flights from two cameras are as sure as their covariances say."""


@dataclass(frozen=True, eq=False)
class Sightings:
    """A table of sightings, a column a field."""

    landmark: Integers
    """(N,) Identities of the landmarks."""
    keyframe: Integers
    """(N,) Numbers of the keyframes."""
    camera: Integers
    """(N,) Cameras of the rig."""
    xy: Array
    """(N, 2) Normalised coordinates: at depth 1 in the camera's frame."""
    doubt: Array
    """(N,) How many times less certain each is than one of the best quality that is no nearer than at first."""

    def __len__(self) -> int:
        return len(self.landmark)

    def __getitem__(self, rows: Integers | npt.NDArray[np.bool_] | slice) -> Self:
        """Return some rows."""
        return type(self)(self.landmark[rows], self.keyframe[rows], self.camera[rows], self.xy[rows], self.doubt[rows])

    def __add__(self, other: Self) -> Self:
        """Return the rows of both."""
        return type(self)(
            np.concatenate([self.landmark, other.landmark]),
            np.concatenate([self.keyframe, other.keyframe]),
            np.concatenate([self.camera, other.camera]),
            np.concatenate([self.xy, other.xy]),
            np.concatenate([self.doubt, other.doubt]),
        )

    def by_landmark(self) -> Self:
        """Return the rows sorted by landmark, those of each in the order in which they came."""
        return self[np.argsort(self.landmark, kind="stable")]


def sightings_of(k: int, observations: Observations) -> Sightings:
    """Return what keyframe k shows, in all cameras.

    A patch is where its landmark is up to an error that grows with it as the camera comes nearer: on rendered flights,
    tracks err by .09 px where they look as large as at first, by .15 px at 1.5 times that, and by .2 px at 1.9 times.
    """
    o, m = observations, observations.matches
    nearer = np.maximum(o.zoom, 1.0)
    followed = nearer * (1.0 + DOUBT_OF_UNLIKENESS * (1.0 - o.quality))
    matched = nearer[np.searchsorted(o.ids, m.ids)] * DOUBT_OF_MATCHES
    return Sightings(
        np.concatenate([o.ids, m.ids]),
        np.full(len(o) + len(m), k, dtype=np.int64),
        np.concatenate([o.camera, m.camera]),
        np.concatenate([o.xy, m.xy]),
        np.concatenate([followed, matched]),
    )


NONE = Sightings(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0))
"""No sightings."""
