"""ObservationTable: which landmark was seen from which keyframe, by which camera, and where in its image."""

from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from dronevio.estimator.types import Observations

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

DECORRELATION_SIGMA_SCALE = 20.0
"""How the error of a track grows with 1 − correlation between what is seen now and what was seen first: measured on
rendered flights, from .06 px above .98 to .4 px at .90."""

MATCH_SIGMA_SCALE = 2.6
"""What a further camera sees was looked for with the patch of the first: where that was off, both are. With this,
positions of simulated flights from two cameras are as sure as their covariances say."""


@dataclass(frozen=True, eq=False)
class ObservationTable:
    """A table of observations, a column a field."""

    landmark: Integers
    """(N,) Identities of the landmarks."""
    keyframe: Integers
    """(N,) Numbers of the keyframes."""
    camera: Integers
    """(N,) Cameras of the rig."""
    xy: Array
    """(N, 2) Normalized coordinates: at depth 1 in the camera's frame."""
    sigma_scale: Array
    """(N,) How many times less certain each is than one of the best quality that is no nearer than at first."""

    def __len__(self) -> int:
        return len(self.landmark)

    def __getitem__(self, rows: Integers | npt.NDArray[np.bool_] | slice) -> Self:
        """Return some rows."""
        return type(self)(
            self.landmark[rows], self.keyframe[rows], self.camera[rows], self.xy[rows], self.sigma_scale[rows]
        )

    def __add__(self, other: Self) -> Self:
        """Return the rows of both."""
        return type(self)(
            np.concatenate([self.landmark, other.landmark]),
            np.concatenate([self.keyframe, other.keyframe]),
            np.concatenate([self.camera, other.camera]),
            np.concatenate([self.xy, other.xy]),
            np.concatenate([self.sigma_scale, other.sigma_scale]),
        )

    def by_landmark(self) -> Self:
        """Return the rows sorted by landmark, those of each in the order in which they came."""
        return self[np.argsort(self.landmark, kind="stable")]


def observation_table(k: int, observations: Observations) -> ObservationTable:
    """Return what keyframe k shows, in all cameras.

    A patch is where its landmark is up to an error that grows with it as the camera comes nearer: on rendered flights,
    tracks err by .09 px where they look as large as at first, by .15 px at 1.5 times that, and by .2 px at 1.9 times.
    """
    o, m = observations, observations.matches
    nearer = np.maximum(o.scale, 1.0)
    followed = nearer * (1.0 + DECORRELATION_SIGMA_SCALE * (1.0 - o.zncc))
    matched = nearer[np.searchsorted(o.ids, m.ids)] * MATCH_SIGMA_SCALE
    return ObservationTable(
        np.concatenate([o.ids, m.ids]),
        np.full(len(o) + len(m), k, dtype=np.int64),
        np.concatenate([o.camera, m.camera]),
        np.concatenate([o.xy, m.xy]),
        np.concatenate([followed, matched]),
    )


NO_OBSERVATIONS = ObservationTable(
    np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0)
)
"""No observations."""
