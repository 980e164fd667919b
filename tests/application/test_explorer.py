"""Flights through unknown space: turns, courses, known space, paths and decisions."""

from dataclasses import replace
from math import pi, remainder
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dronevio.autonomy.exploration import exploration_scenario, explore
from dronevio.autonomy.pilot.decided_course import DecidedCourse, Motion
from dronevio.autonomy.pilot.explorer import Explorer
from dronevio.autonomy.pilot.heading import Turn
from dronevio.autonomy.pilot.map_route import MapRoute
from dronevio.autonomy.pilot.margin import RelativeMargin
from dronevio.autonomy.pilot.moment import Moment
from dronevio.autonomy.pilot.path_following import PathFollowing
from dronevio.autonomy.pilot.tasks import ReachGoal
from dronevio.autonomy.planning.body import Body
from dronevio.autonomy.planning.goal_path import path_to_goal
from dronevio.autonomy.planning.known_space import LocalSpace, around, with_free_column
from dronevio.autonomy.planning.landing import landing_place
from dronevio.autonomy.planning.local_plan import (
    at_rest,
    braking,
    place_above,
    place_beside,
    sampled,
    slowed,
    stop,
    straight,
    trajectory_along,
)
from dronevio.autonomy.planning.route import NoRoute, Route
from dronevio.autonomy.ray_sensing import DriftingOdometry, RayCameras, RaySensing
from dronevio.autonomy.settings import ExploreSettings
from dronevio.estimator.mapping.config import DenseMapConfig
from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples
from dronevio.models.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from dronevio.models.rotation import pose_matrix, rotation_z
from dronevio.models.state import CameraFrame, Estimate, Health, NavState
from dronevio.sim.closed_loop.flight import fly_closed_loop
from dronevio.sim.faults import Faults
from dronevio.sim.flight import Flight
from dronevio.sim.paths.limits import Limits

BODY = Body(0.45, 0.35, 0.2)
LIMITS = Limits(speed_m_s=2.0, accel_m_s2=3.0)
INTERVAL_NS = 5_000_000
S = 1_000_000_000
angles = st.floats(-7.0, 7.0)
rates = st.floats(-1.5, 1.5)


@given(angles, rates, angles)
def test_turn_reaches_the_heading_at_rest_within_its_bounds(yaw: float, rate: float, target: float) -> None:
    turn = Turn.toward(yaw, rate, target, 1.5, 3.0)
    t = np.arange(0.0, turn.duration_s + 0.02, 1e-3)
    yaws, yaw_rates = turn.at(t)
    assert yaws[0] == pytest.approx(yaw) and yaw_rates[0] == pytest.approx(rate, abs=0.01)
    assert turn.at(np.array([-1e-3]))[0][0] == pytest.approx(yaw - 1e-3 * rate, abs=2e-6)
    assert abs(remainder(yaws[-1] - target, 2 * pi)) < 1e-6 and yaw_rates[-1] == 0.0
    assert np.abs(yaw_rates).max() <= 1.5 + 1e-9
    assert np.abs(np.diff(yaw_rates)).max() <= 3.0 * 1e-3 + 1e-6
    np.testing.assert_allclose(np.diff(yaws), 0.5e-3 * (yaw_rates[1:] + yaw_rates[:-1]), atol=5e-6)
    assert abs(yaws[-1] - (yaw + rate * abs(rate) / 6.0)) <= pi + 1e-6  # the shorter way from where it can stop


def test_turn_by_hand() -> None:
    """Half a turn at 1 rad/s and 2 rad/s²: half a second to the rate, (π - 0.5) s at it, half a second to rest."""
    turn = Turn(0.0, 0.0, pi, 1.0, 2.0)
    assert turn.duration_s == pytest.approx(pi + 0.5)
    yaws, yaw_rates = turn.at(np.array([0.5, 1.5, pi]))
    np.testing.assert_allclose(yaws, [0.25, 1.25, pi - 0.25], atol=1e-12)
    np.testing.assert_allclose(yaw_rates, 1.0)


def course_of(*motions: Motion) -> DecidedCourse:
    course = DecidedCourse(np.zeros(3), 0.0, INTERVAL_NS, 60_000_000_000)
    for motion in motions:
        course.follow(motion)
    return course


def motion_to(end: Array, begins_ns: int = 0, start: Array | None = None) -> Motion:
    return Motion.of(
        straight(np.zeros(3) if start is None else start, end, 1.0),
        Turn(0.0, 0.0, 1.0, 1.5, 3.0),
        begins_ns,
        INTERVAL_NS,
    )


def test_course_stands_flies_and_holds_the_end() -> None:
    course = course_of(motion_to(np.array([0.0, 0.0, 1.0]), 1_000_000_000))
    assert not course.point(0).flying and not course.point(995_000_000).flying
    assert course.point(1_000_000_000).flying
    later = course.point(50_000_000_000)
    np.testing.assert_allclose(later.position_m, [0.0, 0.0, 1.0], atol=1e-6)
    np.testing.assert_array_equal(later.velocity_m_s, np.zeros(3))
    assert later.yaw_rad == pytest.approx(1.0)
    course.stop_rotors(55_000_000_000)
    assert course.point(54_995_000_000).flying and not course.point(55_000_000_000).flying


def test_motion_is_consistent_in_its_derivatives() -> None:
    motion = motion_to(np.array([1.0, 2.0, 0.5]))
    p, v, a, j = np.moveaxis(motion.states, 1, 0)
    for value, rate in ((p, v), (v, a), (a, j)):
        np.testing.assert_allclose(np.diff(value, axis=0) / 5e-3, 0.5 * (rate[1:] + rate[:-1]), atol=5e-3)
    # The body rates turn the flat attitude: for a motion without acceleration, the rate of the heading alone.
    still = Motion.of(at_rest(np.zeros(3)), Turn(0.0, 0.0, 2.0, 1.5, 3.0), 0, INTERVAL_NS)
    np.testing.assert_allclose(still.rate_rad_s[:, 2], still.yaw_rate_rad_s, atol=1e-2)
    np.testing.assert_allclose(still.rate_rad_s[:, :2], 0.0, atol=1e-9)


def test_a_new_motion_from_the_planned_state_leaves_no_step() -> None:
    course = course_of(motion_to(np.array([3.0, 0.0, 0.0])))
    begins_ns = 1_200_000_000
    state, yaw, rate = course.planned(begins_ns)
    course.follow(Motion.of(braking(state, LIMITS), Turn.toward(yaw, rate, -1.0, 1.5, 3.0), begins_ns, INTERVAL_NS))
    points = [course.point(t) for t in range(0, 4_000_000_000, INTERVAL_NS)]
    p, v, a = (np.array([getattr(each, name) for each in points]) for name in points[0]._fields[:3])
    assert np.abs(np.diff(p, axis=0)).max() < 2.0 * 5e-3
    assert np.abs(np.diff(v, axis=0)).max() < 1.05 * np.abs(a).max() * 5e-3
    assert np.abs(np.diff(a, axis=0)).max() < 0.3  # the jerk is bounded, too
    assert np.abs(np.diff([each.yaw_rad for each in points])).max() < 1.6 * 5e-3


def test_a_turn_that_is_planned_anew_does_not_kick_the_vehicle() -> None:
    """Each motion begins in the turn of the one before; the acceleration stays that of turns, 3 rad/s²."""
    course = course_of(Motion.of(at_rest(np.zeros(3)), Turn(0.0, 0.0, 3.0, 1.5, 3.0), 0, INTERVAL_NS))
    for begins_ns in (200_000_000, 700_000_000, 1_600_000_000):
        _, yaw, rate = course.planned(begins_ns)
        assert rate > 0.5
        turn = Turn.toward(yaw, rate, 3.0, 1.5, 3.0)
        course.follow(Motion.of(at_rest(np.zeros(3)), turn, begins_ns, INTERVAL_NS))
    points = [course.point(t) for t in range(0, 4_000_000_000, INTERVAL_NS)]
    assert np.abs(np.diff([each.rate_rad_s[2] for each in points])).max() < 3.1 * 5e-3
    assert np.abs([each.angular_acceleration_rad_s2[2] for each in points]).max() < 3.1


def test_later_decisions_replace_earlier_ones() -> None:
    first, second = motion_to(np.array([1.0, 0.0, 0.0]), 100 * INTERVAL_NS), motion_to(np.array([0.0, 1.0, 0.0]))
    course = course_of(first, replace(second, begins_ns=50 * INTERVAL_NS))
    np.testing.assert_allclose(course.point(10_000 * INTERVAL_NS).position_m, [0.0, 1.0, 0.0], atol=1e-6)


def grid_of(free: tuple[slice, ...], shape: tuple[int, int, int] = (60, 40, 20)) -> OccupancyGrid:
    states = np.full(shape, UNKNOWN, np.uint8)
    states[free] = FREE
    return OccupancyGrid(np.zeros(3), 0.1, states)


def test_margins_are_kept_from_surfaces_and_the_bare_body_from_the_unknown() -> None:
    """Free for x from 1 to 5 m; a wall of surfaces at the far end in the second grid."""
    grid = grid_of((slice(10, 50), slice(None), slice(None)))
    at = np.array([[1.25, 2.0, 1.0], [1.35, 2.0, 1.0], [1.45, 2.0, 1.0]])  # cells 12, 13, 14; the last unknown one is 9
    clearances = LocalSpace.of(grid, BODY, np.array([1.0, 2.0, 1.0])).clearances(at)
    np.testing.assert_allclose(clearances, [0.4, 0.5, 0.6], atol=1e-6)  # 0.3, 0.4, 0.5 m and the margin of 0.1 m
    states = grid.states.copy()
    states[9] = OCCUPIED
    walled = LocalSpace.of(replace(grid, states=states), BODY, np.array([1.0, 2.0, 1.0]))
    np.testing.assert_allclose(walled.clearances(at), [0.3, 0.4, 0.5], atol=1e-6)


@pytest.mark.parametrize(
    ("thickness", "at_m", "passes"), [(1, 1.0, True), (4, 1.0, True), (5, 1.0, False), (1, 2.5, True), (2, 2.5, False)]
)
def test_thin_unknown_gaps_are_passed(thickness: int, at_m: float, passes: bool) -> None:
    """The gap begins at x = 3 m: it may have four cells if the vehicle is farther than 1.9 m from it, otherwise one."""
    grid = grid_of((slice(1, 59), slice(1, 39), slice(1, 19)))
    grid.states[30 : 30 + thickness] = UNKNOWN
    space = LocalSpace.of(grid, BODY, np.array([at_m, 2.0, 1.0]))
    path = np.linspace([1.0, 2.0, 1.0], [5.0, 2.0, 1.0], 41)
    start = np.vstack([path[:1], np.zeros((3, 3))])
    trajectory = trajectory_along(space, path, start, BODY, LIMITS)
    assert trajectory is not None
    end = trajectory.control_points[-1, -1, 0]
    assert (end > 4.5) if passes else (end < 2.7)


def test_trajectory_goes_as_far_as_is_known_and_stays_clear() -> None:
    grid = grid_of((slice(1, 40), slice(1, 39), slice(1, 19)))
    grid.states[20, :22] = OCCUPIED
    space = LocalSpace.of(grid, BODY, np.array([1.0, 2.0, 1.0]))
    path = np.linspace([1.0, 1.0, 1.0], [5.5, 3.0, 1.0], 50)
    start = np.vstack([path[:1], np.zeros((3, 3))])
    trajectory = trajectory_along(space, path, start, BODY, LIMITS)
    assert trajectory is not None
    points = trajectory.path(np.linspace(0.0, trajectory.duration_s, 300))
    assert space.clearances(points).min() >= BODY.radius_m - 1e-6
    assert 3.2 < points[-1, 0] < 3.7  # the free space ends at 4 m
    np.testing.assert_allclose(trajectory.state(trajectory.duration_s)[1:], 0.0, atol=1e-6)
    walled = grid.states.copy()
    walled[20] = OCCUPIED
    assert (
        trajectory_along(
            LocalSpace.of(replace(grid, states=walled), BODY, np.array([1.0, 2.0, 1.0])), path[30:], start, BODY, LIMITS
        )
        is None
    )


@pytest.mark.parametrize("speed_m_s", [0.0, 0.5])
def test_from_a_narrow_place_the_way_leads_back_to_room(speed_m_s: float) -> None:
    """At 0.25 m from a wall at x = 1 m, the body has less room than 0.45 m; only at rest, it moves back."""
    grid = grid_of((slice(1, 59), slice(1, 39), slice(1, 19)))
    grid.states[:10] = OCCUPIED
    start = np.vstack([[1.2, 2.0, 1.0], [0.0, speed_m_s, 0.0], np.zeros((2, 3))])
    space = LocalSpace.of(grid, BODY, start[0])
    trajectory = trajectory_along(space, np.linspace(start[0], [4.0, 2.0, 1.0], 29), start, BODY, LIMITS)
    if speed_m_s:
        assert trajectory is None
        return
    assert trajectory is not None
    points = trajectory.path(np.linspace(0.0, trajectory.duration_s, 50))
    assert np.all(np.diff(space.clearances(points)) >= -1e-6)
    assert BODY.radius_m <= space.clearances(points[-1:])[0] < BODY.radius_m + 0.15
    # Behind what is not known to be free, there is no way back.
    grid.states[13:16] = UNKNOWN
    shut = LocalSpace.of(grid, BODY, start[0])
    assert trajectory_along(shut, np.linspace(start[0], [4.0, 2.0, 1.0], 29), start, BODY, LIMITS) is None


@pytest.mark.parametrize(("x_m", "most_m_s2"), [(1.5, 3.0), (2.0, 6.0)])
def test_stop_ends_before_the_obstacle_ahead(x_m: float, most_m_s2: float) -> None:
    """The body has room up to x = 2.75 m; with less of it, the stop is harder, but not where there is enough."""
    grid = grid_of((slice(1, 59), slice(1, 39), slice(1, 19)))
    grid.states[32:] = OCCUPIED
    start = np.array([[x_m, 2.0, 1.0], [1.9, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    space = LocalSpace.of(grid, BODY, start[0])
    trajectory = stop(space, start, BODY, LIMITS)
    t = np.linspace(0.0, trajectory.duration_s, 100)
    assert space.clearances(trajectory.path(t)).min() >= BODY.radius_m - 1e-6
    np.testing.assert_allclose(trajectory.state(trajectory.duration_s)[1:], 0.0, atol=1e-6)
    accel = np.linalg.norm(trajectory.path.derivative(2)(t), axis=1).max()
    assert 0.5 * most_m_s2 < accel <= most_m_s2


def test_without_room_to_stop_the_vehicle_brakes_as_hard_as_it_can() -> None:
    """At 0.25 m from where the body has no more room, at 1.9 m/s."""
    grid = grid_of((slice(1, 59), slice(1, 39), slice(1, 19)))
    grid.states[32:] = OCCUPIED
    start = np.array([[2.5, 2.0, 1.0], [1.9, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    hard, nominal = stop(LocalSpace.of(grid, BODY, start[0]), start, BODY, LIMITS), braking(start, LIMITS)
    lengths = [t.path(t.duration_s)[0] - 2.5 for t in (hard, nominal)]
    assert lengths[0] < 0.6 * lengths[1]


@pytest.mark.parametrize("speed_m_s", [1.0, 2.0, 2.1])
def test_braking_from_the_limit_of_speed_keeps_that_of_acceleration(speed_m_s: float) -> None:
    trajectory = braking(np.array([np.zeros(3), [speed_m_s, 0.0, 0.0], np.zeros(3), np.zeros(3)]), LIMITS)
    accel = np.linalg.norm(trajectory.path.derivative(2)(np.linspace(0.0, trajectory.duration_s, 100)), axis=1)
    assert accel.max() <= LIMITS.accel_m_s2


def test_stop_of_a_descending_vehicle_is_nearly_level() -> None:
    """With a velocity and an acceleration downward, it must not sink by half a metre."""
    grid = grid_of((slice(1, 59), slice(1, 39), slice(1, 19)))
    start = np.array([[1.5, 2.0, 1.0], [1.8, 0.0, -0.3], [0.0, 0.0, -1.0], [0.0, 0.0, 0.0]])
    space = LocalSpace.of(grid, BODY, start[0])
    for trajectory in (stop(space, start, BODY, LIMITS), braking(start, LIMITS)):
        heights = trajectory.path(np.linspace(0.0, trajectory.duration_s, 100))[:, 2]
        assert np.abs(heights - 1.0).max() <= 0.15 + 1e-6
        np.testing.assert_allclose(trajectory.state(trajectory.duration_s)[1:], 0.0, atol=1e-6)


def test_heights_bound_the_space_but_for_where_the_vehicle_is() -> None:
    grid, heights_m = grid_of((slice(1, 59), slice(1, 39), slice(1, 19))), np.array([0.8, 1.2])
    at = np.array([[2.0, 2.0, z] for z in (0.65, 0.75, 0.85, 1.15, 1.25, 1.35)])
    clear = LocalSpace.of(grid, BODY, np.array([1.0, 2.0, 1.0]), heights_m).clearances(at) > 0.0
    assert clear.tolist() == [False, False, True, True, False, False]
    below = LocalSpace.of(grid, BODY, np.array([1.0, 2.0, 0.66]), heights_m).clearances(at) > 0.0
    assert below.tolist() == [True, True, True, True, False, False]


@pytest.mark.parametrize("z", [0.3, 1.0, 2.4])
def test_a_path_from_outside_the_heights_leads_to_them_first(z: float) -> None:
    grid = grid_of((slice(1, 59), slice(1, 39), slice(1, 29)))
    start, goal = np.array([1.0, 2.0, z]), np.array([4.0, 2.0, 1.0])
    found = path_to_goal(grid, start, goal, BODY, (0.8, 1.5), np.zeros((0, 3)))
    assert isinstance(found, Route)
    np.testing.assert_array_equal(found.waypoints[0], start)
    np.testing.assert_allclose(found.waypoints[-1], goal, atol=0.06)
    rest = found.waypoints[1:] if z != 1.0 else found.waypoints
    assert np.all((rest[:, 2] > 0.8 - 1e-6) & (rest[:, 2] < 1.5 + 1e-6))


def test_what_was_given_up_is_not_given_up_again_and_routes_avoid_it() -> None:
    """A gate of unknown space in a wall at x = 3 m; the way around it is free."""
    grid = grid_of((slice(1, 59), slice(1, 39), slice(1, 19)))
    grid.states[29:31, :30] = OCCUPIED
    grid.states[29:31, 10:22] = UNKNOWN
    said: list[str] = []
    route, heights_m = MapRoute(1_000_000_000, said.append), np.array([0.5, 1.5])
    start, goal = np.vstack([[2.0, 1.6, 1.0], np.zeros((3, 3))]), np.array([4.0, 1.6, 1.0])
    m = Moment(0, 0, start, 0.0, 0.0, BODY, grid, np.eye(4), np.eye(4), Estimate(0, Health.TRACKING, None))
    through = route.path(m, lambda: grid, goal, heights_m)
    assert through is not None and np.abs(through[:, 1] - 1.6).max() < 0.3
    ahead = sampled(through, start[0])[8:]
    assert route.give_up(m, BODY, ahead) and route.is_due(0)
    around = route.path(m, lambda: grid, goal, heights_m)
    assert around is not None and around[:, 1].max() > 3.0
    assert not route.give_up(m, BODY, ahead) and len(said) == 1


@pytest.mark.parametrize("peeks", [True, False])
def test_a_path_that_leads_nowhere_is_looked_at_from_three_places_and_then_given_up(peeks: bool) -> None:
    """Space is unknown beyond x = 3 m. Each trajectory is flown to its end, which may lie 0.6 m and more away."""
    grid = grid_of((slice(1, 30), slice(1, 39), slice(1, 19)))
    path = np.linspace([1.0, 2.0, 1.0], [5.0, 2.0, 1.0], 41)
    position, now_ns, following, whats = np.array([1.0, 2.0, 1.0]), 0, PathFollowing(LIMITS), list[str]()
    for _ in range(200):
        start, estimate = np.vstack([position, np.zeros((3, 3))]), Estimate(now_ns, Health.TRACKING, None)
        m = Moment(now_ns, now_ns, start, 0.0, 0.0, BODY, grid, np.eye(4), np.eye(4), estimate)
        space = LocalSpace.of(grid, BODY, position)
        step = following.step(m, space, sampled(path, position), position[None], 0.0, peeks=peeks)
        assert step.what is not None and step.trajectory is not None
        whats.append(step.what)
        if step.is_stuck:
            break
        position = step.trajectory.control_points[-1, -1]
        now_ns += max(round(1e9 * step.trajectory.duration_s) + 1, 200_000_000)
    assert step.is_stuck and whats[0] == "fly" and whats.count("look from another place") == (3 if peeks else 0)


def test_a_look_from_another_place_is_not_broken_off_while_the_vehicle_is_slow() -> None:
    grid = grid_of((slice(1, 30), slice(1, 39), slice(1, 19)))
    position, path = np.array([2.55, 2.0, 1.0]), np.linspace([2.55, 2.0, 1.0], [5.0, 2.0, 1.0], 25)
    space, following = LocalSpace.of(grid, BODY, position), PathFollowing(LIMITS)
    estimate = Estimate(0, Health.TRACKING, None)
    for now_ns, speed_m_s, what in (
        (S, 0.0, "look"),
        (4 * S, 0.0, "look from another place"),
        (4 * S + S // 5, 0.05, None),
    ):
        start = np.vstack([position, [0.0, speed_m_s, 0.0], np.zeros((2, 3))])
        m = Moment(now_ns, now_ns, start, 0.0, 0.0, BODY, grid, np.eye(4), np.eye(4), estimate)
        assert following.step(m, space, path, position[None], None).what == what


def test_a_slow_vehicle_flies_its_trajectory_to_the_end_before_it_looks() -> None:
    """A stop from some cm/s takes hundredths of a second, and would turn the vehicle faster than it can."""
    grid, position = grid_of((slice(1, 30), slice(1, 39), slice(1, 19))), np.array([2.55, 2.0, 1.0])
    path = np.linspace(position, [5.0, 2.0, 1.0], 25)
    space, following = LocalSpace.of(grid, BODY, position), PathFollowing(LIMITS)
    for speed_m_s, accel_m_s2, what in ((0.09, 0.5, None), (0.02, 0.3, None), (0.0, 0.1, None), (0.0, 0.0, "look")):
        start = np.vstack([position, [speed_m_s, 0.0, 0.0], [-accel_m_s2, 0.0, 0.0], np.zeros(3)])
        m = Moment(S, S, start, 0.0, 0.0, BODY, grid, np.eye(4), np.eye(4), Estimate(S, Health.TRACKING, None))
        assert following.step(m, space, path, position[None], None).what == what


def test_the_vehicle_turns_before_it_flies_where_it_does_not_see() -> None:
    grid, position = grid_of((slice(1, 59), slice(1, 39), slice(1, 19))), np.array([1.0, 2.0, 1.0])
    start, path = np.vstack([position, np.zeros((3, 3))]), np.linspace(position, [5.0, 2.0, 1.0], 41)
    m = Moment(0, 0, start, 0.0, 0.0, BODY, grid, np.eye(4), np.eye(4), Estimate(0, Health.TRACKING, None))
    space = LocalSpace.of(grid, BODY, position)
    whats = [PathFollowing(LIMITS).step(m, space, path, path, angle).what for angle in (1.0, -1.0, 0.8, 2 * pi, None)]
    assert whats == ["turn", "turn", "fly", "fly", "fly"]


def test_a_place_above_or_below_is_in_reach() -> None:
    """Free from z = 0.1 to 1.9 m; with a bound at 1.3 m, below is farther; in a flat gap, the place is beside."""
    grid, position, ahead = grid_of((slice(1, 59), slice(1, 39), slice(1, 19))), np.array([2.0, 2.0, 1.0]), np.ones(3)
    above = place_above(LocalSpace.of(grid, BODY, position), position, ahead, BODY)
    assert above is not None and above[:2].tolist() == [2.0, 2.0] and 0.25 <= abs(above[2] - 1.0) <= 0.5
    bounded = LocalSpace.of(grid, BODY, position, np.array([0.5, 1.2]))
    below = place_above(bounded, position, ahead, BODY)
    assert below is not None and below[2] < 0.7
    flat = LocalSpace.of(grid, BODY, position, np.array([0.9, 1.1]))
    beside, expected = place_above(flat, position, ahead, BODY), place_beside(flat, position, ahead, BODY)
    assert beside is not None and expected is not None
    np.testing.assert_array_equal(beside, expected)


def test_a_place_beside_is_clear_and_aside() -> None:
    grid = grid_of((slice(1, 59), slice(1, 39), slice(1, 19)))
    grid.states[:, 24:] = OCCUPIED
    space, position = LocalSpace.of(grid, BODY, np.array([2.0, 1.8, 1.0])), np.array([2.0, 1.8, 1.0])
    place = place_beside(space, position, np.array([5.0, 1.8, 1.0]), BODY)
    assert place is not None and space.clearances(place[None])[0] >= BODY.radius_m - 1e-6
    assert place[1] < 1.1 and 0.3 <= np.hypot(*(place - position)[:2]) <= 1.0 and place[2] == 1.0
    narrow = np.full(grid.states.shape, UNKNOWN, np.uint8)
    narrow[15:26, 13:23, :] = FREE
    alone = LocalSpace.of(replace(grid, states=narrow), BODY, position)
    assert place_beside(alone, position, np.array([5.0, 1.8, 1.0]), BODY) is None


def floor_with(hole: tuple[slice, slice] | None) -> OccupancyGrid:
    """Return free space above a floor at the level of cell 2, which was not seen in a hole."""
    grid = grid_of((slice(1, 59), slice(1, 39), slice(3, 19)))
    grid.states[..., 2] = OCCUPIED
    if hole is not None:
        grid.states[(*hole, slice(0, 6))] = UNKNOWN
    return grid


def test_landing_is_on_observed_level_floor() -> None:
    position = np.array([3.05, 2.05, 1.25])
    here = landing_place(LocalSpace.of(floor_with(None), BODY, position), position, BODY)
    assert here is not None
    np.testing.assert_array_equal(here, position)
    hole = floor_with((slice(26, 35), slice(None)))
    aside = landing_place(LocalSpace.of(hole, BODY, position), position, BODY)
    assert aside is not None and abs(aside[0] - position[0]) == pytest.approx(0.8, abs=0.16)
    step = floor_with(None)
    step.states[26:35, :, 4] = OCCUPIED
    step.states[26:30, :, 6] = OCCUPIED
    elsewhere = landing_place(LocalSpace.of(step, BODY, position), position, BODY)
    assert elsewhere is not None and abs(elsewhere[0] - position[0]) > 0.5
    assert landing_place(LocalSpace.of(floor_with((slice(None), slice(None))), BODY, position), position, BODY) is None


def test_slowed_trajectory_has_the_same_path() -> None:
    fast = straight(np.zeros(3), np.array([1.0, 0.0, 0.0]), 1.0)
    slow = slowed(fast, 3.0 * fast.duration_s)
    assert slow.duration_s == pytest.approx(3.0 * fast.duration_s)
    np.testing.assert_allclose(slow.path(1.5 * fast.duration_s), fast.path(0.5 * fast.duration_s), atol=1e-9)
    assert slowed(fast, 0.1).duration_s == fast.duration_s


def test_sampled_path_begins_at_the_nearest_point() -> None:
    path = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0]])
    points = sampled(path, np.array([0.52, 0.3, 0.0]), 0.8)
    np.testing.assert_allclose(points[0], [0.5, 0.0, 0.0], atol=1e-9)
    assert 0.8 <= np.linalg.norm(np.diff(points, axis=0), axis=1).sum() <= 1.0
    np.testing.assert_allclose(sampled(path, path[0])[-1], path[-1], atol=1e-9)


def test_column_frees_the_unknown_alone() -> None:
    grid = grid_of((slice(0, 0),) * 3)
    grid.states[30, 20, 5] = OCCUPIED
    column = with_free_column(grid, np.array([3.05, 2.05, 0.05]), 0.5, 1.0)
    assert column.states[30, 20, 5] == OCCUPIED and column.states[33, 20, 9] == FREE
    assert column.states[36, 20, 5] == UNKNOWN and column.states[30, 20, 15] == UNKNOWN
    assert (grid.states == FREE).sum() == 0
    free = grid.centres(np.argwhere(column.states == FREE))
    assert np.hypot(*(free - [3.05, 2.05, 0.0])[:, :2].T).max() <= 0.5


def test_around_covers_the_body() -> None:
    points = around(np.zeros((1, 3)), BODY, 0.1)
    assert np.hypot(points[:, 0], points[:, 1]).max() == pytest.approx(0.45, abs=0.06)
    assert np.abs(points[:, 2]).max() == pytest.approx(0.2)


def test_margin_grows_with_the_covariance_since_the_map_was_seen() -> None:
    """4 cm² more than the least of the last four seconds: 2 σ are 4 cm; what is older does not count."""
    margin, grown = RelativeMargin(), [0.01, 0.01, 0.0104]
    at = [margin.add(k * 1_000_000_000, np.diag(np.full(15, variance))) for k, variance in enumerate(grown)]
    assert at[:2] == [0.0, 0.0] and at[2] == pytest.approx(0.04)
    assert margin.add(5_500_000_000, np.diag(np.full(15, 0.0104))) == pytest.approx(0.0, abs=1e-6)
    assert margin.add(6_000_000_000, np.eye(15)) == 0.15
    assert margin.add(7_000_000_000, None) == 0.0
    larger = BODY.grown(0.1)
    assert (larger.radius_m, larger.bare_radius_m) == pytest.approx((0.55, 0.45))


def walled_map(gap: slice | None) -> OccupancyGrid:
    """Return a map in which the wall x = 3 m is known from y = 0 to 6 m, but for a gap."""
    states = np.full((60, 60, 26), UNKNOWN, np.uint8)
    states[:29] = FREE
    states[30] = OCCUPIED
    if gap is not None:
        states[30, gap] = UNKNOWN
    return OccupancyGrid(np.zeros(3), 0.1, states, "map")


def test_path_leads_through_unknown_space_and_around_what_is_known() -> None:
    start, goal = np.array([1.0, 3.0, 1.2]), np.array([5.0, 3.0, 1.2])
    through = path_to_goal(walled_map(slice(24, 36)), start, goal, BODY, (0.5, 2.0), np.zeros((0, 3)))
    assert isinstance(through, Route) and through.length_m == pytest.approx(4.0, abs=0.05)
    past = path_to_goal(walled_map(None), start, goal, BODY, (0.5, 2.0), np.zeros((0, 3)))
    assert isinstance(past, Route) and past.length_m > 2 * np.hypot(2.0, 3.3)
    assert past.waypoints[:, 2].min() >= 0.5 and past.waypoints[:, 2].max() <= 2.0


def test_what_was_given_up_blocks_until_it_is_seen_to_be_free() -> None:
    start, goal = np.array([1.0, 3.0, 1.2]), np.array([5.0, 3.0, 1.2])
    y, z = np.meshgrid(np.arange(2.45, 3.6, 0.1), np.arange(0.05, 2.6, 0.1))
    given_up = np.stack([np.full(y.size, 3.05), y.ravel(), z.ravel()], axis=-1)
    known = walled_map(slice(24, 36))
    past = path_to_goal(known, start, goal, BODY, (0.5, 2.0), given_up)
    assert isinstance(past, Route) and past.length_m > 6.0
    known.states[30, 24:36] = FREE
    through = path_to_goal(known, start, goal, BODY, (0.5, 2.0), given_up)
    assert isinstance(through, Route) and through.length_m < 4.1


@pytest.mark.parametrize("far", [[1000.0, 500.0], [-1000.0, 3.0], [3.0, 1000.0]])
def test_path_to_a_far_goal_is_sought_nearby_and_then_straight(far: list[float]) -> None:
    start, goal = np.array([1.0, 3.0, 1.2]), np.array([*far, 1.2])
    found = path_to_goal(walled_map(None), start, goal, BODY, (0.5, 2.0), np.zeros((0, 3)))
    assert isinstance(found, Route) and found.expansions < 1e5
    np.testing.assert_array_equal(found.waypoints[[0, -1]], [start, goal])
    assert found.length_m < 1.01 * np.linalg.norm(goal - start)
    near = sampled(found.waypoints, start, 8.0)
    assert walled_map(None).at(near[walled_map(None).at(near) != UNKNOWN]).max(initial=FREE) == FREE
    above = path_to_goal(walled_map(None), start, goal + [0.0, 0.0, 5.0], BODY, (0.5, 2.0), np.zeros((0, 3)))
    assert isinstance(above, NoRoute) and above.cause == "goal"


def test_there_is_no_path_into_a_closed_room() -> None:
    states = np.full((60, 60, 26), FREE, np.uint8)
    states[20:41, 20:41] = OCCUPIED
    states[21:40, 21:40] = UNKNOWN
    known = OccupancyGrid(np.zeros(3), 0.1, states, "map")
    found = path_to_goal(
        known, np.array([1.0, 3.0, 1.2]), np.array([3.0, 3.0, 1.2]), BODY, (0.5, 2.0), np.zeros((0, 3))
    )
    assert isinstance(found, NoRoute) and found.cause == "goal"


def test_arguments_are_checked() -> None:
    with pytest.raises(ConfigError, match="'attic' to explore"):
        exploration_scenario("attic")
    with pytest.raises(ConfigError, match="three finite numbers"):
        explore("room", (1.0, float("nan"), 0.0), without_images=RaySensing())
    assert exploration_scenario("room-easy", 3).world == "room"


@pytest.fixture(scope="module")
def in_room() -> Flight:
    found = explore("room", (2.0, -1.5, 1.2), without_images=RaySensing(), longest_s=40.0)
    assert found.scores.outcome == "reached" and not found.scores.collided
    scores = found.scores
    assert scores.distance_to_goal_m is not None and scores.shortest_m is not None and scores.ate_m is not None
    assert scores.distance_to_goal_m < 0.4 and scores.path_m < 1.3 * scores.shortest_m
    return found.flight


def test_flight_to_a_goal_is_deterministic(in_room: Flight) -> None:
    again = explore("room", (2.0, -1.5, 1.2), without_images=RaySensing(), longest_s=40.0)
    np.testing.assert_array_equal(again.flight.truth.p_world_imu, in_room.truth.p_world_imu)


def test_goal_behind_walls_is_unreachable_and_the_vehicle_returns_home() -> None:
    found = explore("room", (9.0, 0.0, 1.2), without_images=RaySensing(), longest_s=90.0)
    assert found.scores.outcome == "unreachable" and not found.scores.collided
    home = found.flight.truth.p_world_imu[-1]
    assert np.linalg.norm(home[:2]) < 0.3 and home[2] < 0.3


def test_goal_without_room_for_the_body_is_not_circled() -> None:
    found = explore("room", (1.0, -2.0, 1.0), without_images=RaySensing(), longest_s=60.0)
    assert found.scores.outcome in ("reached", "unreachable") and not found.scores.collided
    assert found.scores.time_s < 40.0


def test_without_light_the_vehicle_lands_on_observed_floor() -> None:
    scenario = replace(exploration_scenario("warehouse", 3), faults=Faults(dark_from_s=17.0, dark_for_s=60.0))
    found = explore(scenario, longest_s=60.0, without_images=RaySensing())
    said = [each.what for each in found.decisions]
    assert found.scores.outcome == "lost" and not found.scores.collided
    assert "no depth: stop" in said and said.count("no depth: brake") <= 1 and said[-1] == "no depth: land"
    truth = found.flight.truth
    speed = np.linalg.norm(truth.velocity_m_s, axis=1)  # type: ignore[arg-type]
    assert speed[truth.t_s < 17.0].max() > 1.0 and speed[np.argmin(np.abs(truth.t_s - 18.8))] < 0.3
    assert found.flight.truth.p_world_imu[-1, 2] < 0.3


def test_a_goal_that_cannot_be_approached_any_further_is_reached_from_nearby(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scenario, goal = exploration_scenario("room", 0), np.array([2.0, -1.5, 1.2])
    cameras = RayCameras("room", 0, scenario.rig, 0)
    whole = MapRoute.path

    def ends_aside(route: MapRoute, m: Moment, known: Any, target: Array, heights_m: Array) -> Array | None:
        aside = target + [-0.33, 0.0, 0.0]
        return None if np.linalg.norm(m.position_map_m - aside) < 0.15 else whole(route, m, known, aside, heights_m)

    monkeypatch.setattr(MapRoute, "path", ends_aside)
    pilot = Explorer(ReachGoal(goal), 40.0, source=cameras)
    flight = fly_closed_loop(scenario, DriftingOdometry(cameras, 0), cameras, pilot=pilot)
    assert pilot.outcome == "reached" and flight.collision is None
    assert 0.2 < np.linalg.norm(flight.truth.p_world_imu[-1] - goal) < 0.5


def test_where_it_is_near_enough_the_vehicle_does_not_look_from_other_places(monkeypatch: pytest.MonkeyPatch) -> None:
    scenario, goal = exploration_scenario("room", 0), np.array([2.0, -1.5, 1.2])
    cameras, seen, step = RayCameras("room", 0, scenario.rig, 0), list[tuple[bool, bool]](), PathFollowing.step

    def recorded(following: PathFollowing, m: Moment, *arguments: Any, peeks: bool) -> Any:
        apart_m = np.linalg.norm(m.position_map_m - m.to_map(m.from_world(goal)))
        seen.append((bool(apart_m >= 0.4), peeks))
        return step(following, m, *arguments, peeks=peeks)

    monkeypatch.setattr(PathFollowing, "step", recorded)
    fly_closed_loop(
        scenario, DriftingOdometry(cameras, 0), cameras, pilot=Explorer(ReachGoal(goal), 40.0, source=cameras)
    )
    assert {is_far for is_far, _ in seen} == {True, False}
    assert all(is_far is peeks for is_far, peeks in seen)


class Lost:
    """An odometry that is lost from a time on, and believes to be higher and higher; implements `Estimator`."""

    def __init__(self, odometry: DriftingOdometry, t_ns: int) -> None:
        self._odometry, self._t_ns = odometry, t_ns

    def add_imu(self, samples: ImuSamples) -> None:
        self._odometry.add_imu(samples)

    def add_frame(self, frame: CameraFrame) -> Estimate:
        estimate = self._odometry.add_frame(frame)
        return replace(estimate, health=Health.LOST) if frame.t_ns >= self._t_ns else estimate

    def state_at(self, t_ns: int) -> NavState | None:
        state = self._odometry.state_at(t_ns)
        if state is None:
            return None
        T = state.T_world_imu.copy()
        T[2, 3] += 0.2 * max(t_ns - self._t_ns, 0) * 1e-9
        return replace(state, T_world_imu=T)


def test_vibration_of_a_descent_is_no_impact() -> None:
    """Rotors shake the IMU by 30 m/s² at 60 Hz; the ground pushes with 40 m/s² for 25 ms."""
    pilot, stops = Explorer(ReachGoal(np.zeros(3)), 40.0), list[int]()
    pilot._course = SimpleNamespace(now_ns=7, stop_rotors=stops.append)  # type: ignore[assignment]
    pilot._is_landing = True
    t_s = np.arange(200) * 5e-3
    accel = np.column_stack([np.zeros((200, 2)), 9.81 + 30.0 * np.sin(2.0 * np.pi * 60.0 * t_s)])
    for t_ns, row in zip((1e9 * t_s).astype(np.int64), accel, strict=True):
        pilot.add_imu(ImuSamples(t_ns[None], np.zeros((1, 3)), row[None]))
    assert accel[:, 2].max() > 35.0 and not stops
    late_ns = np.arange(200, 205) * 5_000_000
    pilot.add_imu(ImuSamples(late_ns, np.zeros((5, 3)), np.tile([0.0, 0.0, 40.0], (5, 1))))
    assert stops == [7]


@pytest.mark.parametrize("imu_hz", [100.0, 200.0, 400.0])
def test_a_lost_vehicle_stops_its_rotors_when_it_meets_the_ground(imu_hz: float) -> None:
    """By its estimate it is still half a metre high."""
    scenario = exploration_scenario("room", 0)
    scenario = replace(scenario, rig=replace(scenario.rig, imu=replace(scenario.rig.imu, rate_hz=imu_hz)))
    cameras = RayCameras("room", 0, scenario.rig, 0)
    pilot = Explorer(ReachGoal(np.array([2.0, -1.5, 1.2])), 40.0, source=cameras)
    flight = fly_closed_loop(scenario, Lost(DriftingOdometry(cameras, 0), 14 * S), cameras, pilot=pilot)
    assert pilot.outcome == "lost" and flight.collision is None
    height_m, t_s = flight.truth.p_world_imu[:, 2], flight.truth.t_s
    met_s = t_s[np.flatnonzero(height_m > height_m[-1] + 0.05)[-1]]
    assert height_m.max() > 1.0 and height_m[-1] < 0.2 and t_s[-1] - met_s < 0.5
    assert flight.reference.position_m[-1, 2] > height_m[-1] + 0.3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("camera_hz", "imu_hz", "depth_hz"), [(12.0, 100.0, 10.0), (30.0, 400.0, 10.0), (20.0, 200.0, 3.0)]
)
def test_flights_do_not_depend_on_the_rates(camera_hz: float, imu_hz: float, depth_hz: float) -> None:
    scenario = exploration_scenario("office", 4)
    cameras = tuple(replace(camera, rate_hz=camera_hz) for camera in scenario.rig.cameras)
    rig = replace(scenario.rig, cameras=cameras, imu=replace(scenario.rig.imu, rate_hz=imu_hz))
    settings = ExploreSettings(map=DenseMapConfig(rate_hz=depth_hz))
    found = explore(replace(scenario, rig=rig), settings=settings, without_images=RaySensing())
    assert found.scores.outcome == "reached" and not found.scores.collided


class Jumping:
    """An odometry whose correction by the map jumps at a time; implements `Estimator`."""

    def __init__(self, odometry: DriftingOdometry, t_ns: int) -> None:
        self._odometry, self._t_ns = odometry, t_ns

    def add_imu(self, samples: ImuSamples) -> None:
        self._odometry.add_imu(samples)

    def add_frame(self, frame: CameraFrame) -> Estimate:
        estimate = self._odometry.add_frame(frame)
        jump = pose_matrix(rotation_z(np.deg2rad(10.0)), np.array([0.8, 0.6, 0.0]))
        return replace(estimate, T_map_odom=jump if frame.t_ns >= self._t_ns else np.eye(4))

    def state_at(self, t_ns: int) -> NavState | None:
        return self._odometry.state_at(t_ns)


def flown_with_jump(t_ns: int) -> tuple[Flight, Explorer]:
    """Fly to a goal in a room of the office, with a correction of 1 m and 10° at a time."""
    scenario = exploration_scenario("office", 0)
    cameras = RayCameras(scenario.world, 0, scenario.rig, 0)
    pilot = Explorer(ReachGoal(np.array([-0.35, -7.55, 1.25])), 45.0, source=cameras)
    odometry = Jumping(DriftingOdometry(cameras, 0), t_ns)
    return fly_closed_loop(scenario, odometry, cameras, pilot=pilot), pilot


@pytest.mark.slow
def test_a_correction_in_a_doorway_neither_jerks_the_vehicle_nor_makes_it_touch() -> None:
    calm, _ = flown_with_jump(10**12)
    assert calm.collision is None
    position = calm.truth.p_world_imu
    door = _door_passed(position)
    corrected, pilot = flown_with_jump(int(calm.truth.t_ns[door]))
    assert corrected.collision is None and pilot.outcome != "lost"
    for flight in (calm, corrected):
        reference = flight.reference
        assert np.abs(np.diff(reference.position_m, axis=0)).max() < 2.2 * 5e-3
        assert np.abs(np.diff(reference.velocity_m_s, axis=0)).max() < 6.0 * 5e-3
        assert np.abs(np.diff(reference.acceleration_m_s2, axis=0)).max() < 0.5
        assert np.abs(np.diff(np.unwrap(reference.yaw_rad))).max() < 1.6 * 5e-3
    assert np.any(np.abs(corrected.truth.p_world_imu[-1] - calm.truth.p_world_imu[-1]) > 0.3)  # the goal has moved


def _door_passed(position: Array) -> int:
    """Return the row at which a path (N, 3) passes from the south corridor into a room of the strip."""
    return int(np.argmax(position[:, 1] < -4.27))
