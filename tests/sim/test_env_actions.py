"""Action modes, latency and observations of the core, against values worked out by hand."""

from typing import Any

import numpy as np
import pytest

from dronevio.models.actions import ACTION_MODES
from dronevio.models.quadrotor import RESEARCH
from dronevio.models.rotation import exp_so3, quat_wxyz_from_matrix, rotation_z, yaw_rad_from_matrix
from dronevio.sim.envs.core import DroneCore
from dronevio.sim.envs.episodes.distributions import Constant, LogUniform, Normal, Uniform
from dronevio.sim.envs.episodes.latency import DelayedActions
from dronevio.sim.envs.episodes.randomization import MODERATE, Randomization
from dronevio.sim.envs.settings import settings_of
from dronevio.sim.envs.tasks import Race
from dronevio.sim.world import flight_area

STATE = ("position", "velocity", "rate", "rotors")


def started(count: int = 1, options: dict[str, Any] | None = None, **settings: Any) -> DroneCore:
    """Return a core whose episodes have started at rest, 1.5 m above the ground unless options say otherwise."""
    core = DroneCore(count, settings_of(**{"observations": STATE, **settings}))
    core.reseed(np.random.default_rng(0))
    rest = {"velocity_m_s": np.zeros(3), "rate_rad_s": np.zeros(3), "quat_wxyz": np.array([1.0, 0.0, 0.0, 0.0])}
    core.reset(np.ones(count, np.bool_), {"position_m": np.array([0.0, 0.0, 1.5]), **rest, **(options or {})})
    return core


def flown(core: DroneCore, action: Any, steps: int) -> DroneCore:
    for _ in range(steps):
        core.step(np.broadcast_to(action, (core.count, 4)))
    return core


@pytest.mark.parametrize("mode", ACTION_MODES)
def test_an_action_of_zero_hovers(mode: str) -> None:
    core = flown(started(action=mode), np.zeros(4), 25)
    np.testing.assert_allclose(core.states.position_m[0], [0.0, 0.0, 1.5], atol=0.01)
    np.testing.assert_allclose(core.states.rotor_speed_rad_s, RESEARCH.hover_speed_rad_s, rtol=0.01)


@pytest.mark.parametrize(("action", "share"), [(-1.0, 0.0), (-0.5, 0.328), (0.5, 0.828), (7.0, 1.0)])
def test_rotor_actions_are_interpolated_and_clipped(action: float, share: float) -> None:
    core = flown(started(action="rotors"), np.full(4, action), 12)
    expected = share * RESEARCH.rotor_speed_max_rad_s
    np.testing.assert_allclose(core.states.rotor_speed_rad_s[0], expected, atol=0.02 * RESEARCH.rotor_speed_max_rad_s)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_rates_are_reached(axis: int) -> None:
    action = np.zeros(4)
    action[1 + axis] = 0.2
    core = flown(started(action="rates"), action, 12)
    expected = np.zeros(3)
    expected[axis] = 0.2 * (6.0, 6.0, 2.0)[axis]
    np.testing.assert_allclose(core.states.rate_rad_s[0], expected, atol=0.1)


def test_attitudes_tilt_as_documented() -> None:
    heading = rotation_z(np.array(0.5 * np.pi))
    core = started(2, {"quat_wxyz": quat_wxyz_from_matrix(heading)}, action="attitude")
    flown(core, np.array([[0.0, 0.0, 0.5, 0.0], [0.0, 0.5, 0.0, 0.0]]), 30)
    forward, right = np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])  # of a vehicle that heads along y
    up = core.states.R_world_vehicle[..., 2]
    np.testing.assert_allclose(up[0], np.cos(0.3) * np.array([0.0, 0.0, 1.0]) + np.sin(0.3) * forward, atol=0.03)
    np.testing.assert_allclose(up[1], np.cos(0.3) * np.array([0.0, 0.0, 1.0]) + np.sin(0.3) * right, atol=0.03)


def test_velocities_are_those_of_the_heading_frame() -> None:
    heading = rotation_z(np.array(0.5 * np.pi))
    core = started(options={"quat_wxyz": quat_wxyz_from_matrix(heading)}, action="velocity")
    flown(core, np.array([0.5, 0.25, -0.1, 0.0]), 100)
    np.testing.assert_allclose(core.states.velocity_m_s[0], [-0.5, 1.0, -0.2], atol=0.05)


def test_positions_are_relative_to_the_start_and_held_in_wind() -> None:
    heading, wind = rotation_z(np.array(0.5 * np.pi)), Randomization(wind_m_s=Constant(2.0))
    options = {"quat_wxyz": quat_wxyz_from_matrix(heading), "position_m": np.array([1.0, 0.5, 1.5])}
    core = started(options=options, action="position", randomization=wind)
    speeds = []
    for _ in range(300):
        flown(core, np.array([0.5, -0.25, 0.2, 0.0]), 1)
        speeds.append(np.linalg.norm(core.states.velocity_m_s[0]))
    np.testing.assert_allclose(core.states.position_m[0], [2.0, 0.0, 1.9], atol=0.05)
    assert 0.5 < max(speeds) < 2.1


def test_each_vehicle_has_its_own_start_and_keeps_it() -> None:
    places = np.array([[0.0, 0.0, 1.5], [2.0, 1.0, 2.0]])
    core = flown(started(2, {"position_m": places}, action="position"), np.array([0.2, 0.0, 0.0, 0.0]), 150)
    np.testing.assert_allclose(core.states.position_m, places + [0.4, 0.0, 0.0], atol=0.05)
    core.reset(np.array([False, True]), {"position_m": np.array([0.0, 0.0, 1.0]), "velocity_m_s": np.zeros(3)})
    flown(core, np.zeros(4), 150)
    np.testing.assert_allclose(core.states.position_m, [[0.0, 0.0, 1.5], [0.0, 0.0, 1.0]], atol=0.05)


@pytest.mark.parametrize("mode", ["attitude", "velocity", "position"])
def test_yaw_rates_turn_the_heading(mode: str) -> None:
    core = flown(started(action=mode), np.array([0.0, 0.0, 0.0, 0.3]), 50)
    yaw = float(yaw_rad_from_matrix(core.states.R_world_vehicle[0]))
    assert yaw == pytest.approx(0.3 * 2.0 * 1.0, abs=0.15)  # less the time to reach the rate


def test_actions_take_effect_after_the_latency() -> None:
    delayed = DelayedActions.none(3, 4, 0.005)
    delayed = delayed.restarted(np.ones(3, np.bool_), np.array([0.0, 0.01, 0.03]))
    for value in (1.0, 2.0, 3.0):
        delayed = delayed.pushed(np.full((3, 4), value))
    seen = np.array([delayed.at(interval)[:, 0] for interval in range(4)])
    np.testing.assert_array_equal(seen[:, 0], [3.0, 3.0, 3.0, 3.0])
    np.testing.assert_array_equal(seen[:, 1], [2.0, 2.0, 3.0, 3.0])
    np.testing.assert_array_equal(seen[:, 2], [1.0, 1.0, 2.0, 2.0])
    delayed = delayed.restarted(np.array([True, False, False]), np.full(3, 0.02))
    assert delayed.at(0).tolist() == [[0.0] * 4, [2.0] * 4, [1.0] * 4]


def test_observations_are_those_of_the_state() -> None:
    R = exp_so3(np.array([0.1, -0.2, 0.3]))
    names = ("position", "height", "orientation", "rotation", "velocity", "body_velocity", "rate", "goals", "battery")
    options = {
        "position_m": np.array([1.0, 2.0, 1.5]),
        "quat_wxyz": quat_wxyz_from_matrix(R),
        "velocity_m_s": np.array([0.4, -0.3, 0.2]),
        "rate_rad_s": np.array([0.1, 0.2, 0.3]),
        "goal_m": np.array([3.0, -1.0, 2.0]),
        "battery_charge": 0.7,
    }
    seen = {name: value[0] for name, value in started(options=options, observations=names).observe().items()}
    to_goal = np.array([2.0, -3.0, 0.5])
    expected: dict[str, Any] = {
        "position": -to_goal,
        "height": [1.5],
        "orientation": quat_wxyz_from_matrix(R),
        "rotation": R,
        "velocity": [0.4, -0.3, 0.2],
        "body_velocity": R.T @ [0.4, -0.3, 0.2],
        "rate": [0.1, 0.2, 0.3],
        "goals": [R.T @ to_goal],
        "battery": [0.7],
    }
    assert seen.keys() == expected.keys()
    for name, value in expected.items():
        # the state belongs to half a step before the pose of the physics
        np.testing.assert_allclose(seen[name], value, atol=1e-3, err_msg=name)


def test_gates_are_observed_by_their_corners() -> None:
    core = DroneCore(1, settings_of(Race(on_course=0.0), observations=("gates",)))
    core.reseed(np.random.default_rng(0))
    gate = flight_area(core.settings.world, core.settings.world_seed).gates[0]
    start = {"position_m": gate.middle - 3.0 * gate.ahead, "quat_wxyz": np.array([1.0, 0.0, 0.0, 0.0])}
    core.reset(np.ones(1, np.bool_), start)
    corners = core.observe()["gates"][0, 0]
    np.testing.assert_allclose(corners.mean(axis=0), 3.0 * gate.ahead, atol=2e-3)
    edges = np.linalg.norm(np.diff(corners, axis=0, append=corners[:1]), axis=1)
    np.testing.assert_allclose(edges, gate.opening_m, atol=1e-5)
    np.testing.assert_allclose(corners @ gate.ahead, 3.0, atol=2e-3)


def test_imu_observations_have_errors_of_the_drawn_size() -> None:
    scaled = Randomization(imu_errors=Constant(0.0))
    perfect = flown(started(observations=("imu",), randomization=scaled, action="rotors"), np.zeros(4), 2)
    noisy = flown(started(observations=("imu",), action="rotors"), np.zeros(4), 2)
    true, measured = perfect.observe()["imu"][0], noisy.observe()["imu"][0]
    assert true.shape == (4, 6)
    np.testing.assert_allclose(np.linalg.norm(true[:, 3:], axis=1), 9.81, atol=0.02)
    assert 0.0 < np.abs(measured - true).max() < 1.0


def test_drawn_values_follow_their_distributions() -> None:
    draws = MODERATE.draw(np.random.default_rng(0), 2000, 5)
    assert 0.9 <= draws.mass.min() < 0.91 and 1.09 < draws.mass.max() <= 1.1
    assert np.median(draws.drag) == pytest.approx(1.0, abs=0.05)
    assert draws.camera_rotation_rad.std() == pytest.approx(0.01, rel=0.05)
    speed = np.linalg.norm(draws.wind_m_s, axis=1)
    assert speed.mean() == pytest.approx(1.0, abs=0.05) and np.abs(draws.wind_m_s.mean(axis=0)).max() < 0.1
    assert np.all(draws.texture_seed == 5)


@pytest.mark.parametrize(
    ("distribution", "low", "high", "mean"),
    [
        (Constant(3.0), 3.0, 3.0, 3.0),
        (Uniform(1.0, 2.0), 1.0, 2.0, 1.5),
        (LogUniform(0.5, 2.0), 0.5, 2.0, 1.5 / np.log(4.0)),
        (Normal(1.0, 0.5, low=0.0), 0.0, 3.0, 1.004),
    ],
)
def test_samples_have_bounds_and_mean(distribution: Any, low: float, high: float, mean: float) -> None:
    samples = distribution.sample(np.random.default_rng(0), (100, 200))
    assert samples.shape == (100, 200)
    assert low <= samples.min() and samples.max() <= high
    assert samples.mean() == pytest.approx(mean, rel=0.01)


def test_a_heavier_vehicle_sinks() -> None:
    heavy = started(2, {"randomization": {"mass": np.array([1.0, 1.2])}}, action="rotors")
    flown(heavy, np.zeros(4), 25)
    sink = heavy.states.velocity_m_s[:, 2]
    assert abs(sink[0]) < 0.05
    assert sink[1] == pytest.approx(-9.81 * (1.0 - 1.0 / 1.2) * 0.5, rel=0.2)  # less the drag of the inflow
