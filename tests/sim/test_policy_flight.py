"""Flights of policies, with dead reckoning of a noise-free IMU in place of the odometry."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import dronevio.envs  # noqa: F401 registers
from dronevio.estimator.baselines.dead_reckoning import DeadReckoning
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuModel, ImuSamples
from dronevio.models.policies import Layer, NamedShape, Network, Policy, Scaling, load_policy
from dronevio.models.policies.outcome import PolicyOutcome
from dronevio.models.rig import euroc_rig
from dronevio.models.rotation import inverse_pose, quat_wxyz_from_matrix
from dronevio.models.state import CameraFrame, NavState, Trajectory
from dronevio.sim.closed_loop.flight import fly_closed_loop
from dronevio.sim.envs.episodes.endings import Termination
from dronevio.sim.envs.policies.mission import PolicyMission, policy_mission, policy_outcome
from dronevio.sim.envs.policies.pilot import PolicyPilot
from dronevio.sim.envs.tasks import Hover, Race, Waypoints
from dronevio.sim.flight import Flight
from dronevio.sim.scenario import Scenario
from dronevio.sim.scenarios import scenario_named


class NoImages:
    """Frames without images."""

    def ready_ns(self, exposed_ns: int) -> int:
        return exposed_ns

    def frame(self, t_ns: int, exposed_ns: int, lit: bool, truth: Trajectory) -> CameraFrame:
        return CameraFrame(t_ns, ())


class Displaced(DeadReckoning):
    """Dead reckoning whose position is wrong by 0.5 m along y after the take-off."""

    def state_at(self, t_ns: int) -> NavState | None:
        state = super().state_at(t_ns)
        if state is None:
            return None
        T = state.T_world_imu.copy()
        T[1, 3] += 1.0 * min(max(t_ns * 1e-9 - 2.0, 0.0), 0.5)
        return replace(state, T_world_imu=T)


@pytest.fixture(scope="module")
def base() -> Scenario:
    noiseless = ImuModel(
        gyro_noise_density=0.0,
        accel_noise_density=0.0,
        gyro_random_walk=0.0,
        accel_random_walk=0.0,
        gyro_turn_on_bias_rad_s=0.0,
        accel_turn_on_bias_m_s2=0.0,
    )
    short = scenario_named("short")
    plan = replace(short.plan, initial_rest_s=0.3, takeoff_s=1.2)
    return replace(short, plan=plan, rig=replace(euroc_rig(), imu=noiseless))


def flown(
    mission: PolicyMission, estimator: Any = None, true_state: bool = False
) -> tuple[Flight, PolicyOutcome, PolicyPilot]:
    pilot = PolicyPilot(mission)
    flight = fly_closed_loop(
        mission.scenario,
        estimator or DeadReckoning(mission.scenario.rig),
        NoImages(),
        pilot=pilot,
        true_state=true_state,
    )
    return flight, policy_outcome(mission, flight, pilot.began_ns, pilot.end), pilot


def shortened(policy: Policy, base: Scenario) -> PolicyMission:
    """The flight of Hover for two seconds."""
    return replace(policy_mission(policy, base), task=Hover(episode_s=2.0))


@pytest.fixture(scope="module")
def on_truth(hovering_policy: Policy, base: Scenario) -> tuple[Flight, PolicyOutcome]:
    return flown(shortened(hovering_policy, base), true_state=True)[:2]


def test_policy_takes_over_after_the_take_off(on_truth: tuple[Flight, PolicyOutcome]) -> None:
    flight, outcome = on_truth
    assert outcome.success and outcome.end == "time limit" and outcome.environment == "dronevio/Hover-v0"
    assert outcome.distance_m is not None and outcome.distance_m < 0.03
    assert outcome.duration_s == pytest.approx(2.0)
    assert flight.truth.t_s[-1] == pytest.approx(2.5 + 2.0)  # rest, take-off and settling take 2.5 s
    assert (flight.scenario.name, flight.scenario.world) == ("policy-hover", "room")


def test_flight_is_that_of_the_environment(on_truth: tuple[Flight, PolicyOutcome], hovering_policy: Policy) -> None:
    flight = on_truth[0]
    T = flight.truth.Ts_world_imu @ inverse_pose(flight.true_rig.T_vehicle_imu)
    assert flight.truth.velocity_m_s is not None
    env = gymnasium.make("dronevio/Hover-v0", action="rates", observations=hovering_policy.names).unwrapped
    observation, _ = env.reset(
        seed=0,
        options={
            "position_m": T[500, :3, 3],
            "quat_wxyz": quat_wxyz_from_matrix(T[500, :3, :3]),
            "velocity_m_s": flight.truth.velocity_m_s[500],  # the rates are negligible
            "rate_rad_s": np.zeros(3),
        },
    )
    for k in range(1, 81):
        action = hovering_policy.action({name: value[None] for name, value in observation.items()})[0]
        observation = env.step(action)[0]
        goal = np.array([0.0, 0.0, 1.2])
        np.testing.assert_allclose(observation["position"] + goal, T[500 + 4 * k, :3, 3], atol=0.01)


def test_exact_estimate_gives_the_flight_on_the_truth(
    on_truth: tuple[Flight, PolicyOutcome], hovering_policy: Policy, base: Scenario
) -> None:
    flight, outcome, _ = flown(shortened(hovering_policy, base))
    assert outcome.success
    last = slice(-400, None)  # two seconds by the policy; before, the drone waits for the first state
    np.testing.assert_allclose(flight.truth.p_world_imu[last], on_truth[0].truth.p_world_imu[last], atol=0.01)


def test_errors_of_the_estimate_are_errors_of_the_path(hovering_policy: Policy, base: Scenario) -> None:
    mission = shortened(hovering_policy, base)
    _, outcome, pilot = flown(mission, Displaced(base.rig))
    assert not outcome.success and pilot.finished and outcome.end == "time limit"
    assert outcome.distance_m == pytest.approx(0.5, abs=0.1)


def test_reached_goals_end_the_flight(hovering_policy: Policy, base: Scenario) -> None:
    policy = replace(hovering_policy, environment="dronevio/Waypoints-v0")
    mission = replace(policy_mission(policy, base), task=Waypoints(count=2))
    mission = replace(mission, goals=replace(mission.goals, waypoints_m=mission.goals.waypoints_m[:, :2]))
    flight, outcome, pilot = flown(mission, true_state=True)
    assert outcome.success and outcome.end == "success" and pilot.finished and 1.0 < outcome.duration_s < 8.0
    T = flight.truth.Ts_world_imu[-1] @ inverse_pose(flight.true_rig.T_vehicle_imu)
    np.testing.assert_allclose(T[:3, 3], mission.goals.waypoints_m[0, -1], atol=0.26)
    assert 0.15 < (outcome.distance_m or 0.0) < 0.25


class Recording:
    """A policy that records its observations; all else is that of another policy."""

    def __init__(self, policy: Policy) -> None:
        self._policy, self.seen = policy, list[dict[str, Any]]()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._policy, name)

    def action(self, observation: dict[str, Any]) -> Any:
        self.seen.append(observation)
        return np.full((1, 4), 0.25, np.float32)


def test_policies_observe_sensors_and_commands(hovering_policy: Policy, base: Scenario) -> None:
    layer = Layer(np.zeros((4, 38), np.float32), np.zeros(4, np.float32))
    shapes = {"imu": (4, 6), "imu_bias": (6,), "rotors": (4,), "last_action": (4,)}
    policy = replace(
        hovering_policy,
        inputs=tuple(NamedShape(name, shape) for name, shape in shapes.items()),
        scaling=Scaling.identity(38),
        network=Network((layer,), "tanh"),
    )
    recorder = Recording(policy)
    pilot = PolicyPilot(replace(policy_mission(policy, base), policy=recorder))  # type: ignore[arg-type]
    T = np.eye(4)
    T[:3, 3] = [0.1, 0.0, 1.2]
    bias = np.array([0.01, 0.02, 0.03])
    state = NavState(0, T @ base.rig.T_vehicle_imu, np.zeros(3), bias, 2.0 * bias, angular_velocity_rad_s=np.zeros(3))
    for k in range(9):
        t_ns = np.array([5_000_000 * k])
        pilot.add_imu(ImuSamples(t_ns, np.full((1, 3), float(k)), np.full((1, 3), 10.0 + k), "point"))
        pilot.command(replace(state, t_ns=int(t_ns[0])))
    first, second, third = recorder.seen
    np.testing.assert_allclose(third["imu"][0, :, 0], [5.0, 6.0, 7.0, 8.0])
    np.testing.assert_allclose(third["imu"][0, :, 5], [15.0, 16.0, 17.0, 18.0])
    np.testing.assert_allclose(first["imu_bias"], [[0.01, 0.02, 0.03, 0.02, 0.04, 0.06]], atol=1e-7)
    np.testing.assert_array_equal(first["last_action"], np.zeros((1, 4)))
    np.testing.assert_array_equal(second["last_action"], np.full((1, 4), 0.25))
    assert (first["rotors"] == 0.0).all() and (second["rotors"] > 0.1).all()


def test_impossible_flights_are_errors(hovering_policy: Policy, base: Scenario) -> None:
    mission = policy_mission(hovering_policy, base)
    wind = replace(hovering_policy, inputs=(NamedShape("wind", (3,)), *hovering_policy.inputs[:2]))
    with pytest.raises(ConfigError, match="observation 'wind' in flight"):
        PolicyPilot(replace(mission, policy=wind))
    with pytest.raises(ConfigError, match="actions at 60 Hz with an IMU at 200 Hz"):
        PolicyPilot(replace(mission, policy=replace(hovering_policy, action_rate_hz=60.0)))
    with pytest.raises(ConfigError, match="a task of hover, waypoints, race"):
        policy_mission(replace(hovering_policy, environment="dronevio/Navigate-v0"), base)
    pilot = PolicyPilot(mission)
    with pytest.raises(ConfigError, match="without angular velocity"):
        pilot.command(NavState(0, np.eye(4), np.zeros(3), np.zeros(3), np.zeros(3)))


def test_race_starts_before_the_first_gate(hovering_policy: Policy, base: Scenario) -> None:
    mission = policy_mission(replace(hovering_policy, environment="dronevio/Race-v0"), base)
    assert isinstance(mission.task, Race) and mission.scenario.world == "gates"
    assert mission.goals.first[0] == 0 and mission.begins_ns == 2_500_000_000
    kept = policy_mission(hovering_policy, replace(base, world="hall"), own_world=False)
    assert kept.scenario.world == "hall"


def test_a_flight_without_take_off_has_no_outcome(
    on_truth: tuple[Flight, PolicyOutcome], hovering_policy: Policy, base: Scenario
) -> None:
    outcome = policy_outcome(policy_mission(hovering_policy, base), on_truth[0], None, Termination.NONE)
    assert (outcome.success, outcome.distance_m, outcome.end) == (False, None, "no take-off")


def test_a_fall_ends_the_flight(hovering_policy: Policy, base: Scenario) -> None:
    """The policy stops the rotors."""
    layer = Layer(np.zeros((4, 15), np.float32), np.array([-5.0, 0.0, 0.0, 0.0], np.float32))
    mission = policy_mission(replace(hovering_policy, network=Network((layer,), "tanh")), base)
    flight, outcome, pilot = flown(mission, true_state=True)
    assert pilot.end is Termination.GROUND and pilot.finished
    assert outcome.end == "ground" and 0.2 < outcome.duration_s < 1.0
    assert (flight.truth.t_ns[-1] - mission.begins_ns) * 1e-9 < outcome.duration_s + 0.1


@pytest.mark.parametrize(
    ("observed", "end"),
    [
        (Termination.GROUND, "ground"),
        (Termination.FLIPPED, "flipped"),
        (Termination.SUCCESS, "goals missed"),
        (Termination.NONE, "time limit"),
    ],
)
def test_a_flight_that_ends_on_the_estimate_alone_has_its_reason(
    on_truth: tuple[Flight, PolicyOutcome], hovering_policy: Policy, base: Scenario, observed: Termination, end: str
) -> None:
    mission = replace(policy_mission(hovering_policy, base), task=Hover(episode_s=100.0))
    outcome = policy_outcome(mission, on_truth[0], mission.begins_ns, observed)
    assert (outcome.success, outcome.end) == (False, end)


def test_goals_are_judged_on_the_true_path(hovering_policy: Policy, base: Scenario) -> None:
    """With a position that is wrong by 0.5 m, the drone passes the goals at a distance, and does not know."""
    policy = replace(hovering_policy, environment="dronevio/Waypoints-v0")
    mission = replace(policy_mission(policy, base), task=Waypoints(count=1))
    mission = replace(mission, goals=replace(mission.goals, waypoints_m=np.array([[[1.5, 0.0, 1.2]]])))
    _, outcome, pilot = flown(mission, Displaced(base.rig))
    assert pilot.finished and not outcome.success
    assert outcome.end == "goals missed" and (outcome.distance_m or 0.0) > 0.25


def test_a_trained_policy_flies_on_noisy_imu_samples(base: Scenario) -> None:
    """The policy has no angular velocity but that of the IMU."""
    path = Path(__file__).resolve().parents[2] / "examples" / "rl" / "policies" / "hover-imu.safetensors"
    if not path.exists():
        pytest.skip("the trained policies are in the repository, not in the package")
    policy = load_policy(path)
    assert "imu" in policy.names and "rate" not in policy.names
    noisy = replace(base, rig=euroc_rig())
    _, outcome, _ = flown(replace(policy_mission(policy, noisy), task=Hover(episode_s=3.0)), true_state=True)
    assert outcome.success and outcome.end == "time limit"
