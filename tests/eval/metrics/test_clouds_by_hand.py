"""Accuracy, completeness and F-score of point clouds, by hand."""

import numpy as np
import pytest

from dronevio.eval.metrics.clouds import CloudScore, compare_clouds, mesh_points, nearest_distances, voxel_means
from dronevio.models.errors import EvaluationError

TRUE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [3.0, 0.0, 0.0]])


def test_scores_of_four_points_by_hand() -> None:
    estimated = np.array([[0.0, 0.03, 0.0], [1.0, 0.0, 0.08], [9.0, 0.0, 0.0]])
    near, far = compare_clouds(TRUE, estimated, (0.05, 0.1))
    assert (near.accuracy, near.completeness) == pytest.approx((1 / 3, 1 / 4))
    assert (far.accuracy, far.completeness) == pytest.approx((2 / 3, 2 / 4))
    assert far.f_score == pytest.approx(2 * (2 / 3) * 0.5 / (2 / 3 + 0.5))


def test_a_distance_counts_up_to_the_limit() -> None:
    [score] = compare_clouds(TRUE, TRUE + [0.0, 0.5, 0.0], (0.5,))
    assert (score.accuracy, score.completeness, score.f_score) == (1.0, 1.0, 1.0)
    assert np.isinf(nearest_distances(TRUE, np.array([[9.0, 9.0, 9.0]]), 1.0)).all()


def test_scores_without_points() -> None:
    [score] = compare_clouds(TRUE, np.zeros((0, 3)), (0.1,))
    assert score == CloudScore(0.1, 0.0, 0.0)
    assert score.f_score == 0.0
    with pytest.raises(EvaluationError, match="true point cloud without points"):
        compare_clouds(np.zeros((0, 3)), TRUE, (0.1,))


def test_some_points_are_scored() -> None:
    estimated = TRUE + [[0.0, 0.5 * (k % 2), 0.0] for k in range(len(TRUE))]
    [score] = compare_clouds(TRUE, estimated, (0.1,), scored_true=TRUE[::2], scored_estimated=estimated[::2])
    assert (score.accuracy, score.completeness) == (1.0, 1.0)


def test_voxel_means_by_hand() -> None:
    points = np.array([[0.1, 0.1, 0.1], [0.3, 0.1, 0.5], [1.5, 0.0, 0.0], [-0.2, 0.0, 0.0]])
    found = voxel_means(points, 1.0)
    np.testing.assert_allclose(found, [[-0.2, 0.0, 0.0], [0.2, 0.1, 0.3], [1.5, 0.0, 0.0]])
    assert len(voxel_means(np.zeros((0, 3)), 1.0)) == 0


def test_points_on_triangles_by_hand() -> None:
    vertices = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 3.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.5, 1.0]])
    triangles = np.array([[0, 1, 2], [0, 3, 4]])
    found = mesh_points(vertices, triangles, 1.5)  # the longest edges are 4.24 and 1.12 long
    np.testing.assert_allclose(found[0], [0.0, 0.5 / 3.0, 2.0 / 3.0])  # the centroid of the smaller one
    assert len(found) == 1 + 6
    shares = (np.array([[2, 0, 0], [1, 1, 0], [1, 0, 1], [0, 2, 0], [0, 1, 1], [0, 0, 2]]) + 1.0 / 3.0) / 3.0
    expected = np.sort(3.0 * shares[:, 1:] @ [[1.0, 0.0], [0.0, 1.0]], axis=0)
    np.testing.assert_allclose(np.sort(found[1:, :2], axis=0), expected)
    assert not found[1:, 2].any()
    assert len(mesh_points(vertices, triangles[:0], 1.0)) == 0
