"""Triangulation of tracks that contain outliers.

The hypotheses of RANSAC are the midpoints of pairs of rays; the consensus is refined by the nearest point to its rays,
weighted by the inverse squared distance, which approximates the sum of the squared angles. All tracks are processed at
once: the observations of a track are contiguous.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.estimator.sfm.bearings import angles_between_rad, midpoints
from dronevio.estimator.sfm.config import TriangulationConfig
from dronevio.models.arrays import Array, Mask

Indices = npt.NDArray[np.int64]

HYPOTHESES = 8
"""Number of pairs of rays of a track that are tried."""
REFINEMENTS = 2
"""Number of refinements of the consensus."""


@dataclass(frozen=True, eq=False)
class Triangulated:
    """Result of the triangulation of L tracks with M observations."""

    points: Array
    """(L, 3) Points, NaN for tracks that are not triangulated."""
    is_inlier: Mask
    """(M,) Observations that agree with the points."""


def triangulate_tracks(
    track: Indices,
    origins: Array,
    rays: Array,
    focal_px: Array,
    config: TriangulationConfig,
    rng: np.random.Generator,
) -> Triangulated:
    """Triangulate L tracks.

    Args:
        track: (M,) Track of each observation, non-decreasing, from 0 to L − 1, each at least once.
        origins: (M, 3) Positions of the cameras in the world frame.
        rays: (M, 3) Unit rays in the world frame.
        focal_px: (M,) Focal lengths, which turn angles into pixels [px].
        config: Thresholds.
        rng: Random generator that draws the pairs.
    """
    if len(track) == 0:
        return Triangulated(np.empty((0, 3)), np.empty(0, np.bool_))
    counts = np.bincount(track)
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    threshold_rad = config.max_error_px / focal_px

    # RANSAC over pairs of rays, for all tracks together
    best_points = np.full((len(counts), 3), np.nan)
    best_score = np.zeros(len(counts))
    for number in range(HYPOTHESES):
        first = np.zeros(len(counts), np.int64) if number == 0 else _draw(rng, counts)
        other = counts - 1 if number == 0 else (first + 1 + _draw(rng, np.maximum(counts - 1, 1))) % counts
        a, b = starts + first, starts + other
        points = midpoints(origins[a], rays[a], origins[b], rays[b])
        # The angle breaks ties between hypotheses with equally many inliers.
        angle = angles_between_rad(rays[a], rays[b])
        inliers = _angles(points[track], origins, rays) < threshold_rad
        score = np.add.reduceat(inliers.astype(np.float64), starts) + 0.5 * np.minimum(angle, 1.0)
        better = (score > best_score) & np.isfinite(points[:, 0])
        best_points[better], best_score[better] = points[better], score[better]

    # Refinement by the inliers, in weighted least squares
    points = best_points
    for _ in range(REFINEMENTS):
        is_inlier = _angles(points[track], origins, rays) < threshold_rad
        distance = np.linalg.norm(points[track] - origins, axis=1)
        weights = np.where(is_inlier, 1.0 / np.maximum(distance, 1e-12) ** 2, 0.0)
        points = _nearest_points(starts, origins, rays, np.nan_to_num(weights))
    is_inlier = _angles(points[track], origins, rays) < threshold_rad
    # Points with two inliers under a sufficient angle
    enough = np.add.reduceat(is_inlier.astype(np.int64), starts) >= 2
    wide = widest_angles(track, starts, points, origins, is_inlier) >= np.radians(config.min_angle_deg)
    accepted = enough & wide
    return Triangulated(np.where(accepted[:, None], points, np.nan), is_inlier & accepted[track])


def widest_angles(track: Indices, starts: Indices, points: Array, origins: Array, is_inlier: Mask) -> Array:
    """Return the largest angle (L,) between the inlier rays of each point, to within a factor of two [rad].

    The angle is that between the ray farthest from an arbitrary one and the ray farthest from that.
    """
    directions = origins - points[track]
    first = _arg_extreme(track, starts, np.where(is_inlier, 1.0, -1.0))
    angle = np.where(is_inlier, angles_between_rad(directions, directions[first][track]), -1.0)
    farthest = _arg_extreme(track, starts, np.nan_to_num(angle, nan=-1.0))
    angle = np.where(is_inlier, angles_between_rad(directions, directions[farthest][track]), 0.0)
    return np.asarray(np.maximum.reduceat(np.nan_to_num(angle), starts))


def _arg_extreme(track: Indices, starts: Indices, values: Array) -> Indices:
    """Return the index (L,) of the first largest value of each track."""
    largest = np.maximum.reduceat(values, starts)
    hits = np.flatnonzero(values == largest[track])
    _, position = np.unique(track[hits], return_index=True)
    return np.asarray(hits[position])


def _draw(rng: np.random.Generator, counts: Indices) -> Indices:
    return (rng.random(len(counts)) * counts).astype(np.int64)


def _angles(points: Array, origins: Array, rays: Array) -> Array:
    """Return the angles (M,) between rays and the directions to points [rad]; infinite for undefined points."""
    angle = angles_between_rad(points - origins, rays)
    return np.where(np.isfinite(angle), angle, np.inf)


def _nearest_points(starts: Indices, origins: Array, rays: Array, weights: Array) -> Array:
    """Return the points (L, 3) nearest to the rays of each track; NaN where they are parallel."""
    projectors = weights[:, None, None] * (np.eye(3) - rays[:, :, None] * rays[:, None, :])
    A = np.add.reduceat(projectors, starts, axis=0)
    b = np.add.reduceat(np.einsum("mij,mj->mi", projectors, origins), starts, axis=0)
    scale = np.maximum(np.trace(A, axis1=1, axis2=2), 1e-300)
    is_defined = np.linalg.det(A / scale[:, None, None]) > 1e-9
    A = np.where(is_defined[:, None, None], A, np.eye(3))
    return np.where(is_defined[:, None], np.linalg.solve(A, b[..., None])[..., 0], np.nan)
