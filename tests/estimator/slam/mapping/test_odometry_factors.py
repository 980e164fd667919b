"""Frames of the covariances of relative poses, and the factors of an odometry whose drift is known."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from dronevio.estimator.backend.keyframe_estimate import KeyframeEstimate
from dronevio.estimator.slam.map.odometry_factors import (
    MAX_DECREASE,
    OdometryFactors,
    RelativePose,
    first_node,
    odometry_factors,
    scaled,
)
from dronevio.estimator.slam.map.pose_graph import PoseGraph, joined_graphs, optimize
from dronevio.models.arrays import Array
from dronevio.models.rotation import inverse_pose, pose_matrix, rotation_z
from tests.estimator.slam.mapping.conftest import marginal_covariance

NO_LANDMARKS = np.zeros(0, np.int64), np.zeros((0, 3))


@dataclass(frozen=True)
class Drift:
    """Variances of an odometry at one keyframe; the tilt is known to 1 mrad."""

    yaw: float
    """Variance of the yaw [rad²]."""
    position: float
    """Variance of each component of the position [m²]."""


def estimate(index: int, T_odom_imu: Array, drift: Drift, tilt: float = 1e-6) -> KeyframeEstimate:
    """Return a keyframe every 0.2 s, whose relative covariance within the window is small."""
    covariance = np.diag([tilt, tilt, drift.yaw, *([drift.position] * 3)])
    t_ns = 200_000_000 * index
    return KeyframeEstimate(
        t_ns, T_odom_imu, covariance, t_ns + 200_000_000, np.eye(4), 1e-10 * np.eye(6), *NO_LANDMARKS
    )


def test_position_covariance_is_turned_into_the_second_frame() -> None:
    T = pose_matrix(rotation_z(np.pi / 2.0), np.array([1.0, 2.0, 3.0]))
    measured = RelativePose.measured(3, 7, T, np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]))
    # The x axis of the second frame is the y axis of the first one.
    np.testing.assert_allclose(measured.covariance, np.diag([1.0, 2.0, 3.0, 5.0, 4.0, 6.0]), atol=1e-12)
    assert (measured.first, measured.second) == (3, 7)


def test_covariance_grows_as_that_of_the_odometry() -> None:
    poses = [pose_matrix(np.eye(3), np.zeros(3)) for _ in range(3)]
    drifts = [Drift(1e-6, 1e-4), Drift(4e-6, 3e-4), Drift(9e-6, 7e-4)]
    node = first_node(0, estimate(0, poses[0], drifts[0]))
    for index in (1, 2):
        node, factors = odometry_factors(node, index, estimate(index, poses[index], drifts[index]))
        np.testing.assert_allclose(np.diag(node.covariance)[2:], np.diag(node.estimate.covariance)[2:], rtol=1e-6)
        growth = drifts[index].position - drifts[index - 1].position
        np.testing.assert_allclose(np.diag(factors.relative.covariance)[3:], growth, rtol=1e-3)


def test_yaw_moves_a_distant_keyframe() -> None:
    """A yaw of 2 mrad displaces a keyframe at 10 m by 20 mm, to which the odometry adds nothing."""
    drift = Drift(4e-6, 1e-4)
    far = estimate(1, pose_matrix(np.eye(3), np.array([10.0, 0.0, 0.0])), drift)
    node, factors = odometry_factors(first_node(0, estimate(0, np.eye(4), drift)), 1, far)
    assert node.covariance[4, 4] == pytest.approx(1e-4 + 10.0**2 * 4e-6, rel=1e-3)
    np.testing.assert_allclose(np.diag(factors.relative.covariance)[3:], 1e-10, rtol=1e-3)


def test_new_knowledge_of_the_tilt_is_a_direction_of_gravity() -> None:
    drift = Drift(1e-6, 1e-4)
    first = first_node(0, estimate(0, np.eye(4), drift, tilt=4e-6))
    node, factors = odometry_factors(first, 1, estimate(1, np.eye(4), drift, tilt=1e-6))
    gravity = factors.gravity
    assert gravity is not None and gravity.keyframe == 1
    np.testing.assert_allclose(gravity.up_imu, [0.0, 0.0, 1.0], atol=1e-12)
    # The relative tilt errs by what the first keyframe is known worse: the difference of the variances.
    np.testing.assert_allclose(np.diag(factors.relative.covariance)[:2], 1e-10 + 3.0001e-6, rtol=1e-6)
    # Information adds: 1/1e-6 = 1/(4e-6 + 1e-10 + 3.0001e-6) + 1/σ².
    assert gravity.sigma_rad**-2 == pytest.approx(1.0 / 1e-6 - 1.0 / 7.0002e-6, rel=1e-6)
    np.testing.assert_allclose(np.diag(node.covariance)[:2], 1e-6, rtol=1e-6)


def test_nothing_new_on_the_tilt_is_no_factor() -> None:
    drift = Drift(1e-6, 1e-4)
    first = first_node(0, estimate(0, np.eye(4), drift, tilt=1e-6))
    _, factors = odometry_factors(first, 1, estimate(1, np.eye(4), drift, tilt=2e-6))
    assert factors.gravity is None


def decreasing(*positions: float, is_map_frame: bool = True) -> tuple[PoseGraph, list[OdometryFactors]]:
    """Return keyframes 1 m apart with these variances of their positions, and their factors."""
    poses = [pose_matrix(rotation_z(0.3 * k), np.array([k, 0.0, 0.0])) for k in range(len(positions))]
    estimates = [estimate(k, T, Drift(1e-8, positions[k]), tilt=1e-8) for k, T in enumerate(poses)]
    estimates = [replace(each, relative_covariance=1e-7 * np.eye(6)) for each in estimates]
    node, graph = first_node(0, estimates[0]), PoseGraph(0, estimates[0].covariance, {0: poses[0]})
    found: list[OdometryFactors] = []
    for number, each in enumerate(estimates[1:], 1):
        node, factors = odometry_factors(node, number, each, is_map_frame=is_map_frame)
        graph = graph.with_keyframe(poses[number], factors)
        found.append(factors)
        np.testing.assert_allclose(node.covariance, marginal_covariance(graph, number), rtol=1e-3, atol=1e-9)
    return graph, found


def test_position_that_becomes_certain_gets_a_prior() -> None:
    graph, (growth, decrease) = decreasing(1e-8, 1e-2, 1e-4)
    assert growth.position is None and graph.positions == (decrease.position,)
    assert decrease.position is not None and decrease.position.keyframe == 2
    np.testing.assert_allclose(decrease.position.p_map, [2.0, 0.0, 0.0])
    np.testing.assert_allclose(decrease.position.covariance, 1e-4 * np.eye(3), atol=1e-12)
    # The keyframe before it is known worse by the difference of the variances.
    np.testing.assert_allclose(np.diag(decrease.relative.covariance)[3:], 1e-2 - 1e-4, rtol=1e-3)
    # Information adds: that of the prior, and that of a path of variance 1e-2 + (1e-2 - 1e-4).
    expected = 1.0 / (1.0 / 1e-4 + 1.0 / 1.99e-2)
    np.testing.assert_allclose(np.diag(marginal_covariance(graph, 2))[3:], expected, rtol=1e-4)


def test_prior_repeats_little_of_what_is_known() -> None:
    graph, _ = decreasing(1e-8, 1e-2, MAX_DECREASE**2 * 0.999e-2)
    sigma = np.sqrt(np.diag(marginal_covariance(graph, 2))[3:])
    np.testing.assert_allclose(sigma, MAX_DECREASE * 0.1 * (1.0 - 0.065), rtol=1e-2)


@pytest.mark.parametrize(("variance", "is_map_frame"), [(MAX_DECREASE**2 * 1.001e-2, True), (1e-4, False)])
def test_small_decrease_or_another_frame_gives_no_prior(variance: float, is_map_frame: bool) -> None:
    graph, (_, decrease) = decreasing(1e-8, 1e-2, variance, is_map_frame=is_map_frame)
    assert graph.positions == ()
    np.testing.assert_allclose(np.diag(decrease.relative.covariance)[3:], 1e-7, rtol=1e-3)


def test_drift_grows_again_after_a_prior() -> None:
    _, factors = decreasing(1e-8, 1e-2, 1e-4, 3e-4)
    assert factors[2].position is None
    np.testing.assert_allclose(np.diag(factors[2].relative.covariance)[3:], 2e-4, rtol=1e-2)


def test_loop_at_an_uncertain_keyframe_corrects_that_keyframe() -> None:
    """Keyframe 1 errs by 0.1 m, which the odometry no longer does at keyframes 2 and 3, and a loop connects 1 with 3.

    The truth is a row of keyframes 1 m apart. The loop has to move keyframe 1, and not keyframe 3.
    """
    graph, _ = decreasing(1e-8, 1e-2, 1e-4, 1.1e-4)
    T_1 = graph.poses[1] @ pose_matrix(np.eye(3), rotation_z(-0.3) @ np.array([0.0, 0.1, 0.0]))
    T = {**graph.poses, 1: T_1}
    odometry = [replace(each, T_first_second=inverse_pose(T[each.first]) @ T[each.second]) for each in graph.odometry]
    T_true = inverse_pose(graph.poses[1]) @ graph.poses[3]
    drifted = replace(graph, poses=T, odometry=tuple(odometry))
    solved = optimize(drifted.with_loops([RelativePose(1, 3, T_true, 1e-6 * np.eye(6))]), robust=False).graph
    np.testing.assert_allclose(solved.poses[1][:3, 3], [1.0, 0.0, 0.0], atol=0.003)
    np.testing.assert_allclose(solved.poses[3][:3, 3], [3.0, 0.0, 0.0], atol=0.003)


def test_joined_track_leaves_out_its_positions() -> None:
    one, _ = decreasing(1e-8, 1e-2, 1e-4)
    poses = {number + 10: T for number, T in one.poses.items()}
    other = PoseGraph(10, one.first_covariance, poses, positions=(replace(one.positions[0], keyframe=12),))
    assert joined_graphs(one, other, np.eye(4)).positions == one.positions


def test_scaled_pose_keeps_rotation_and_covariance() -> None:
    relative = RelativePose(3, 7, pose_matrix(rotation_z(0.4), np.array([1.0, 2.0, 3.0])), np.eye(6))
    longer = scaled(relative, 1.5)
    np.testing.assert_allclose(longer.T_first_second, pose_matrix(rotation_z(0.4), np.array([1.5, 3.0, 4.5])))
    np.testing.assert_array_equal(relative.T_first_second[:3, 3], [1.0, 2.0, 3.0])
    assert (longer.first, longer.second) == (3, 7) and longer.covariance is relative.covariance


def test_covariance_of_a_long_flight_stays_bounded() -> None:
    """The tilt is known better about one axis than about the other, which must not grow from keyframe to keyframe."""
    node = first_node(0, estimate(0, np.eye(4), Drift(1e-8, 1e-6)))
    for index in range(1, 300):
        angle = 0.1 * index
        T = pose_matrix(np.eye(3), np.array([5.0 * np.sin(angle), 5.0 * np.cos(angle), 1.0]))
        covariance = np.diag([1e-6, 4e-6, 1e-6 * index, 1e-4, 1e-4, 1e-4])
        node, _ = odometry_factors(node, index, replace(estimate(index, T, Drift(1e-6, 1e-4)), covariance=covariance))
    assert np.linalg.eigvalsh(node.covariance).max() < 0.02
