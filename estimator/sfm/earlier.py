"""Continuation of an earlier reconstruction: its cameras, poses and tracks for a set of images that contains its own.

The tracks of the earlier reconstruction are found again among the features of its images by their pixels, so that its
images are not matched to each other again.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.spatial import cKDTree

from dronevio.estimator.sfm.features import Features
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError
from dronevio.models.image_sets import ImageSet
from dronevio.models.reconstruction import Reconstruction

Indices = npt.NDArray[np.int64]

MAX_DISTANCE_PX = 1.0
"""Largest distance between an earlier observation and the feature that is identified with it [px]."""
MIN_FOUND = 0.5
"""Smallest share of the earlier observations that are found again; below it, all pairs are matched anew."""
SAME_CAMERA = 1e-6
"""Largest relative difference between the parameters of two calibrations of a camera."""


@dataclass(frozen=True, eq=False)
class EarlierPair:
    """Two images with the observations that they share in an earlier reconstruction."""

    first: int
    """Index of the first image."""
    second: int
    """Index of the second image."""
    matches: Indices
    """(K, 2) Indices of features of the first image and of the second that observe a point."""


def earlier_images(images: ImageSet, earlier: Reconstruction) -> Indices:
    """Return the index (C,) in a set of each image of an earlier reconstruction.

    Raises:
        ConfigError: An image is not in the set.
    """
    row = {name: i for i, name in enumerate(images.names)}
    missing = [name for name in earlier.image_names if name not in row]
    if missing:
        raise ConfigError(f"the image {missing[0]} of the earlier reconstruction is not in the set of images")
    return np.array([row[name] for name in earlier.image_names], np.int64)


def earlier_cameras(images: ImageSet, earlier: Reconstruction) -> tuple[CameraModel, ...]:
    """Return the cameras (K,) of a set of images, with the models of an earlier reconstruction where it has them.

    Raises:
        ConfigError: A camera has another size or calibration than in the earlier reconstruction, or several models
            there.
    """
    cameras = list(images.cameras)
    known: dict[int, int] = {}
    for image, number, name in zip(
        earlier_images(images, earlier), earlier.image_camera.tolist(), earlier.image_names, strict=True
    ):
        k = int(images.image_camera[image])
        if known.setdefault(k, number) != number:
            raise ConfigError(
                f"{name}: the images have one camera here, and several in the earlier reconstruction; expected the same"
                " option --camera for both"
            )
        given, other = images.cameras[k], earlier.cameras[number]
        if (given.width, given.height) != (other.width, other.height):
            raise ConfigError(
                f"{name}: {given.width} × {given.height} px; expected {other.width} × {other.height} px as in the"
                " earlier reconstruction"
            )
        if images.is_calibrated[k] and not _is_same(given, other):
            raise ConfigError(
                f"{name}: the calibration has {_text(given)}, and the earlier reconstruction {_text(other)}; expected"
                " the same"
            )
        cameras[k] = given if images.is_calibrated[k] else other
    return tuple(cameras)


def earlier_pairs(index: Indices, earlier: Reconstruction, features: list[Features]) -> list[EarlierPair] | None:
    """Return the pairs of earlier images with the tracks that they share, None if too few observations are found again.

    Of each track, neighbours and next neighbours in the order of the images are paired, which connects it.

    Args:
        index: (C,) Index of each image of the earlier reconstruction.
        earlier: The earlier reconstruction.
        features: (I,) Features of all images.
    """
    feature = _identify(index, earlier, features)
    if np.mean(feature >= 0) < MIN_FOUND:
        return None
    image = index[earlier.observation_image]
    kept = np.flatnonzero(feature >= 0)
    kept = kept[np.lexsort([image[kept], earlier.observation_point[kept]])]
    point, image, feature = earlier.observation_point[kept], image[kept], feature[kept]
    rows = []
    for step in (1, 2):
        a = np.arange(len(kept) - step)
        a = a[(point[a] == point[a + step]) & (image[a] != image[a + step])]
        rows.append(np.column_stack([image[a], image[a + step], feature[a], feature[a + step]]))
    edges = np.unique(np.concatenate(rows), axis=0)
    pairs, starts = np.unique(edges[:, :2], axis=0, return_index=True)
    parts = np.split(edges[:, 2:], starts[1:])
    return [EarlierPair(int(i), int(j), part) for (i, j), part in zip(pairs, parts, strict=True)] if len(edges) else []


def shared_points(index: Indices, earlier: Reconstruction, count: int) -> Indices:
    """Return the number (I, I) of points that each two of ``count`` images observe in the earlier reconstruction."""
    ones = np.ones(len(earlier.observation_px), np.int64)
    rows = earlier.observation_point, index[earlier.observation_image]
    observed = coo_array((ones, rows), shape=(len(earlier.points), count)).tocsr()
    observed.data[:] = 1  # a point that an image observes twice counts once
    shared = np.asarray((observed.T @ observed).todense(), np.int64)
    np.fill_diagonal(shared, 0)
    return shared


def _identify(index: Indices, earlier: Reconstruction, features: list[Features]) -> Indices:
    """Return the feature (M,) of each earlier observation, −1 without one; each feature is used once in a track."""
    feature = np.full(len(earlier.observation_px), -1, np.int64)
    for number, image in enumerate(index.tolist()):
        rows = np.flatnonzero(earlier.observation_image == number)
        if len(rows) == 0 or len(features[image]) == 0:
            continue
        distance, nearest = cKDTree(features[image].pixels).query(earlier.observation_px[rows])
        order = np.argsort(distance, kind="stable")
        _, first = np.unique(nearest[order], return_index=True)  # of several observations, the nearest has the feature
        chosen = order[first]
        chosen = chosen[distance[chosen] <= MAX_DISTANCE_PX]
        feature[rows[chosen]] = nearest[chosen]
    return feature


def _is_same(first: CameraModel, second: CameraModel) -> bool:
    if (first.lens, len(first.distortion)) != (second.lens, len(second.distortion)):
        return False
    a, b = (np.array([c.fx, c.fy, c.cx, c.cy, *(c.fx * np.array(c.distortion))]) for c in (first, second))
    return bool(np.all(np.abs(a - b) <= SAME_CAMERA * first.fx))


def _text(camera: CameraModel) -> str:
    """Return the parameters of a camera for error messages."""
    distortion = ", ".join(f"{k:.4g}" for k in camera.distortion)
    return f"{camera.lens} fx {camera.fx:.2f}, fy {camera.fy:.2f}, distortion {distortion}"
