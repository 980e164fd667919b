"""Submaps after a bundle adjustment during the flight, and the scale of the path by it."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dronevio.estimator.slam.map.keyframe import NO_KEYFRAME_FEATURES, MapKeyframe
from dronevio.estimator.slam.map.map_frame import frame_change
from dronevio.estimator.slam.map.odometry_factors import AbsolutePosition, RelativePose, first_node
from dronevio.estimator.slam.map.pose_graph import ADJUSTED_VARIANCE, optimize
from dronevio.estimator.slam.map.submap import Adjustment, Submap, path_scale
from dronevio.models.arrays import Array
from dronevio.models.rotation import inverse_pose, pose_matrix, rotation_z

if TYPE_CHECKING:
    from tests.estimator.slam.mapping.conftest import OdometryFlight


KEYFRAMES, ADJUSTED = 50, 40
"""Numbers of all keyframes, and of those that are adjusted."""


def adjusted_twice_as_large(odometry_flight: "OdometryFlight") -> tuple[Submap, Submap]:
    """Return a submap, and the same with the first keyframes adjusted to twice the size."""
    estimates = odometry_flight.marginalized[:KEYFRAMES]
    node, submap = first_node(0, estimates[0]), Submap.begin(0, estimates[0], 0)
    for number in range(1, KEYFRAMES):
        node, submap = submap.extended(node, number, estimates[number])
    poses = {}
    for number in range(ADJUSTED):
        poses[number] = submap.graph.poses[number].copy()
        poses[number][:3, 3] *= 2.0
    return submap, submap.adjusted(poses, Adjustment(ADJUSTED - 1, 0, 2.0), estimates[-1].t_ns)


def test_adjusted_poses_are_the_optimum_of_the_graph(odometry_flight: "OdometryFlight") -> None:
    before, after = adjusted_twice_as_large(odometry_flight)
    doubled = {n: np.block([[T[:3, :3], 2.0 * T[:3, 3:]], [T[3:]]]) for n, T in before.graph.poses.items()}
    for graph in (after.graph, after.optimized(0).graph, after.whole_graph):
        moved = {number: T @ inverse_pose(doubled[number]) for number, T in graph.poses.items() if number < ADJUSTED}
        for T in moved.values():  # the map frame has moved
            np.testing.assert_allclose(T, after.T_map_first, atol=1e-5)
    # The later ones follow with the new scale, also those that are added after the adjustment.
    estimates = odometry_flight.marginalized
    node = replace(first_node(KEYFRAMES - 1, estimates[KEYFRAMES - 1]), first=0)
    _, extended = after.extended(node, KEYFRAMES, estimates[KEYFRAMES])
    for number in range(ADJUSTED, KEYFRAMES + 1):
        expected = (inverse_pose(estimates[ADJUSTED - 1].T_odom_imu) @ estimates[number].T_odom_imu)[:3, 3]
        found = (inverse_pose(extended.graph.poses[ADJUSTED - 1]) @ extended.graph.poses[number])[:3, 3]
        np.testing.assert_allclose(found, 2.0 * expected, atol=1e-5)
    again = after.adjusted(after.graph.poses, Adjustment(ADJUSTED - 1, 0, 2.0), 0)
    whole = [inverse_pose(submap.graph.poses[0]) @ submap.graph.poses[KEYFRAMES - 1] for submap in (after, again)]
    np.testing.assert_allclose(whole[1], whole[0], atol=1e-5)


def test_adjusted_odometry_is_stiffer_once(odometry_flight: "OdometryFlight") -> None:
    before, after = adjusted_twice_as_large(odometry_flight)
    again = after.adjusted(after.graph.poses, Adjustment(KEYFRAMES - 1, 0, 2.0), 0)
    for step, adjusted, twice in zip(before.graph.odometry, after.graph.odometry, again.graph.odometry, strict=True):
        is_adjusted = step.second < ADJUSTED
        expected = (ADJUSTED_VARIANCE if is_adjusted else 1.0) * step.covariance
        np.testing.assert_allclose(adjusted.covariance, expected, rtol=1e-12)
        np.testing.assert_allclose(twice.covariance, ADJUSTED_VARIANCE * step.covariance, rtol=1e-12)
    estimates = odometry_flight.marginalized
    culled, of_odometry = (
        next(
            each.covariance
            for each in submap.without(20, first_node(19, estimates[19]), estimates[21]).graph.odometry
            if each.second == 21
        )
        for submap in (after, before)
    )
    np.testing.assert_allclose(culled, ADJUSTED_VARIANCE * of_odometry, rtol=1e-12)


def test_loops_still_move_an_adjusted_map(odometry_flight: "OdometryFlight") -> None:
    _, after = adjusted_twice_as_large(odometry_flight)
    T = after.graph.poses
    T_loop = inverse_pose(T[3]) @ T[30] @ pose_matrix(np.eye(3), np.array([0.02, 0.0, 0.0]))
    loop = RelativePose(3, 30, T_loop, 1e-10 * np.eye(6))
    moved = after.with_loops([loop]).optimized(0)
    assert moved.closed_loops == (loop,)
    np.testing.assert_allclose(inverse_pose(moved.graph.poses[3]) @ moved.graph.poses[30], T_loop, atol=1e-3)


def test_a_loop_leaves_the_map_where_it_was_published(odometry_flight: "OdometryFlight") -> None:
    """The graph turns and is deformed by a loop; its frame is then the one that moves the published poses least."""
    before, _ = adjusted_twice_as_large(odometry_flight)
    graph = before.graph
    T_drift = pose_matrix(rotation_z(np.array(0.005)), np.array([0.02, 0.0, 0.01]))
    loop = RelativePose(0, 40, inverse_pose(graph.poses[0]) @ T_drift @ graph.poses[40], 1e-10 * np.eye(6))
    position = AbsolutePosition(5, graph.poses[5][:3, 3], np.diag([1.0, 2.0, 3.0]))
    submap = replace(before, solution=replace(before.solution, graph=replace(graph, positions=(position,))))
    looped = submap.with_loops([loop])
    after, in_first_frame = looped.optimized(0), optimize(looped.graph).graph.poses
    T_map_first = after.T_map_first
    np.testing.assert_allclose(frame_change(after.graph.poses, after.first_poses), np.eye(4), atol=1e-9)
    assert after.closed_loops == (loop,) and np.linalg.norm(T_map_first[:3, 3]) > 0.005
    for number, T in in_first_frame.items():
        np.testing.assert_allclose(after.graph.poses[number], T_map_first @ T, atol=1e-9)
    # Factors in the map frame move with it, so that another optimization changes nothing.
    (moved,) = after.graph.positions
    R = T_map_first[:3, :3]
    np.testing.assert_allclose(moved.p_map, R @ position.p_map + T_map_first[:3, 3], atol=1e-12)
    np.testing.assert_allclose(moved.covariance, R @ position.covariance @ R.T, atol=1e-12)
    again = after.optimized(0)
    np.testing.assert_allclose(again.T_map_first, T_map_first, atol=1e-5)
    for number, T in after.whole_graph.poses.items():
        np.testing.assert_allclose(again.whole_graph.poses[number], T, atol=1e-5)


def test_a_position_of_the_odometry_is_moved_with_the_map(odometry_flight: "OdometryFlight") -> None:
    before, _ = adjusted_twice_as_large(odometry_flight)
    T = pose_matrix(rotation_z(np.array(0.5)), np.array([1.0, 2.0, 3.0]))
    later, S = odometry_flight.marginalized[KEYFRAMES], np.diag([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])
    known = replace(later, covariance=S @ later.covariance @ S)
    node = replace(first_node(KEYFRAMES - 1, odometry_flight.marginalized[KEYFRAMES - 1]), first=0)
    (position,) = replace(before, T_map_first=T).extended(node, KEYFRAMES, known)[1].graph.positions
    np.testing.assert_allclose(position.p_map, (T @ later.T_odom_imu)[:3, 3], atol=1e-12)
    R = T[:3, :3] @ later.T_odom_imu[:3, :3]
    np.testing.assert_allclose(position.covariance, R @ known.covariance[3:, 3:] @ R.T, atol=1e-15)


def test_an_adjustment_begun_in_another_map_frame(odometry_flight: "OdometryFlight") -> None:
    """A loop moves the map frame while a map is adjusted: the result is the same."""
    before, _ = adjusted_twice_as_large(odometry_flight)
    poses = {number: before.graph.poses[number] for number in range(ADJUSTED)}
    T = pose_matrix(rotation_z(np.array(0.1)), np.array([0.3, -0.2, 0.1]))
    adjustment = Adjustment(ADJUSTED - 1, 0, 1.0)
    same, other = (
        before.adjusted({number: frame @ pose for number, pose in poses.items()}, adjustment, 0)
        for frame in (np.eye(4), T)
    )
    for submap in (same, other):
        np.testing.assert_allclose(submap.T_map_first, np.eye(4), atol=1e-6)
        np.testing.assert_allclose(submap.graph.poses[30], before.graph.poses[30], atol=1e-6)


def test_a_culled_keyframe_leaves_the_adjusted_odometry(odometry_flight: "OdometryFlight") -> None:
    _, after = adjusted_twice_as_large(odometry_flight)
    estimates = odometry_flight.marginalized
    culled = after.without(20, first_node(19, estimates[19]), estimates[21])
    step = next(each for each in culled.graph.odometry if each.second == 21)
    assert step.first == 19
    expected = inverse_pose(after.graph.poses[19]) @ after.graph.poses[21]
    np.testing.assert_allclose(step.T_first_second, expected, atol=1e-9)
    np.testing.assert_array_equal(culled.whole_graph.poses[20], after.graph.poses[20])


def test_culled_keyframes_are_adjusted_too(odometry_flight: "OdometryFlight") -> None:
    before, _ = adjusted_twice_as_large(odometry_flight)
    estimates = odometry_flight.marginalized
    culled = before.without(20, first_node(19, estimates[19]), estimates[21])
    poses = {number: 1.0 * T for number, T in before.graph.poses.items() if number < ADJUSTED}
    for T in poses.values():
        T[:3, 3] *= 2.0
    after = culled.adjusted(poses, Adjustment(ADJUSTED - 1, 0, 2.0), 0)
    np.testing.assert_allclose(after.whole_graph.poses[20], after.T_map_first @ poses[20], atol=1e-12)
    np.testing.assert_allclose(after.graph.poses[21], after.T_map_first @ poses[21], atol=1e-5)


def test_the_map_stays_where_it_was_published(odometry_flight: "OdometryFlight") -> None:
    """Bundle adjustment doubles the map: the middle of all its keyframes stays, not the first one."""
    before, after = adjusted_twice_as_large(odometry_flight)
    old, new = (
        np.array([submap.graph.poses[number][:3, 3] for number in range(KEYFRAMES)]) for submap in (before, after)
    )
    np.testing.assert_allclose(new.mean(axis=0), old.mean(axis=0), atol=0.005)
    assert after.first_poses == before.first_poses
    first = inverse_pose(after.T_map_first) @ after.graph.poses[0]
    np.testing.assert_allclose(first, before.graph.poses[0], atol=1e-5)
    offset_m = float(np.linalg.norm(new[0] - old[0]))
    assert offset_m > 0.1
    added = after.covariance_in_map(0) - before.covariance_in_map(0)
    np.testing.assert_allclose(np.trace(added[3:, 3:]), offset_m**2, rtol=0.02)
    # A later adjustment is aligned with the poses that were published, not with those of this one. Its first keyframe
    # is where this one has left it.
    T = after.graph.poses[0] @ inverse_pose(before.graph.poses[0])
    small = {number: T @ before.graph.poses[number] for number in range(ADJUSTED)}
    back = after.adjusted(small, Adjustment(ADJUSTED - 1, 0, 1.0), 0)
    np.testing.assert_allclose(back.graph.poses[5], before.graph.poses[5], atol=1e-5)
    np.testing.assert_allclose(back.T_map_first, np.eye(4), atol=1e-5)


def test_an_adjusted_map_has_no_new_priors_on_positions(odometry_flight: "OdometryFlight") -> None:
    """The odometry frame is not the map frame any more, since their scales differ."""
    _, after = adjusted_twice_as_large(odometry_flight)
    later, S = odometry_flight.marginalized[KEYFRAMES], np.diag([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])
    known = replace(later, covariance=S @ later.covariance @ S)
    node = first_node(KEYFRAMES - 1, odometry_flight.marginalized[KEYFRAMES - 1])
    node = replace(node, first=0)
    assert after.extended(node, KEYFRAMES, known)[1].graph.positions == ()


def straight_path(count: int, step_m: float, first_of_track: int = 0) -> list[MapKeyframe]:
    """Return keyframes on a straight line, one a second; those from a number on are of another track."""
    none, points = np.zeros(0, np.int64), np.zeros((0, 3))
    poses = [pose_matrix(np.eye(3), np.array([step_m * number, 0.0, 0.0])) for number in range(count)]
    return [
        MapKeyframe(number, number * 10**9, T, NO_KEYFRAME_FEATURES, none, points, int(number >= first_of_track))
        for number, T in enumerate(poses)
    ]


def stretched(keyframes: Sequence[MapKeyframe], scale: float) -> dict[int, Array]:
    """Return poses (4, 4) whose positions are multiplied by a factor."""
    return {k.number: pose_matrix(np.eye(3), (scale if k.number else 1.0) * k.T_odom_imu[:3, 3]) for k in keyframes}


def test_path_scale_is_that_of_the_last_minute() -> None:
    path = straight_path(100, 0.2)
    poses = stretched(path[:40], 1.5) | stretched(path[40:], 1.02)
    assert path_scale(path, poses) == pytest.approx(1.02, rel=1e-9)


@pytest.mark.parametrize(
    ("step_m", "first_of_track"), [pytest.param(0.05, 0, id="short path"), pytest.param(0.2, 90, id="another track")]
)
def test_path_scale_of_too_short_a_path_is_one(step_m: float, first_of_track: int) -> None:
    path = straight_path(95, step_m, first_of_track)
    assert path_scale(path, stretched(path, 1.02)) == 1.0
