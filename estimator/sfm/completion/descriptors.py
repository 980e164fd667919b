"""Descriptors of tracks: the mean of those of their observations."""

from collections.abc import Sequence

import numpy as np

from dronevio.estimator.sfm.features import Features
from dronevio.estimator.sfm.model import Scene
from dronevio.models.arrays import Floats, Mask


def unit_descriptors(features: Features) -> Floats:
    """Return the descriptors (N, 128) of an image with length 1."""
    values = features.descriptors.astype(np.float32)
    return np.asarray(values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1.0))


def track_descriptors(scene: Scene, used: Mask, features: Sequence[Features]) -> Floats:
    """Return the mean descriptor (T, 128) of the used observations of each track, of length 1; 0 for unused tracks."""
    sums = np.zeros((scene.tracks.count, 128), np.float32)
    for image in np.unique(scene.tracks.image[used]).tolist():
        index = scene.tracks.of_image(image)
        index = index[used[index]]
        # A track has at most one feature of an image, so that no row is added twice.
        sums[scene.tracks.track[index]] += unit_descriptors(features[image])[scene.tracks.feature[index]]
    return np.asarray(sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-9))
