"""Culling: keyframes at known places leave the graph, which stays that of the odometry and of its loops."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dronevio.estimator.backend.keyframe_estimate import KeyframeEstimate
from dronevio.estimator.slam.config import SlamConfig
from dronevio.estimator.slam.map.keyframe import MapKeyframe
from dronevio.estimator.slam.map.map_arrays import MapSummary
from dronevio.estimator.slam.map.odometry_factors import (
    MAX_DECREASE,
    OdometryNode,
    RelativePose,
    composed,
    first_node,
    reversed_pose,
)
from dronevio.estimator.slam.map.pose_graph import optimize
from dronevio.estimator.slam.map.submap import MAX_PASSED_LOOPS, Submap
from dronevio.estimator.slam.mapper import Mapper, MappingConfig
from dronevio.estimator.slam.places.recognizer import PlaceRecognizer
from dronevio.estimator.slam.worker.map_builder import LocalMap, MarginalizedKeyframe
from dronevio.models.rotation import exp_so3, inverse_pose, pose_matrix, rotation_z
from tests.estimator.slam.mapping.conftest import marginal_covariance
from tests.estimator.slam.process.conftest import DRIFT_M, PLACES, keyframe, one_camera

if TYPE_CHECKING:
    from tests.estimator.slam.mapping.conftest import OdometryFlight


COUNT, CULLED = 30, 20
"""Number of keyframes of the odometry, and the one that is culled."""


@pytest.fixture
def chain(odometry_flight: "OdometryFlight") -> tuple[Submap, dict[int, OdometryNode]]:
    """Return the submap of the first keyframes of an odometry, and its nodes."""
    return chain_of(odometry_flight.marginalized[:COUNT])


def chain_of(estimates: Sequence[KeyframeEstimate]) -> tuple[Submap, dict[int, OdometryNode]]:
    """Return the submap of the first keyframes of an odometry, and its nodes."""
    nodes = {0: first_node(0, estimates[0])}
    submap = Submap.begin(0, estimates[0], 0)
    for number in range(1, len(estimates)):
        nodes[number], submap = submap.extended(nodes[number - 1], number, estimates[number])
    return submap, nodes


def without(submap: Submap, nodes: dict[int, OdometryNode], number: int = CULLED) -> Submap:
    """Return the submap without a keyframe."""
    return submap.without(number, nodes[number - 1], nodes[number + 1].estimate)


def true_loop(odometry_flight: "OdometryFlight", first: int, second: int, sigma: float = 1e-3) -> RelativePose:
    """Return a loop by the true poses."""
    T_first, T_second = (odometry_flight.true_poses[odometry_flight.marginalized[i].t_ns] for i in (first, second))
    return RelativePose(first, second, inverse_pose(T_first) @ T_second, sigma**2 * np.eye(6))


def test_a_culled_odometry_is_the_same_odometry(
    odometry_flight: "OdometryFlight", chain: tuple[Submap, dict[int, OdometryNode]]
) -> None:
    submap, nodes = chain
    culled = without(submap, nodes)
    graph, newest = culled.graph, COUNT - 1
    assert set(graph.poses) == set(range(COUNT)) - {CULLED} and len(graph.odometry) == COUNT - 2
    assert all(CULLED not in (each.first, each.second) for each in graph.odometry)
    assert all(direction.keyframe != CULLED for direction in graph.gravity)
    for number, T in optimize(graph).graph.poses.items():
        np.testing.assert_allclose(T, odometry_flight.marginalized[number].T_odom_imu, atol=1e-6)
    ratio = np.diag(marginal_covariance(graph, newest)) / np.diag(marginal_covariance(submap.graph, newest))
    np.testing.assert_allclose(ratio, 1.0, atol=0.05)


def test_a_culled_prior_passes_on_to_the_next_keyframe(odometry_flight: "OdometryFlight") -> None:
    """From the culled keyframe on, the odometry knows its position ten times as well as before."""
    S = np.diag([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])
    estimates = [
        replace(each, covariance=S @ each.covariance @ S if number >= CULLED else each.covariance)
        for number, each in enumerate(odometry_flight.marginalized[:COUNT])
    ]
    submap, nodes = chain_of(estimates)
    assert min(each.keyframe for each in submap.graph.positions) == CULLED
    tight = submap.covariances[CULLED], estimates[CULLED].covariance
    np.testing.assert_allclose(tight[0][3:, 3:], tight[1][3:, 3:], rtol=1e-9)
    culled = without(submap, nodes)
    assert min(each.keyframe for each in culled.graph.positions) == CULLED + 1
    assert culled.history.positions == submap.graph.positions
    T_map_first = pose_matrix(rotation_z(np.array(0.5)), np.array([1.0, 2.0, 3.0]))
    passed = without(replace(submap, T_map_first=T_map_first), nodes).graph.positions
    (p_map,) = [each.p_map for each in passed if each.keyframe == CULLED + 1]
    np.testing.assert_allclose(p_map, (T_map_first @ estimates[CULLED + 1].T_odom_imu)[:3, 3], atol=1e-12)
    for number, T in optimize(culled.graph).graph.poses.items():
        np.testing.assert_allclose(T, estimates[number].T_odom_imu, atol=1e-6)
    one, other = (np.trace(marginal_covariance(graph, COUNT - 1)[3:, 3:]) for graph in (culled.graph, submap.graph))
    assert one == pytest.approx(other, rel=0.05)
    assert one < np.trace(estimates[-1].covariance[3:, 3:]) / MAX_DECREASE**2


def test_another_track_has_no_positions_in_the_map(odometry_flight: "OdometryFlight") -> None:
    S = np.diag([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])
    first, second, third = odometry_flight.marginalized[COUNT : COUNT + 3]
    third = replace(third, covariance=S @ third.covariance @ S)
    map_ = chain_of(odometry_flight.marginalized[:COUNT])[0]
    node, track = first_node(COUNT, first), Submap.begin(COUNT, first, 1)
    joined = track.joined(map_, [true_loop(odometry_flight, 3, COUNT)], first.t_ns, other_stays=True)
    assert joined is not None
    node, joined = joined.extended(node, COUNT + 1, second)
    _, joined = joined.extended(node, COUNT + 2, third)
    assert joined.graph.positions == ()
    assert joined.without(COUNT + 1, first_node(COUNT, first), third).graph.positions == ()


def test_the_history_keeps_culled_keyframes(chain: tuple[Submap, dict[int, OdometryNode]]) -> None:
    submap, nodes = chain
    whole = without(submap, nodes).whole_graph
    assert set(whole.poses) == set(range(COUNT)) and len(whole.odometry) == COUNT - 1
    np.testing.assert_array_equal(whole.poses[CULLED], submap.graph.poses[CULLED])


def test_a_passed_loop_still_removes_the_drift(
    odometry_flight: "OdometryFlight", chain: tuple[Submap, dict[int, OdometryNode]]
) -> None:
    submap, nodes = chain
    loop = true_loop(odometry_flight, 0, CULLED)
    looped = submap.with_loops([loop]).optimized(0)
    culled = without(looped, nodes)
    assert [(each.first, each.second) for each in culled.closed_loops] == [(0, CULLED - 1)]
    assert culled.waiting == 0 and culled.history.loops == (loop,)
    after = culled.optimized(0)
    np.testing.assert_array_equal(after.whole_graph.poses[COUNT - 1], after.graph.poses[COUNT - 1])
    for number in (CULLED - 1, CULLED + 1):
        np.testing.assert_allclose(after.graph.poses[number], looped.graph.poses[number], atol=2e-3)
    expected, found = (marginal_covariance(each.graph, CULLED - 1) for each in (looped, after))
    assert np.trace(found[3:, 3:]) < 3.0 * np.trace(expected[3:, 3:])
    assert np.trace(found[3:, 3:]) < 0.5 * np.trace(nodes[CULLED - 1].covariance[3:, 3:])


def test_culled_keyframes_stay_in_a_joined_history(
    odometry_flight: "OdometryFlight", chain: tuple[Submap, dict[int, OdometryNode]]
) -> None:
    first, later = without(*chain), odometry_flight.marginalized[COUNT]
    second = Submap.begin(COUNT, later, 1)
    joined = second.joined(first, [true_loop(odometry_flight, 3, COUNT)], later.t_ns, other_stays=True)
    assert joined is not None and CULLED not in joined.graph.poses
    assert set(joined.whole_graph.poses) == set(range(COUNT + 1))


def test_rejected_and_waiting_loops_are_not_passed_on(
    odometry_flight: "OdometryFlight", chain: tuple[Submap, dict[int, OdometryNode]]
) -> None:
    submap, nodes = chain
    right = [true_loop(odometry_flight, k, k + 15) for k in range(4)]
    wrong = RelativePose(0, CULLED, pose_matrix(np.eye(3), np.array([5.0, 5.0, 0.0])), 1e-6 * np.eye(6))
    optimized = submap.with_loops([*right, wrong]).optimized(0)
    assert set(optimized.closed_loops) == set(right)
    waiting = [true_loop(odometry_flight, 1, CULLED), true_loop(odometry_flight, 1, CULLED + 2)]
    culled = without(optimized.with_loops(waiting), nodes)
    assert culled.graph.loops == (*right, waiting[1]) and culled.waiting == 1
    assert set(culled.closed_loops) == set(right) and culled.tested_loops == 4
    assert len(culled.history.loops) == 7


def test_number_of_passed_loops_is_limited(
    odometry_flight: "OdometryFlight", chain: tuple[Submap, dict[int, OdometryNode]]
) -> None:
    submap, nodes = chain
    loops = [true_loop(odometry_flight, first, CULLED) for first in range(MAX_PASSED_LOOPS + 3)]
    own = true_loop(odometry_flight, 9, CULLED - 1)
    culled = without(submap.with_loops([own, *loops]).optimized(0), nodes)
    assert len(culled.graph.loops) == MAX_PASSED_LOOPS and own in culled.graph.loops
    assert all(loop.second == CULLED - 1 for loop in culled.graph.loops)


def test_a_passed_loop_by_hand() -> None:
    loop = RelativePose(
        1, 5, pose_matrix(np.eye(3), np.array([2.0, 0.0, 0.0])), np.diag([0, 0, 1e-4, 1e-2, 1e-2, 1e-2])
    )
    step = RelativePose(
        4, 5, pose_matrix(np.eye(3), np.array([3.0, 0.0, 0.0])), np.diag([0, 0, 3e-4, 1e-2, 1e-2, 1e-2])
    )
    passed = composed(loop, reversed_pose(step))
    assert (passed.first, passed.second) == (1, 4)
    np.testing.assert_allclose(passed.T_first_second, pose_matrix(np.eye(3), np.array([-1.0, 0.0, 0.0])), atol=1e-12)
    # An error of the yaw of 0.02 rad displaces the keyframe 3 m behind by 0.06 m to the side.
    expected = np.diag([0.0, 0.0, 4e-4, 2e-2, 2e-2 + 9.0 * 4e-4, 2e-2])
    expected[2, 4] = expected[4, 2] = -3.0 * 4e-4
    np.testing.assert_allclose(passed.covariance, expected, atol=1e-12)


def test_a_passed_loop_keeps_the_pose_of_the_second_keyframe() -> None:
    rng = np.random.default_rng(2)
    T_loop, T_step = (pose_matrix(exp_so3(rng.normal(size=3)), rng.normal(size=3)) for _ in range(2))
    step = RelativePose(4, 5, T_step, np.eye(6))
    passed = composed(RelativePose(1, 5, T_loop, np.eye(6)), reversed_pose(step))
    np.testing.assert_allclose(passed.T_first_second @ T_step, T_loop, atol=1e-12)


def laps(count: int, places: int = PLACES) -> list[MarginalizedKeyframe]:
    """Return the keyframes of laps through the same places, 20 s apart, each with the drift of the second lap."""
    rig = one_camera()
    return [keyframe(rig, place, lap) for lap in range(count) for place in range(places)]


def mapped(messages: list[MarginalizedKeyframe]) -> LocalMap:
    """Return the map of keyframes, which is optimized at each of them."""
    local = LocalMap(one_camera(), SlamConfig(mapping=MappingConfig(optimization_interval_s=0.0)))
    for message in messages:
        local.send(message)
    return local


def keyframes_of(mapper: Mapper) -> tuple[MapKeyframe, ...]:
    """Return the keyframes of a map."""
    return mapper.keyframes


def recognizable(mapper: Mapper) -> int:
    """Return the number of keyframes that can be recognized."""
    recognizer = mapper._recognizer
    assert isinstance(recognizer, PlaceRecognizer)
    return len(recognizer)


def summary_of(mapper: Mapper) -> MapSummary:
    """Return the size of a map."""
    return mapper.summary


def test_laps_through_known_places_add_no_keyframes() -> None:
    local = mapped(laps(4))
    summary, keyframes = local.ask(summary_of), local.ask(keyframes_of)
    assert summary.keyframes == 2 * PLACES  # those of the first lap, and the newest ones, which are too young
    assert [each.number for each in keyframes] == list(range(4 * PLACES))
    described = [each.number for each in keyframes if len(each.features)]
    assert described[:PLACES] == list(range(PLACES)) and len(described) == summary.keyframes
    assert local.ask(recognizable) == summary.keyframes
    solution = local.ask(Mapper.final_solution)
    assert solution is not None and set(solution.graph.poses) == set(range(4 * PLACES))


def test_places_of_the_map_are_recognized_after_culling() -> None:
    messages = laps(4)
    local = mapped(messages)
    answers = [local.receive() for _ in messages]
    last = [answer for answer in answers[3 * PLACES :] if answer is not None]
    assert sum(len(answer.loops) for answer in last) >= 2
    assert all(loop.first < PLACES for answer in last for loop in answer.loops)
    for number, answer in enumerate(answers):  # loops that were passed on are not reported again
        assert answer is not None and all(loop.second > number - PLACES for loop in answer.loops)
    assert last[-1].T_map_odom is not None
    assert last[-1].T_map_odom[1, 3] == pytest.approx(-3.0 * DRIFT_M, abs=0.5 * DRIFT_M)


def test_new_ground_is_not_culled() -> None:
    local = mapped([*laps(1, PLACES), *(m for m in laps(2, 3 * PLACES)[3 * PLACES :])])
    described = [k.number for k in local.ask(keyframes_of) if len(k.features)]
    assert described == list(range(len(described)))
