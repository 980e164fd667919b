"""Flights of policies as scenarios: the task with its goals, the take-off, and the outcome on the true path."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from dronevio.models.errors import ConfigError
from dronevio.models.policies.outcome import PolicyOutcome
from dronevio.models.policies.policy import OWN_VEHICLE, Policy
from dronevio.models.quadrotor import Quadrotor, vehicle_named
from dronevio.models.rotation import inverse_pose
from dronevio.sim.envs.episodes.endings import GROUND_M, Bounds, Termination, failures
from dronevio.sim.envs.tasks import TASKS, AnyTask, Race, Transition
from dronevio.sim.envs.tasks.task import distance_m
from dronevio.sim.flight import Flight, plant_of
from dronevio.sim.paths.plan import TIMED_WAYPOINTS, FlightPlan
from dronevio.sim.paths.space import FlightArea
from dronevio.sim.physics.vehicle_states import VehicleStates
from dronevio.sim.scenario import Scenario
from dronevio.sim.world import flight_area, resolved_world

FLOWN_TASKS = ("hover", "waypoints", "race")
"""Tasks that begin with a hover above the landing pad, and can therefore be flown after a take-off."""

_SETTLE_S = 1.0  # hover before the policy takes over
_MARGIN_S = 1.0  # of the planned hover beyond the time limit of the task
_HEIGHT_M = 1.2  # of the hover above the standing drone


@dataclass(frozen=True, eq=False)
class PolicyMission:
    """A flight of the task of a policy in a scenario."""

    policy: Policy
    """The policy that flies."""
    scenario: Scenario
    """The scenario: take-off and hover until the time limit of the task, in its world."""
    task: AnyTask
    """Task of the policy."""
    area: FlightArea
    """Bounds, obstacles and gates of the world."""
    goals: Any
    """Goals of the task at its beginning, one row."""
    bounds: Bounds
    """Limits of the flight, as in the environment of the task."""

    @property
    def begins_ns(self) -> int:
        """Time of the plan at which the policy takes over [ns]."""
        plan = self.scenario.plan
        return round((plan.initial_rest_s + plan.takeoff_s + _SETTLE_S) * 1e9)


def vehicle_of_policy(policy: Policy) -> Quadrotor:
    """Return the vehicle of a policy by its name; the policy may have been downloaded, and names no files or modules.

    Raises:
        ConfigError: It is a vehicle of one's own, or there is none of this name.
    """
    if policy.vehicle == OWN_VEHICLE:
        raise ConfigError("a policy for a vehicle of one's own; expected the vehicle, such as --vehicle my-hexa.yaml")
    return vehicle_named(policy.vehicle)


def policy_mission(
    policy: Policy, base: Scenario, *, own_world: bool = True, own_vehicle: bool = True
) -> PolicyMission:
    """Return the flight of a policy in a scenario.

    Args:
        policy: The policy.
        base: Scenario with sensors, imaging, wind, faults and seed. Only rest and take-off of its plan are flown.
        own_world: Whether the world of the task replaces that of the scenario.
        own_vehicle: Whether the vehicle of the policy replaces that of the scenario.

    Raises:
        ConfigError: The task of the policy does not begin with a hover above the landing pad, or its vehicle has no
            name.
    """
    name = policy.environment.removeprefix("dronevio/").rpartition("-v")[0].lower()
    if name not in FLOWN_TASKS:
        raise ConfigError(f"a policy for {policy.environment}; expected one for a task of {', '.join(FLOWN_TASKS)}")
    task = TASKS[name]
    if isinstance(task, Race):
        task = replace(task, on_course=0.0)
    world = resolved_world(task.world if own_world else base.world)
    quadrotor = vehicle_of_policy(policy) if own_vehicle else base.quadrotor
    plan = FlightPlan(
        initial_rest_s=base.plan.initial_rest_s,
        takeoff_s=base.plan.takeoff_s,
        tour_s=_SETTLE_S + task.episode_s + _MARGIN_S,
        height_m=_HEIGHT_M,
        shape=TIMED_WAYPOINTS,
    )
    scenario = replace(
        base,
        name=f"policy-{name}",
        description=f"the task of {policy.environment}, flown by a policy",
        world=world,
        quadrotor=quadrotor,
        plan=plan,
    )
    area = flight_area(world, base.seed_of_world)
    _, goals = task.begin(area, quadrotor, scenario.generator("path"), 1)
    standing_m = float(area.pad[2]) + plant_of(scenario).standing_height_m
    return PolicyMission(
        policy, scenario, task, area, goals, Bounds(task.bounds_m(area)[None], np.full(1, standing_m + GROUND_M))
    )


def policy_outcome(
    mission: PolicyMission, flight: Flight, began_ns: int | None, observed_end: Termination
) -> PolicyOutcome:
    """Return the outcome of a flight: the task is judged by the true motion at the times of the actions.

    Args:
        mission: The flight as planned.
        flight: The flight as flown.
        began_ns: Time at which the policy took over [ns]; None if it never did.
        observed_end: Why the flight ended on the path that the policy observed (`PolicyPilot.end`): the reason if the
            true path had none until then.
    """
    policy = mission.policy
    if began_ns is None:
        return PolicyOutcome(policy.environment, False, 0.0, None, "no take-off")
    truth, task = flight.truth, mission.task
    stride = round(flight.true_rig.imu.rate_hz / policy.action_rate_hz)
    rows = np.arange(int(np.searchsorted(truth.t_ns, began_ns)), len(truth), stride)
    states = _vehicle_states(flight, rows)
    goals, now, t_s, success = mission.goals, states.rows(slice(0, 1)), 0.0, False
    idle, none = np.zeros((1, 4)), np.zeros(1, np.bool_)
    for k in range(1, len(rows)):
        before, now = now, states.rows(slice(k, k + 1))
        t_s = float(truth.t_ns[rows[k]] - truth.t_ns[rows[0]]) * 1e-9
        step = Transition(before, now, idle, idle, np.array([t_s]), none)
        goals = task.advance(goals, step)
        success = bool(task.success(goals, step)[0])
        reason = int(failures(now, none, none, none, mission.bounds)[0])
        is_done = success and task.ends_with_success
        if reason or is_done or t_s >= task.episode_s - 1e-9:
            success &= not reason
            end = Termination(reason).text or ("success" if is_done else "time limit")
            break
    else:
        success, end = False, observed_end.text or "time limit"
        if flight.collision is not None:
            end = Termination.COLLISION.text
        elif observed_end is Termination.SUCCESS:
            end = "goals missed"
    goal = task.objective(goals, np.array([t_s])).position_m[:, 0]
    return PolicyOutcome(policy.environment, success, t_s, float(distance_m(now, goal)[0]), end)


def _vehicle_states(flight: Flight, rows: npt.NDArray[np.intp]) -> VehicleStates:
    """Return the true states of the vehicle at rows of the true trajectory of the IMU, without rates."""
    T_imu_vehicle = inverse_pose(flight.true_rig.T_vehicle_imu)
    T = flight.truth.Ts_world_imu[rows] @ T_imu_vehicle
    return VehicleStates.at(T[:, :3, 3], T[:, :3, :3])
