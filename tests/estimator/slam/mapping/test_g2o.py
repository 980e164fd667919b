"""Pose graphs as g2o files: read back by GTSAM, and information matrices by hand."""

from pathlib import Path
from typing import TYPE_CHECKING, cast

import gtsam
import numpy as np

from dronevio.estimator.slam.files.g2o import write_g2o
from dronevio.estimator.slam.map.odometry_factors import RelativePose
from dronevio.estimator.slam.map.pose_graph import PoseGraph
from dronevio.models.rotation import exp_so3, pose_matrix

if TYPE_CHECKING:
    from tests.estimator.slam.mapping.conftest import OdometryFlight

T_SECOND = pose_matrix(exp_so3(np.array([0.3, -0.2, 1.1])), np.array([1.0, 2.0, 3.0]))


def test_a_graph_is_read_back_by_gtsam(odometry_flight: "OdometryFlight", tmp_path: Path) -> None:
    _, mapped = odometry_flight.with_loops(every=3)
    graph = mapped.mapper.graph
    assert graph is not None
    write_g2o(tmp_path / "room.g2o", graph)
    factors, values = gtsam.readG2o(str(tmp_path / "room.g2o"), True)
    assert values.size() == len(graph.poses) and factors.size() == len(graph.odometry) + len(graph.loops)
    for number, T in graph.poses.items():
        np.testing.assert_allclose(values.atPose3(number).matrix(), T, atol=1e-9)
    read = [cast(gtsam.BetweenFactorPose3, factors.at(i)) for i in range(factors.size())]
    found = {tuple(factor.keys()): factor.measured().matrix() for factor in read}
    noises = {tuple(factor.keys()): cast(gtsam.noiseModel.Gaussian, factor.noiseModel()) for factor in read}
    for relative in (*graph.odometry, *graph.loops):
        of_edge = relative.first, relative.second
        np.testing.assert_allclose(found[of_edge], relative.T_first_second, atol=1e-9)
        sigmas = np.sqrt(np.diag(relative.covariance))
        error = (noises[of_edge].covariance() - relative.covariance) / np.outer(sigmas, sigmas)
        np.testing.assert_allclose(error, 0.0, atol=1e-6)


def test_lines_by_hand(tmp_path: Path) -> None:
    covariance = np.diag([0.1, 0.2, 0.5, 1.0, 2.0, 4.0])
    covariance[0, 3] = covariance[3, 0] = 0.1
    edge = RelativePose(4, 7, T_SECOND, covariance)
    write_g2o(tmp_path / "two.g2o", PoseGraph(4, np.eye(6), {4: np.eye(4), 7: T_SECOND}, (edge,)))
    lines = [line.split() for line in (tmp_path / "two.g2o").read_text(encoding="utf-8").splitlines()]
    assert [line[:2] for line in lines[:3]] == [["VERTEX_SE3:QUAT", "4"], ["VERTEX_SE3:QUAT", "7"], ["FIX", "4"]]
    assert lines[0][2:] == ["0.0", "0.0", "0.0", "0.0", "0.0", "0.0", "1.0"]
    assert lines[3][:3] == ["EDGE_SE3:QUAT", "4", "7"] and len(lines[3]) == 3 + 7 + 21
    information = np.zeros((6, 6))
    information[np.triu_indices(6)] = [float(word) for word in lines[3][10:]]
    # Position first, then the rotation vector, as GTSAM and Ceres read it.
    np.testing.assert_allclose(np.diag(information)[[1, 2]], [1 / 2.0, 1 / 4.0], rtol=1e-12)
    np.testing.assert_allclose(np.diag(information)[[4, 5]], [1 / 0.2, 1 / 0.5], rtol=1e-12)
    determinant = 0.1 * 1.0 - 0.1**2
    np.testing.assert_allclose(information[0, 0], 0.1 / determinant, rtol=1e-12)
    np.testing.assert_allclose(information[3, 3], 1.0 / determinant, rtol=1e-12)
    np.testing.assert_allclose(information[0, 3], -0.1 / determinant, rtol=1e-12)
