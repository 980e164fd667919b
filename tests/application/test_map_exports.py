"""The script that compares what leaves a map with the truth: normalized errors, and files by GTSAM."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dronevio.estimator.slam.files.g2o import write_g2o
from dronevio.estimator.slam.map.odometry_factors import RelativePose
from dronevio.estimator.slam.map.pose_graph import PoseGraph
from dronevio.models.rotation import pose_matrix, rotation_z


@pytest.fixture(scope="module")
def map_exports(script: Callable[[str], Any]) -> Any:
    """The script."""
    return script("map_exports")


def row(*x_m: float) -> dict[int, Any]:
    """Return poses along the x axis."""
    return {number: pose_matrix(np.eye(3), np.array([x, 0.0, 0.0])) for number, x in enumerate(x_m)}


def test_normalized_errors_by_hand(map_exports: Any) -> None:
    covariance = np.diag([1e-4, 1e-4, 1e-4, 0.04, 0.04, 0.04])
    turned = pose_matrix(rotation_z(0.02), np.array([1.0, 0.0, 0.0]))
    edges = [RelativePose(0, 1, row(0.0, 1.4)[1], covariance), RelativePose(1, 2, turned, covariance)]
    found = map_exports.consistency(edges, row(0.0, 1.0, 2.0))
    # 0.4 m of 0.2 m, and 0.02 rad of 0.01 rad: four each.
    assert (found.count, found.position_mm) == (2, pytest.approx(1e3 * np.sqrt(0.4**2 / 2.0)))
    assert (found.nees, found.rotation_nees, found.position_nees) == pytest.approx((4.0, 2.0, 2.0), rel=1e-6)
    assert map_exports.consistency([], {}) is None


def test_half_of_chi2_of_a_file(map_exports: Any, tmp_path: Path) -> None:
    """A loop says 2.4 m, the odometry twice 1 m: a third of the difference remains in each edge."""
    poses, covariance = row(0.0, 1.0, 2.0), 0.01 * np.eye(6)
    edges = [RelativePose(a, b, row(0.0, x)[1], covariance) for a, b, x in ((0, 1, 1.0), (1, 2, 1.0), (0, 2, 2.4))]
    write_g2o(tmp_path / "row.g2o", PoseGraph(0, np.eye(6), poses, tuple(edges)))
    found = map_exports.optimized_by_gtsam(tmp_path / "row.g2o")
    assert found == (3, pytest.approx(0.5 * 0.4**2 / 0.01), pytest.approx(0.5 * 3 * (0.4 / 3) ** 2 / 0.01, rel=1e-3))
