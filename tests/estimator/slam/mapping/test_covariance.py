"""Covariances by the best path through odometry and loops, by hand on keyframes in a row."""

from dataclasses import replace

import numpy as np
import pytest

from dronevio.estimator.slam.map.covariance import UNKNOWN, covariances_of, covariances_with_loops, is_unknown
from dronevio.estimator.slam.map.odometry_factors import (
    AbsolutePosition,
    GravityDirection,
    RelativePose,
    composed,
    reversed_pose,
)
from dronevio.estimator.slam.map.pose_graph import PoseGraph
from dronevio.models.arrays import Array
from dronevio.models.rotation import exp_so3, pose_matrix

FIRST, STEP, LOOP = 1e-6, 4e-4, 1e-4
"""Variances of the position: of the first keyframe, added by each step, and of a loop [m²]."""


def variance(value: float) -> Array:
    """Return a covariance whose rotation is certain."""
    return np.diag([1e-12, 1e-12, 1e-12, value, value, value])


def pose(x_m: float) -> Array:
    """Return a pose on the x axis."""
    return pose_matrix(np.eye(3), np.array([x_m, 0.0, 0.0]))


def chain(count: int, first: int = 0) -> PoseGraph:
    """Return keyframes 1 m apart."""
    numbers = range(first, first + count)
    steps = tuple(RelativePose(k, k + 1, pose(1.0), variance(STEP)) for k in numbers[:-1])
    return PoseGraph(first, variance(FIRST), {k: pose(float(k - first)) for k in numbers}, steps)


def loop(first: int, second: int) -> RelativePose:
    """Return a loop between two keyframes."""
    return RelativePose(first, second, pose(float(second - first)), variance(LOOP))


def position(covariances: "dict[int, Array]", number: int) -> float:
    """Return the variance of a coordinate of a position [m²]."""
    return float(covariances[number][4, 4])


def test_without_loops_the_steps_add_up() -> None:
    found = dict(covariances_of(chain(5)))
    assert [position(found, k) for k in range(5)] == pytest.approx([FIRST + k * STEP for k in range(5)], rel=1e-4)


def test_a_loop_is_a_shorter_path_for_what_follows() -> None:
    found = dict(covariances_of(chain(10).with_loops([loop(1, 7)])))
    expected = [FIRST + k * STEP for k in range(7)]  # the keyframes before it do not become better
    expected += [FIRST + STEP + LOOP + k * STEP for k in range(3)]
    assert [position(found, k) for k in range(10)] == pytest.approx(expected, rel=1e-4)


def test_many_loops_are_as_certain_as_the_best_one() -> None:
    loops = [loop(k, 9) for k in range(4) for _ in range(5)]
    found = dict(covariances_of(chain(10).with_loops(loops)))
    assert position(found, 9) == pytest.approx(FIRST + LOOP, rel=1e-4)


def test_new_loops_change_the_keyframes_after_them_only() -> None:
    graph = chain(10)
    before = covariances_of(graph)
    after = covariances_with_loops(graph.with_loops([loop(0, 6)]), before, [loop(0, 6)])
    for number in range(6):
        assert after[number] is before[number]
    assert all(np.trace(after[k]) < np.trace(before[k]) for k in range(6, 10))
    assert covariances_with_loops(graph, before, []) is before


def test_another_track_is_known_by_its_loops_alone() -> None:
    one, two = chain(4), chain(4, first=4)
    graph = PoseGraph(0, one.first_covariance, {**one.poses, **two.poses}, (*one.odometry, *two.odometry), joined=(4,))
    before = {**covariances_of(one), **dict.fromkeys(two.poses, UNKNOWN)}
    found = dict(covariances_with_loops(graph, before, [loop(2, 6)]))
    joined = FIRST + 2 * STEP + LOOP
    # The keyframes of the track before the loop are reached by the odometry in the other direction.
    expected = [joined + 2 * STEP, joined + STEP, joined, joined + STEP]
    assert [position(found, k) for k in range(4, 8)] == pytest.approx(expected, rel=1e-4)
    assert all(is_unknown(before[k]) and not is_unknown(found[k]) for k in two.poses)


def test_an_earlier_track_is_known_by_a_loop_from_a_later_one() -> None:
    one, two = chain(3), chain(3, first=3)
    graph = PoseGraph(3, one.first_covariance, {**one.poses, **two.poses}, (*one.odometry, *two.odometry), joined=(0,))
    before = {**covariances_of(two), **dict.fromkeys(one.poses, UNKNOWN)}
    found = dict(covariances_with_loops(graph, before, [loop(1, 4)]))
    joined = FIRST + STEP + LOOP
    assert [position(found, k) for k in range(3)] == pytest.approx([joined + STEP, joined, joined + STEP], rel=1e-4)


def test_fixed_keyframes_are_certain() -> None:
    graph = PoseGraph(0, variance(FIRST), {k: pose(float(k)) for k in range(5)}, fixed=tuple(range(5)))
    found = covariances_of(graph)
    assert all(position(dict(found), k) == pytest.approx(1e-8) for k in range(1, 5))
    assert not any(is_unknown(found[k]) for k in range(5))


def test_prior_on_a_position_is_a_path_of_its_own() -> None:
    P_map = np.diag([STEP, 2.0 * STEP, 3.0 * STEP])
    turned = {k: pose(float(k)) @ pose_matrix(exp_so3(np.array([0.0, 0.0, np.pi / 2.0])), np.zeros(3)) for k in (4, 9)}
    graph = chain(10)
    priors = tuple(AbsolutePosition(k, turned[k][:3, 3], P_map) for k in turned)
    graph = replace(graph, poses={**graph.poses, **turned}, positions=priors).with_loops([loop(0, 8)])
    found = dict(covariances_of(graph))
    # The y axis of the turned keyframe is the negative x axis of the map.
    np.testing.assert_allclose(np.diag(found[4])[3:], [2.0 * STEP, STEP, 3.0 * STEP], rtol=1e-9)
    np.testing.assert_allclose(found[4][:3, :3], found[3][:3, :3] + 1e-12 * np.eye(3), atol=1e-14)
    assert position(found, 5) == pytest.approx(2.0 * STEP, rel=1e-4)
    assert position(found, 9) == pytest.approx(FIRST + LOOP + STEP, rel=1e-4)  # by the loop, which is a better path


def test_directions_of_gravity_are_part_of_a_path() -> None:
    """Variances add up along the path; a direction of gravity adds its information on roll and pitch, none on yaw."""
    turn, tilt = 1e-4, 5e-5  # variances of the rotation: added by each step, and of the direction of gravity [rad²]
    steps = tuple(RelativePose(k, k + 1, pose(1.0), np.diag([turn] * 3 + [STEP] * 3)) for k in range(3))
    up = GravityDirection(2, np.array([0.0, 0.0, 1.0]), np.sqrt(tilt))
    graph = replace(chain(4), odometry=steps, gravity=(up,))
    after = 1.0 / (1.0 / (2.0 * turn) + 1.0 / tilt)
    expected = {1: [turn] * 3, 2: [after, after, 2.0 * turn], 3: [after + turn, after + turn, 3.0 * turn]}
    for number, covariance in covariances_of(graph).items():
        if number:
            np.testing.assert_allclose(np.diag(covariance)[:3], expected[number], rtol=1e-6)


def test_reversed_poses_are_inverse() -> None:
    rng = np.random.default_rng(0)
    A = rng.normal(size=(6, 6))
    relative = RelativePose(3, 5, pose_matrix(exp_so3(rng.normal(size=3)), rng.normal(size=3)), A @ A.T)
    back = reversed_pose(reversed_pose(relative))
    np.testing.assert_allclose(back.T_first_second, relative.T_first_second, atol=1e-12)
    np.testing.assert_allclose(back.covariance, relative.covariance, atol=1e-9)
    there_and_back = composed(relative, reversed_pose(relative))
    assert (there_and_back.first, there_and_back.second) == (3, 3)
    np.testing.assert_allclose(there_and_back.T_first_second, np.eye(4), atol=1e-12)
