"""Choice of the images that each image is compared with, and of its depth range, from the points of a reconstruction.

Source: Goesele et al., "Multi-view stereo for community photo collections", ICCV 2007, section 4; Yao et al.,
"MVSNet", ECCV 2018, section 4.1 (score of a pair).
"""

from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array, tril

from dronevio.estimator.dense.config import ViewConfig
from dronevio.models.arrays import Array
from dronevio.models.reconstruction import Reconstruction

Indices = npt.NDArray[np.int64]

_NARROW_SHARE = 0.4  # standard deviation of the score below the preferred angle, relative to this angle
_WIDE_SHARE = 1.0  # standard deviation above


def select_neighbours(reconstruction: Reconstruction, config: ViewConfig) -> list[Indices]:
    """Return the neighbours of each image, best first.

    The score of a pair is the sum over the points that both observe of a weight of the angle between their rays, and of
    the ratio of their distances: small angles determine depths badly, large ones change the appearance.

    Args:
        reconstruction: Cameras and points.
        config: Settings.

    Returns:
        For each image, the indices of at most `neighbours` others; none if it has no point in common with another.
    """
    C = len(reconstruction.image_names)
    order = np.argsort(reconstruction.observation_image, kind="stable")
    starts = np.searchsorted(reconstruction.observation_image[order], np.arange(C + 1))
    observed = [np.unique(reconstruction.observation_point[order[a:b]]) for a, b in pairwise(starts)]
    scores = np.zeros((C, C))
    for i, j in _connected(reconstruction):
        points = reconstruction.points[np.intersect1d(observed[i], observed[j], assume_unique=True)]
        to_i, to_j = reconstruction.positions[i] - points, reconstruction.positions[j] - points
        scores[i, j] = scores[j, i] = _score(to_i, to_j, config)
    best = np.argsort(-scores, axis=1, kind="stable")[:, : config.neighbours]
    return [row[scores[i, row] > 0.0].astype(np.int64) for i, row in enumerate(best)]


def _connected(reconstruction: Reconstruction) -> list[tuple[int, int]]:
    """Return the pairs of images, the larger index first, that observe a point in common."""
    ones = np.ones(len(reconstruction.observation_px), np.int32)
    rows = reconstruction.observation_point, reconstruction.observation_image
    shape = len(reconstruction.points), len(reconstruction.image_names)
    observed = coo_array((ones, rows), shape=shape).tocsr()
    first, second = tril(observed.T @ observed, -1).nonzero()
    return list(zip(first.tolist(), second.tolist(), strict=True))


def _score(to_i: Array, to_j: Array, config: ViewConfig) -> float:
    """Return the score of two images from the vectors (N, 3), (N, 3) from their common points to them."""
    d_i, d_j = np.linalg.norm(to_i, axis=1), np.linalg.norm(to_j, axis=1)
    angle = np.degrees(np.arccos(np.clip(np.sum(to_i * to_j, axis=1) / (d_i * d_j), -1.0, 1.0)))
    sigma = config.angle_deg * np.where(angle < config.angle_deg, _NARROW_SHARE, _WIDE_SHARE)
    weight = np.exp(-0.5 * ((angle - config.angle_deg) / sigma) ** 2)
    ratio = np.minimum(d_i, d_j) / np.maximum(d_i, d_j)
    return float(np.sum(weight * ratio**2))


def observed_points(reconstruction: Reconstruction, image: int) -> Array:
    """Return the points (N, 3) in the world frame that an image observes in front of it."""
    points = reconstruction.points[reconstruction.observation_point[reconstruction.observation_image == image]]
    T = reconstruction.Ts_world_cam[image]
    return np.asarray(points[(points - T[:3, 3]) @ T[:3, 2] > 0.0])
