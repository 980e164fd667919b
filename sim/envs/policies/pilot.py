"""Flight of a scenario by a trained policy, on the true or on an estimated state.

The controller of the scenarios takes off and hovers above the landing pad, where the policy takes over. The policy
receives the observations of its task, which are computed from the given state in place of the true one, at the rate
at which it was trained. The action modes of the environments turn its actions into rotor commands.
"""

from collections import deque
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples
from dronevio.models.protocols import Controller
from dronevio.models.quadrotor import Quadrotor
from dronevio.models.state import CameraFrame, Estimate, NavState
from dronevio.sim.envs.episodes.actions import action_mode
from dronevio.sim.envs.episodes.endings import Termination, failures
from dronevio.sim.envs.episodes.randomization import RandomizedParameters
from dronevio.sim.envs.policies.mission import PolicyMission
from dronevio.sim.envs.sensing.estimator_loop import Perceived
from dronevio.sim.envs.sensing.observations import ObservedState, limits_of, observation_named
from dronevio.sim.envs.tasks import Objective, Transition
from dronevio.sim.flight import reference_of
from dronevio.sim.paths.course import Course
from dronevio.sim.physics.controller import SE3Controller
from dronevio.sim.physics.plant import QuadrotorPlant
from dronevio.sim.physics.vehicle_states import VehicleStates
from dronevio.sim.scenario import Scenario

OBSERVED_IN_FLIGHT = (
    "position",
    "height",
    "orientation",
    "rotation",
    "velocity",
    "body_velocity",
    "rate",
    "rotors",
    "imu",
    "imu_bias",
    "goals",
    "gates",
    "last_action",
)
"""Observations that a drone in flight has: its state, the commands so far, the IMU, and the goals."""


class PolicyPilot:
    """Flies the task of a policy once, after a take-off; implements `dronevio.sim.closed_loop.flight.Pilot`."""

    def __init__(self, mission: PolicyMission) -> None:
        """Prepare a flight.

        Args:
            mission: Policy, task, goals and scenario of the flight.

        Raises:
            ConfigError: The policy observes what a drone in flight does not have, its actions are not those of the
                vehicle, or the rate of the IMU of the scenario is no multiple of the rate of the actions.
        """
        policy, rig, quadrotor = mission.policy, mission.scenario.rig, mission.scenario.quadrotor
        for name in policy.names:
            if name not in OBSERVED_IN_FLIGHT:
                raise ConfigError(f"observation {name!r} in flight; expected some of {', '.join(OBSERVED_IN_FLIGHT)}")
        intervals = rig.imu.rate_hz / policy.action_rate_hz
        if abs(intervals - round(intervals)) > 1e-9 or intervals < 1.0:
            raise ConfigError(
                f"actions at {policy.action_rate_hz:g} Hz with an IMU at {rig.imu.rate_hz:g} Hz; expected a fraction"
                " 1/k of it, k = 1, 2, 3"
            )
        self._mission, self._intervals, self._interval_s = mission, round(intervals), 1.0 / rig.imu.rate_hz
        self._mode = action_mode(policy.action_mode, quadrotor, policy.action_limits, self._interval_s)
        if policy.network.outputs != self._mode.size:
            raise ConfigError(
                f"a policy with actions of {policy.network.outputs} numbers for a vehicle with {quadrotor.rotor_count}"
                f" rotors; expected {self._mode.size}"
            )
        self._rotors = _RotorModel(quadrotor, self._interval_s)
        self._imu: deque[Array] = deque([np.zeros(6)] * self._intervals, self._intervals)
        self._flown = _Flown(mission.goals, np.zeros((1, self._mode.size)))
        limits = limits_of([mission.area], self._objective(mission.goals), quadrotor, self._intervals, self._mode.size)
        self._named = {name: observation_named(name, limits) for name in policy.names}
        self._randomized = RandomizedParameters.nominal(1, mission.scenario.seed)
        self._limits = replace(mission.bounds, box_m=np.array([[[-np.inf] * 3, [np.inf] * 3]]))

    @property
    def began_ns(self) -> int | None:
        """Time of the first state that the policy received [ns]; None before."""
        return self._flown.began_ns

    @property
    def finished(self) -> bool:
        """Whether the flight is over on the path that the policy observes: `end`, or the time limit of the task."""
        return self._t_s >= self._mission.task.episode_s - 1e-9 or bool(self.end)

    @property
    def end(self) -> Termination:
        """Why the flight has ended on the path that the policy observes.

        The task is accomplished, or the vehicle is upside down or on the ground; `Termination.NONE` before, and at the
        time limit.
        """
        return self._flown.end

    def add_imu(self, samples: ImuSamples) -> None:
        """Add the IMU samples since the last call."""
        for sample in np.concatenate([samples.gyro_rad_s, samples.accel_m_s2], axis=1):
            self._imu.append(sample)

    def add_frame(self, frame: CameraFrame, estimate: Estimate, T_world_odom: Array | None) -> None:
        """Do nothing: policies observe no images."""

    def course(self, scenario: Scenario, plant: QuadrotorPlant) -> Course:
        """Return the reference of the scenario, of which the take-off is flown."""
        return reference_of(scenario, plant)

    def controller(self, course: Course, T_vehicle_imu: Array, quadrotor: Quadrotor) -> Controller:
        """Return the controller of a flight, which takes off before the policy takes over.

        Args:
            course: Course of the take-off.
            T_vehicle_imu: (4, 4) Mounting of the IMU.
            quadrotor: The vehicle.
        """
        return _TakeOff(SE3Controller(course, T_vehicle_imu, quadrotor), self, self._mission.begins_ns)

    def command(self, state: NavState) -> Array:
        """Return the rotor speeds (R,) [rad/s] for one interval of the IMU.

        Args:
            state: True or estimated state of the IMU in the world, with its angular velocity.

        Raises:
            ConfigError: The state has no angular velocity.
        """
        speeds = self._rotors.speeds_rad_s
        rotating = VehicleStates.at(np.zeros((1, 3)), rotor_speed_rad_s=speeds, rotors=len(speeds))
        now = Perceived.of(state, self._mission.scenario.rig.T_vehicle_imu).states(rotating)
        flown = self._flown
        if flown.began_ns is None:
            flown = replace(flown, began_ns=state.t_ns, loops=self._mode.start(now))
        if flown.calls % self._intervals == 0:
            flown = self._acting(flown, state, now)
        commands, loops = self._mode.commands(flown.loops, flown.action, lambda: now)
        self._flown = replace(flown, calls=flown.calls + 1, loops=loops)
        return self.commanded(commands[0])

    def commanded(self, command: Array) -> Array:
        """Return rotor commands (R,) [rad/s], after they have been applied to the model of the rotors."""
        self._rotors.command(command)
        return command

    @property
    def _t_s(self) -> float:
        """Time since the first state that the policy received [s]."""
        return self._flown.calls * self._interval_s

    def _acting(self, flown: "_Flown", state: NavState, now: VehicleStates) -> "_Flown":
        """Return the flight with goals updated by the motion since the last action, and a new action."""
        mission, goals, nothing, success = self._mission, flown.goals, np.zeros(1, np.bool_), False
        task = mission.task
        if flown.calls:
            step = Transition(flown.before, now, flown.action, flown.action, np.array([self._t_s]), nothing)
            goals = task.advance(goals, step)
            success = bool(task.ends_with_success and task.success(goals, step)[0])
        observed = ObservedState(
            now,
            self._objective(goals),
            np.array(self._imu)[None],
            np.concatenate([state.gyro_bias_rad_s, state.accel_bias_m_s2])[None],
            lambda: np.zeros((1, 3)),
            flown.action,
            self._randomized,
        )
        observation = {name: one.observe(observed) for name, one in self._named.items()}
        action = np.asarray(mission.policy.action(observation), dtype=np.float64)
        end = Termination(int(failures(now, nothing, nothing, nothing, self._limits)[0]) or success)
        return replace(flown, goals=goals, action=action, before=now, end=end)

    def _objective(self, goals: Any) -> Objective:
        """Return the current and the following goals."""
        return self._mission.task.objective(goals, np.array([self._t_s]))


@dataclass(frozen=True, eq=False)
class _Flown:
    """Flight of a policy so far."""

    goals: Any
    """Goals and progress of the task."""
    action: Array
    """(1, A) Last action."""
    calls: int = 0
    """Number of commands."""
    began_ns: int | None = None
    """Time of the first state [ns]."""
    loops: Any = ()
    """State of the inner control loops."""
    before: VehicleStates = field(default_factory=lambda: VehicleStates.at(np.zeros((1, 3))))
    """State at the last action."""
    end: Termination = Termination.NONE
    """Whether the task was accomplished, or the vehicle upside down or on the ground, at the last action."""


class _TakeOff:
    """Controller of the scenarios until a time, then a policy; implements `Controller`."""

    def __init__(self, controller: SE3Controller, pilot: PolicyPilot, until_ns: int) -> None:
        self._controller, self._pilot, self._until_ns = controller, pilot, until_ns

    def command(self, state: NavState, t_ns: int) -> Array:
        """Return the rotor speeds (R,) [rad/s] for the state at a time of the reference."""
        if t_ns < self._until_ns:
            return self._pilot.commanded(self._controller.command(state, t_ns))
        return self._pilot.command(state)


class _RotorModel:
    """Speeds of rotors that follow their commands with a first-order lag."""

    def __init__(self, quadrotor: Quadrotor, interval_s: float) -> None:
        self._share = 1.0 - np.exp(-interval_s / quadrotor.rotor_time_constant_s)
        self.speeds_rad_s = np.zeros(quadrotor.rotor_count)

    def command(self, command: Array) -> None:
        """Apply commands (R,) [rad/s] for one interval."""
        self.speeds_rad_s = self.speeds_rad_s + self._share * (command - self.speeds_rad_s)
