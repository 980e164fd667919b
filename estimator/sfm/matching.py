"""Matching of features: mutual nearest neighbours in the space of descriptors.

A match is accepted if its descriptor is clearly nearer than the second-nearest one (the ratio test of Lowe,
"Distinctive image features from scale-invariant keypoints", IJCV 2004) and if it is the nearest in both directions.
"""

import numpy as np
import numpy.typing as npt

from dronevio.estimator.sfm.config import MatchingConfig
from dronevio.estimator.sfm.features import Features

Matches = npt.NDArray[np.int64]

ROUNDING = 0.01
"""Distance of two descriptors that the rounding of their elements to bytes hides, √128 · 0.3 / 512 in each."""


def match_features(first: Features, second: Features, config: MatchingConfig) -> Matches:
    """Return the matches (K, 2) of two images: indices of features of the first and of the second."""
    if min(len(first), len(second)) < 2:
        return np.empty((0, 2), np.int64)
    similarity = _unit(first) @ _unit(second).T
    nearest = np.argmax(similarity, axis=1)
    best = similarity[np.arange(len(first)), nearest]
    # The maximum of each column is faster than its index by a factor of twenty; of equal rows, the first is taken.
    rows = np.flatnonzero(best == similarity.max(axis=0)[nearest])
    rows = np.sort(rows[np.unique(nearest[rows], return_index=True)[1]])
    nearest, best, candidates = nearest[rows], best[rows], similarity[rows]
    candidates[np.arange(len(rows)), nearest] = -1.0
    second_best = candidates.max(axis=1)
    distance, second_distance = (
        np.maximum(np.sqrt(np.maximum(2.0 - 2.0 * s, 0.0)), ROUNDING) for s in (best, second_best)
    )
    accepted = (distance <= config.ratio * second_distance) & (best >= np.cos(config.max_angle_rad))
    return np.column_stack([rows[accepted], nearest[accepted]]).astype(np.int64)


def _unit(features: Features) -> npt.NDArray[np.float32]:
    """Return descriptors (N, 128) of length 1."""
    descriptors = features.descriptors.astype(np.float32)
    return np.asarray(descriptors / np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1.0))
