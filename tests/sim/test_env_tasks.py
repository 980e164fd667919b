"""Tasks: initial states, goals, rewards and ends of episodes, against values worked out by hand."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dronevio.models.errors import ConfigError
from dronevio.models.quadrotor import RESEARCH
from dronevio.sim.envs.tasks import (
    TASKS,
    AnyTask,
    Explore,
    Hover,
    Navigate,
    PointGoals,
    Race,
    Track,
    Transition,
    Waypoints,
    task_named,
)
from dronevio.sim.envs.tasks.explore import ExploreGoals
from dronevio.sim.envs.tasks.race import RaceGoals
from dronevio.sim.envs.tasks.track import TrackGoals
from dronevio.sim.envs.tasks.waypoints import WaypointsGoals
from dronevio.sim.paths.space import FlightArea, Gate, Space
from dronevio.sim.physics.vehicle_states import VehicleStates

Array = np.ndarray

AREA = FlightArea(
    Space(
        np.array([-10.0, -10.0, 0.0]),
        np.array([10.0, 10.0, 5.0]),
        np.array([[3.0, 0.0, 2.5]]),
        np.array([[1.0, 1.0, 2.5]]),
        np.eye(3)[None],
    ),
    np.array([[-2.0, -2.0, 0.0], [2.0, 2.0, 3.0]]),
    np.zeros(3),
    np.zeros((0, 3)),
    (Gate(np.array([5.0, 0.0, 2.0]), 0.0, 2.0), Gate(np.array([0.0, 5.0, 2.0]), np.pi, 2.0)),
)

IN_THE_AIR = [name for name, task in TASKS.items() if not task.lands]


def step(before: Any, after: Any, failed: bool = False, t_s: float = 0.02) -> Transition:
    """Return a transition of one vehicle between positions, at rest and with zero actions."""
    first, last = (VehicleStates.at(np.array([position])) for position in (before, after))
    return Transition(first, last, np.zeros((1, 4)), np.zeros((1, 4)), np.array([t_s]), np.array([failed]))


@pytest.mark.parametrize("name", IN_THE_AIR)
def test_episodes_start_within_the_bounds(name: str) -> None:
    task: AnyTask = TASKS[name]
    states, goals = task.begin(AREA, RESEARCH, np.random.default_rng(0), 200)
    low, high = task.bounds_m(AREA)
    assert np.all(states.position_m > low) and np.all(states.position_m < high)
    assert np.linalg.norm(states.position_m - states.position_m[0], axis=1).max() > 0.5
    objective = task.objective(goals, np.zeros(200))
    assert np.all(objective.position_m > low) and np.all(objective.position_m < high)


@pytest.mark.parametrize("name", IN_THE_AIR)
def test_the_generator_determines_the_start(name: str) -> None:
    task: AnyTask = TASKS[name]
    starts = [task.begin(AREA, RESEARCH, np.random.default_rng(seed), 3)[0].position_m for seed in (1, 1, 2)]
    np.testing.assert_array_equal(starts[0], starts[1])
    assert not np.array_equal(starts[0], starts[2])


def test_hover_rewards_closeness_and_smooth_actions() -> None:
    task = Hover()
    _, goals = task.begin(AREA, RESEARCH, np.random.default_rng(0), 1)
    made = step([0.0, 0.0, 0.0], [0.3, 0.4, 1.2])
    made = replace(
        made,
        after=replace(made.after, rate_rad_s=np.array([[3.0, 0.0, 4.0]])),
        action=np.array([[0.5, 0.5, 0.0, 0.0]]),
    )
    terms = task.reward_terms(goals, goals, made)
    assert terms["closeness"][0] == pytest.approx(np.exp(-0.5 / 0.5 - 5.0 / 5.0))
    assert terms["smoothness"][0] == pytest.approx(-0.01 * 0.125)
    assert not task.success(goals, made)[0]
    assert task.success(goals, step([0.0, 0.0, 0.0], [0.05, 0.0, 1.2]))[0]


def test_hover_has_to_keep_its_target() -> None:
    """A vehicle that is away within the last second, or only passes the target, does not keep it."""
    task = Hover()
    _, goals = task.begin(AREA, RESEARCH, np.random.default_rng(0), 1)
    kept = []
    path = [(0.5, 0.0), (1.0, 0.05), (2.0, 0.2), (2.5, 0.0), (2.98, 0.05), (3.0, 0.05), (9.98, 0.05), (10.0, 0.11)]
    for t_s, x in path:
        made = step([0.0, 0.0, 0.0], [x, 0.0, 1.2], t_s=t_s)
        goals = task.advance(goals, made)
        kept.append(bool(task.success(goals, made)[0]))
    assert kept == [True, True, False, False, False, True, True, False]
    oscillating = [step([0.0, 0.0, 0.0], [0.3 * np.sin(k), 0.0, 1.2], t_s=0.02 * k) for k in range(500)]
    _, goals = task.begin(AREA, RESEARCH, np.random.default_rng(0), 1)
    for made in oscillating:
        goals = task.advance(goals, made)
        assert made.t_s[0] < 0.1 or not task.success(goals, made)[0]


def test_waypoints_are_reached_in_order() -> None:
    task = Waypoints(count=2)
    goals = WaypointsGoals(np.array([[[1.0, 0.0, 1.0], [0.0, 1.0, 1.0]]]), np.zeros(1, np.int64))
    aside = step([0.0, 0.0, 1.0], [0.0, 1.0, 1.0])
    assert task.advance(goals, aside).reached[0] == 0  # the second point does not count before the first
    there = step([0.0, 0.0, 1.0], [0.8, 0.0, 1.0])
    after = task.advance(goals, there)
    assert after.reached[0] == 1 and not task.success(after, there)[0]
    terms = task.reward_terms(goals, after, there)
    assert terms["progress"][0] == pytest.approx(5.0 * 0.04)  # not more, since it is faster than what is rewarded
    assert terms["reached"][0] == 5.0 and terms["failure"][0] == 0.0
    slowly = step([0.0, 0.0, 1.0], [0.03, 0.0, 1.0])
    assert task.reward_terms(goals, goals, slowly)["progress"][0] == pytest.approx(5.0 * 0.03)
    np.testing.assert_array_equal(task.objective(after, np.zeros(1)).position_m[0], [[0.0, 1.0, 1.0], [0.0, 1.0, 1.0]])
    end = task.advance(after, step([0.8, 0.0, 1.0], [0.0, 1.1, 1.0]))
    assert task.success(end, there)[0] and task.ends_with_success


def test_waypoints_keep_their_distance() -> None:
    task = Waypoints()
    _, goals = task.begin(AREA, RESEARCH, np.random.default_rng(0), 100)
    apart = np.linalg.norm(np.diff(goals.waypoints_m, axis=1), axis=2)
    assert np.mean(apart >= task.spacing_m) > 0.99
    assert np.abs(goals.waypoints_m[..., :2]).max() <= 1.5


def test_the_reference_of_track_moves_as_documented() -> None:
    task = Track()
    one, zeros = np.ones((1, 3)), np.zeros(1)
    goals = TrackGoals(one, 0.5 * one, 2.0 * one, 0.0 * one, zeros, np.zeros(1, np.int64))
    ahead = task.objective(goals, np.array([0.3])).position_m
    np.testing.assert_allclose(ahead[0, :, 0], 1.0 + 0.5 * np.sin(2.0 * (0.3 + 0.1 * np.arange(5))))
    made = step(np.ones(3), np.ones(3), t_s=0.1)
    after = task.advance(goals, made)
    distance = np.sqrt(3.0) * 0.5 * np.sin(0.2)
    assert after.summed_m[0] == pytest.approx(distance) and after.steps[0] == 1
    assert task.reward_terms(goals, after, made)["closeness"][0] == pytest.approx(np.exp(-distance / 0.3))
    assert task.success(after, made)[0] == (distance < 0.2)


def test_track_starts_with_the_velocity_of_the_reference() -> None:
    still = Track(start=replace(Track().start, position_m=0.0, velocity_m_s=0.0))
    states, goals = still.begin(AREA, RESEARCH, np.random.default_rng(0), 4)
    dt = 1e-6
    before, after = (goals.position_m(np.full((4, 1), t))[:, 0] for t in (-dt, dt))
    np.testing.assert_allclose(states.position_m, goals.position_m(np.zeros((4, 1)))[:, 0])
    np.testing.assert_allclose(states.velocity_m_s, (after - before) / (2.0 * dt), atol=1e-6)


def race_goals(first: int, total: int) -> RaceGoals:
    """Return the goals of one episode on the course of `AREA`."""
    _, goals = Race().begin(AREA, RESEARCH, np.random.default_rng(0), 1)
    return replace(goals, first=np.full(1, first), total=np.full(1, total))


@pytest.mark.parametrize(
    ("before", "after", "passed"),
    [
        ([4.9, 0.0, 2.0], [5.1, 0.0, 2.0], 1),
        ([5.1, 0.0, 2.0], [4.9, 0.0, 2.0], 0),  # backwards
        ([4.9, 0.95, 2.0], [5.1, 0.95, 2.0], 0),  # too close to the frame
        ([4.9, 0.85, 2.85], [5.1, 0.85, 2.85], 1),
        ([4.9, 0.0, 3.5], [5.1, 0.0, 3.5], 0),  # above the gate
        ([4.8, 0.0, 1.0], [5.2, 0.0, 2.0], 1),  # crosses the plane within the opening
        ([4.5, 0.0, 2.0], [4.9, 0.0, 2.0], 0),  # not yet
    ],
)
def test_gates_count_when_their_opening_is_crossed(before: Array, after: Array, passed: int) -> None:
    goals = race_goals(first=0, total=2)
    made = step(np.array(before), np.array(after))
    assert Race(laps=1).advance(goals, made).passed[0] == passed


def test_the_race_ends_after_all_gates() -> None:
    task = Race(laps=2)
    goals = race_goals(first=1, total=4)
    np.testing.assert_allclose(task.objective(goals, np.zeros(1)).direction[0, :, 0], [-1.0, 1.0], atol=1e-12)
    through = [step([0.1, 5.0, 2.0], [-0.1, 5.0, 2.0]), step([4.9, 0.0, 2.0], [5.1, 0.0, 2.0])]
    for count, made in enumerate([*through, *through], start=1):
        before, goals = goals, task.advance(goals, made)
        assert goals.passed[0] == count
        assert task.reward_terms(before, goals, made)["passed"][0] == 3.0
    assert task.success(goals, through[-1])[0] and task.ends_with_success
    assert task.reward_terms(goals, goals, step(np.zeros(3), np.zeros(3), failed=True))["failure"][0] == -5.0


@pytest.mark.parametrize(
    ("before", "after", "progress"),
    [
        ([1.0, 0.0, 2.0], [1.05, 0.0, 2.0], 0.05),
        ([1.0, 0.0, 2.0], [2.0, 0.0, 2.0], 0.1),  # faster than what is rewarded
        ([2.0, 0.0, 2.0], [1.0, 0.0, 2.0], -1.0),
        ([1.0, 3.0, 2.0], [1.0, 2.95, 2.0], 34.0**0.5 - 33.405**0.5),  # across the axis: 2 · 3² + 4², 2 · 2.95² + 4²
    ],
)
def test_approaches_of_gates_are_rewarded(before: Array, after: Array, progress: float) -> None:
    goals = race_goals(first=0, total=2)
    terms = Race().reward_terms(goals, goals, step(before, after))
    assert terms["progress"][0] == pytest.approx(progress)


def test_half_of_the_races_start_at_the_pad() -> None:
    task = Race()
    states, goals = task.begin(AREA, RESEARCH, np.random.default_rng(0), 400)
    at_pad = np.linalg.norm(states.position_m - [0.0, 0.0, 1.5], axis=1) < 0.6
    assert 0.4 < at_pad.mean() < 0.6
    assert np.all(goals.first[at_pad] == 0)
    behind = AREA.gates[0].middle + [2.0, 0.0, 0.0]
    elsewhere = states.position_m[~at_pad & (goals.first == 1)]
    assert np.abs(elsewhere - behind).max() <= 0.3
    assert np.all(task.begin(AREA, RESEARCH, np.random.default_rng(0), 50)[1].total == 6)


def test_navigation_starts_and_ends_in_free_space() -> None:
    task = Navigate(distance_m=(4.0, 8.0))
    states, goals = task.begin(AREA, RESEARCH, np.random.default_rng(0), 300)
    assert AREA.space.clearance(goals.goal_m).min() >= 0.6
    assert AREA.space.clearance(states.position_m).min() > 0.4
    distance = np.linalg.norm(goals.goal_m - states.position_m, axis=1)
    assert np.mean((distance > 3.8) & (distance < 8.2)) > 0.99
    ahead = states.R_world_vehicle[:, :, 0]
    assert np.mean(np.sum(ahead * (goals.goal_m - states.position_m), axis=1) > 0.0) == 1.0


def test_navigation_ends_at_the_goal() -> None:
    task = Navigate()
    goals = PointGoals(np.array([[5.0, 5.0, 2.0]]))
    made = step([4.0, 5.0, 2.0], [4.6, 5.0, 2.0])
    assert task.success(goals, made)[0] and task.ends_with_success
    terms = task.reward_terms(goals, goals, made)
    assert (terms["progress"][0], terms["reached"][0]) == (pytest.approx(0.6), 10.0)


def test_impossible_tasks_are_refused() -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(ConfigError, match="unknown task 'swim'; expected one of hover"):
        task_named("swim")
    with pytest.raises(ConfigError, match="without gates"):
        Race().begin(replace(AREA, gates=()), RESEARCH, rng, 1)
    with pytest.raises(ConfigError, match="no free places"):
        Navigate(clearance_m=9.0).begin(AREA, RESEARCH, rng, 1)


def test_explore_rewards_the_volume_that_becomes_known() -> None:
    task = Explore(volume_m3=10.0)
    goals = ExploreGoals(np.zeros((1, 3)), np.array([7.5]))
    made = replace(
        step([0.0, 0.0, 1.0], [0.1, 0.0, 1.0], failed=True),
        seen_m3=np.array([2.0]),
        action=np.array([[1.0, 1.0, 0.0, 0.0]]),
    )
    after = task.advance(goals, made)
    assert after.seen_m3[0] == 9.5 and not task.success(after, made)[0]
    terms = task.reward_terms(goals, after, made)
    assert terms["seen"][0] == pytest.approx(0.4)
    assert terms["smoothness"][0] == pytest.approx(-0.01 * 0.5)
    assert terms["failure"][0] == -10.0 and terms["rate"][0] == 0.0
    assert task.success(task.advance(after, made), made)[0]
    with pytest.raises(ConfigError, match="no goal"):
        task.with_goal(goals, np.zeros((1, 3)))


def test_explore_starts_with_any_heading_in_free_space() -> None:
    task = Explore()
    states, _ = task.begin(AREA, RESEARCH, np.random.default_rng(0), 400)
    assert AREA.space.clearance(states.position_m).min() > task.clearance_m - 0.1 * 3**0.5
    ahead = states.R_world_vehicle[:, :2, 0]
    assert np.abs(ahead.mean(axis=0)).max() < 0.15  # 0.035 by chance
