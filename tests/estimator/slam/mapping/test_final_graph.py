"""The pose graph of a final map: its loops by the final landmarks, and its poses as other programs find them."""

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest

from dronevio.estimator.backend.keyframe_estimate import KeyframeEstimate
from dronevio.estimator.backend.observations import ObservationTable
from dronevio.estimator.imu.preintegration import PreintegrationConfig, PreintegrationParams
from dronevio.estimator.slam.adjustment.bundle_adjustment import (
    AdjustmentConfig,
    AdjustmentInputs,
    AdjustmentKeyframe,
    adjust,
)
from dronevio.estimator.slam.adjustment.final_graph import at_optimum, measured_in_map
from dronevio.estimator.slam.files.g2o import write_g2o
from dronevio.estimator.slam.map.odometry_factors import GravityDirection, RelativePose
from dronevio.estimator.slam.map.pose_graph import ADJUSTED_VARIANCE, OptimizedGraph, PoseGraph, factor_graph
from dronevio.estimator.slam.places.localization import LocalizationConfig
from dronevio.estimator.types import Calibration
from dronevio.models.arrays import Array
from dronevio.models.imu import ImuSamples
from dronevio.models.rotation import exp_so3, inverse_pose, log_so3, pose_matrix
from dronevio.models.state import NavState
from tests.estimator.slam.conftest import RIG, pose

POSE = LocalizationConfig().pose
NUMBERS = 0, 1, 2, 9
"""Three keyframes that triangulate the landmarks, and one that sees them again."""


def read_by_gtsam(path: Path) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values, gtsam.Values]:
    """Return the factors of a g2o file, where the fixed vertex has a prior, its poses, and those that GTSAM finds."""
    factors, values = gtsam.readG2o(str(path), True)
    (fixed,) = (int(line.split()[1]) for line in path.read_text().splitlines() if line.startswith("FIX"))
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
    factors.add(gtsam.PriorFactorPose3(fixed, values.atPose3(fixed), noise))
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-10)
    return factors, values, gtsam.LevenbergMarquardtOptimizer(factors, values, params).optimize()


def test_written_poses_are_the_optimum_of_the_file(
    adjustment_inputs: AdjustmentInputs, graph_solution: OptimizedGraph, tmp_path: Path
) -> None:
    graph = graph_solution.without_rejected
    adjusted = adjust(adjustment_inputs, AdjustmentConfig()).poses
    graph = replace(graph, poses={**graph.poses, **adjusted})
    of_stages = tmp_path / "stages.g2o"  # poses of bundle adjustment, odometry from before it
    write_g2o(of_stages, graph)
    factors, values, found = read_by_gtsam(of_stages)
    assert factors.error(values) > 2.0 * factors.error(found)
    inputs = replace(
        adjustment_inputs, keyframes=[replace(k, T_map_imu=adjusted[k.number]) for k in adjustment_inputs.keyframes]
    )
    measured = measured_in_map(graph, inputs, AdjustmentConfig(), POSE)
    final = at_optimum(measured)
    path = tmp_path / "final.g2o"
    write_g2o(path, final)
    factors, values, found = read_by_gtsam(path)
    assert factors.size() - 1 == len(graph.odometry) + len(graph.loops)
    assert factors.error(values) == pytest.approx(factors.error(found), rel=0.01)
    assert factors.error(values) < 3.0 * len(graph.loops)  # half of the six that a loop is expected to have
    # GTSAM reads the covariances that the graph has.
    expected = factor_graph(relative_poses_of(final)).error(_values(final))
    assert factors.error(values) == pytest.approx(expected, rel=1e-6)
    for number, T in final.poses.items():
        np.testing.assert_allclose(values.atPose3(number).matrix(), T, atol=1e-9)
        assert np.linalg.norm(T[:3, 3] - graph.poses[number][:3, 3]) < 0.01
    np.testing.assert_allclose(final.poses[graph.first], graph.poses[graph.first], atol=1e-6)


def relative_poses_of(graph: PoseGraph) -> PoseGraph:
    """Return a graph with relative poses alone, but for the prior of its first keyframe."""
    return replace(graph, gravity=(), positions=(), joined=(), fixed=())


def _values(graph: PoseGraph) -> gtsam.Values:
    values = gtsam.Values()
    for number, T in graph.poses.items():
        values.insert(gtsam.symbol_shorthand.X(number), gtsam.Pose3(T))
    return values


def test_odometry_is_measured_at_the_final_poses(
    adjustment_inputs: AdjustmentInputs, graph_solution: OptimizedGraph
) -> None:
    graph = graph_solution.without_rejected
    until = graph.odometry[9].second
    smaller = [
        replace(each, covariance=ADJUSTED_VARIANCE * each.covariance) if each.second <= until else each
        for each in graph.odometry
    ]
    turned = {n: T @ pose_matrix(exp_so3(np.array([0.0, 0.0, 1e-3 * n])), np.zeros(3)) for n, T in graph.poses.items()}
    during = replace(graph, odometry=tuple(smaller), poses=turned)
    measured = measured_in_map(during, adjustment_inputs, AdjustmentConfig(), POSE, until)
    for before, after in zip(graph.odometry, measured.odometry, strict=True):
        np.testing.assert_allclose(after.covariance, before.covariance)
        T = inverse_pose(turned[after.first]) @ turned[after.second]
        np.testing.assert_allclose(after.T_first_second, T, atol=1e-12)
    assert measured.loops == graph.loops  # they have no observations


def looped() -> tuple[PoseGraph, AdjustmentInputs, Array]:
    """Return a graph with one loop, whose position was measured 10 % too small, its measurements and the true loop."""
    rng, camera = np.random.default_rng(3), RIG.cameras[0]
    poses = dict(zip(NUMBERS, (pose([0.0, 0.4 * i, 0.1 * i], 0.02 * i) for i in (0.0, 1.0, 2.0, 1.5)), strict=True))
    points = np.array([5.0, 0.4, 0.0]) + rng.uniform(-1.0, 1.0, (60, 3)) * [2.0, 1.5, 1.0]

    def observed(number: int, sigma: float) -> ObservationTable:
        T_cam_world = inverse_pose(poses[number] @ camera.T_imu_cam)
        p_cam = points @ T_cam_world[:3, :3].T + T_cam_world[:3, 3]
        xy = p_cam[:, :2] / p_cam[:, 2:] + 0.1 / camera.model.fx * rng.normal(size=(len(points), 2))
        none = np.zeros(len(points), np.int64)
        return ObservationTable(none + np.arange(60), none + number, none, xy, np.full(len(points), sigma), none)

    keyframes = [
        AdjustmentKeyframe(
            n,
            n * 10**9,
            poses[n],
            *(np.zeros(3), np.zeros(3), np.zeros(3), np.eye(6)),
            observed(n, 1.0),
            KeyframeEstimate.of_state(NavState(n * 10**9, poses[n], np.zeros(3), np.zeros(3), np.zeros(3))),
        )
        for n in NUMBERS
    ]
    keyframes[-1] = replace(keyframes[-1], observations=keyframes[-1].observations[:0])
    true = inverse_pose(poses[0]) @ poses[9]
    wrong = true.copy()
    wrong[:3, 3] *= 0.9
    loop = RelativePose.measured(0, 9, wrong, 1e-4 * np.eye(6), observed(9, 0.4))
    odometry = [RelativePose(a, b, np.eye(4), 1e-6 * np.eye(6)) for a, b in ((0, 1), (1, 2), (2, 9))]
    graph = PoseGraph(0, 1e-6 * np.eye(6), poses, tuple(odometry), loops=(loop,))
    nothing = ImuSamples.empty()
    params = PreintegrationParams.of(RIG.imu, PreintegrationConfig())
    inputs = AdjustmentInputs(keyframes, (loop,), nothing, RIG.imu, params, Calibration(RIG), 0, graph.first_covariance)
    return graph, inputs, true


def test_a_loop_is_measured_in_the_final_landmarks() -> None:
    """Its observations are right, but the landmarks of then were too near."""
    graph, inputs, true = looped()
    (loop,) = measured_in_map(graph, inputs, AdjustmentConfig(), POSE).loops
    error = inverse_pose(true) @ loop.T_first_second
    assert np.linalg.norm(error[:3, 3]) < 0.005 < np.linalg.norm((true - graph.loops[0].T_first_second)[:3, 3])
    residual = np.concatenate([log_so3(error[:3, :3]), error[:3, 3]])
    assert 0.1 < residual @ np.linalg.solve(loop.covariance, residual) < 17.0  # of χ² with six degrees of freedom, 99 %
    assert (loop.first, loop.second) == (0, 9) and loop.observations is graph.loops[0].observations
    # In the other direction, by the observations of the earlier keyframe.
    reverse = replace(graph.loops[0], first=9, second=0, T_first_second=inverse_pose(true))
    inputs = replace(inputs, loops=(reverse,))
    (loop,) = measured_in_map(replace(graph, loops=(reverse,)), inputs, AdjustmentConfig(), POSE).loops
    error = true @ loop.T_first_second
    assert np.linalg.norm(error[:3, 3]) < 0.005 and loop.T_first_second is not reverse.T_first_second


def test_a_loop_of_few_landmarks_stays_as_it_is() -> None:
    graph, inputs, _ = looped()
    few = replace(graph.loops[0], observations=graph.loops[0].observations[:5])
    measured = measured_in_map(replace(graph, loops=(few,)), inputs, AdjustmentConfig(), POSE)
    assert measured.loops == (few,)


def test_directions_of_gravity_do_not_count(graph_solution: OptimizedGraph) -> None:
    graph = graph_solution.without_rejected
    wrong = GravityDirection(max(graph.poses), np.array([1.0, 0.0, 0.0]), 1e-4)
    expected, found = at_optimum(graph).poses, at_optimum(replace(graph, gravity=(*graph.gravity, wrong))).poses
    for number, T in expected.items():
        np.testing.assert_array_equal(found[number], T)
