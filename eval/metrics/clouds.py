"""Accuracy, completeness and F-score of a point cloud.

Source: Knapitsch et al., "Tanks and Temples: benchmarking large-scale scene reconstruction", ACM Transactions on
Graphics 2017, section 4.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.errors import EvaluationError


@dataclass(frozen=True)
class CloudScore:
    """Agreement of an estimated cloud with the true one at one distance."""

    distance_m: float
    """Distance below which a point counts as right [m]."""
    accuracy: float
    """Share of the estimated points within the distance of a true one (precision), 0 to 1."""
    completeness: float
    """Share of the true points within the distance of an estimated one (recall), 0 to 1."""

    @property
    def f_score(self) -> float:
        """Harmonic mean of accuracy and completeness, 0 to 1."""
        total = self.accuracy + self.completeness
        return 2.0 * self.accuracy * self.completeness / total if total > 0.0 else 0.0


def compare_clouds(
    true: Array,
    estimated: Array,
    distances_m: Sequence[float],
    *,
    scored_true: Array | None = None,
    scored_estimated: Array | None = None,
) -> tuple[CloudScore, ...]:
    """Return the agreement of two point clouds in the same frame at some distances.

    Both should have an even density, for example that of `voxel_means`, since each point counts once.

    Args:
        true: (N, 3) True points [m].
        estimated: (M, 3) Estimated points [m].
        distances_m: Distances below which a point counts as right [m].
        scored_true: (K, 3) The true points that are counted, if not all.
        scored_estimated: (L, 3) The estimated points that are counted, if not all.

    Raises:
        EvaluationError: There are no true points.
    """
    if not len(true):
        raise EvaluationError("a true point cloud without points; expected at least one")
    if not len(estimated):
        return tuple(CloudScore(float(d), 0.0, 0.0) for d in distances_m)
    limit = max(distances_m)
    to_true = nearest_distances(estimated if scored_estimated is None else scored_estimated, true, limit)
    to_estimated = nearest_distances(true if scored_true is None else scored_true, estimated, limit)
    return tuple(
        CloudScore(float(d), float(np.mean(to_true <= d)), float(np.mean(to_estimated <= d))) for d in distances_m
    )


def nearest_distances(points: Array, others: Array, limit: float) -> Array:
    """Return the distance (N,) from each point (N, 3) to the nearest of others (M, 3), infinite beyond a limit."""
    from scipy.spatial import cKDTree

    tree = cKDTree(others, balanced_tree=False, compact_nodes=False)  # faster to build, and as exact
    distances, _ = tree.query(points, distance_upper_bound=np.nextafter(limit, np.inf))
    return np.asarray(distances)


def voxel_means(points: Array, side: float) -> Array:
    """Return the mean (V, 3) of the points (N, 3) in each occupied voxel of a grid, in the order of the voxels."""
    if not len(points):
        return points
    cells = np.floor(points / side).astype(np.int64)
    cells -= cells.min(axis=0)
    _, voxel = np.unique(np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0) + 1)), return_inverse=True)
    count = np.bincount(voxel)
    return np.stack([np.bincount(voxel, column) / count for column in points.T], axis=1)


def mesh_points(vertices: Array, triangles: npt.NDArray[np.int64], spacing: float) -> Array:
    """Return points (N, 3 + K) on triangles, at least one on each.

    A triangle whose longest edge has the length L is divided into n² equal ones, n = ⌈L / spacing⌉. The centroids of
    those that are not turned upside down are returned.

    Args:
        vertices: (V, 3 + K) Vertices, with further values that are interpolated.
        triangles: (F, 3) Indices of the vertices of the triangles.
        spacing: Largest distance between neighbouring points of a triangle.
    """
    corners = vertices[triangles]
    edges = corners[..., :3] - np.roll(corners[..., :3], 1, axis=1)
    longest = np.sqrt(np.max(np.sum(edges**2, axis=2), axis=1, initial=0.0))
    count = np.maximum(np.ceil(longest / spacing).astype(np.int64), 1)
    samples = [np.zeros((0, vertices.shape[1]))]
    for n in np.unique(count).tolist():
        i, j = np.divmod(np.arange(n * n), n)
        i, j = i[i + j < n], j[i + j < n]
        shares = (np.stack([i, j, n - 1 - i - j], axis=1) + 1.0 / 3.0) / n
        samples.append(np.einsum("sk,fkd->fsd", shares, corners[count == n]).reshape(-1, vertices.shape[1]))
    return np.concatenate(samples)
