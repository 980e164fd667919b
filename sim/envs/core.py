"""Core of all environments: n quadrotors with a task, actions, observations and randomization, stepped together."""

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from dronevio.models.rotation import pose_matrix
from dronevio.sim.envs.actions import action_mode, checked_actions
from dronevio.sim.envs.arrangement import Arrangement
from dronevio.sim.envs.batches import with_rows
from dronevio.sim.envs.endings import GROUND_M, REASONS, Bounds, failures
from dronevio.sim.envs.held_images import rendered_images
from dronevio.sim.envs.latency import DelayedActions
from dronevio.sim.envs.observations import Limits, Situation, observation_named
from dronevio.sim.envs.options import overridden
from dronevio.sim.envs.randomization import Draws
from dronevio.sim.envs.settings import EnvironmentSettings
from dronevio.sim.envs.tasks import Objective, Transition
from dronevio.sim.envs.tasks.task import distance_m
from dronevio.sim.inertial.batch_imu import BatchImuErrors, vibration_of
from dronevio.sim.physics.batch_plant import BatchPlant
from dronevio.sim.physics.vehicle_states import Mask, VehicleStates
from dronevio.sim.physics.wind import Winds
from dronevio.sim.world import collision_spec, flight_area

Array = npt.NDArray[np.float64]
Observations = Any
"""Observations of n environments: a dict of arrays, nested with privileged observations, or one array if flat."""


@dataclass(frozen=True, eq=False)
class StepResult:
    """Result of a step of n environments."""

    reward: Array
    """(n,) Sums of the terms of the reward."""
    terminated: Mask
    """(n,) Whether the episodes have ended by success or failure."""
    info: dict[str, Any]
    """Values by name, arrays of n rows or dicts of such arrays."""


class DroneCore:
    """n environments of the same settings.

    It has no time limits and does not reset episodes by itself; `DroneEnv` and `DroneVectorEnv` add what Gymnasium
    expects. All random numbers are those of one generator, so that the same seed and the same actions give the same
    bytes.
    """

    def __init__(self, count: int, settings: EnvironmentSettings) -> None:
        """Build the physics; the renderer of images is built when they are first observed.

        Args:
            count: Number of environments.
            settings: Settings of all environments.

        Raises:
            ConfigError: The settings are not possible.
        """
        self.count, self.settings = count, settings
        self.task, self.quadrotor = settings.task, settings.vehicle
        chosen = (*settings.observations, *settings.privileged)
        self._senses = not {"imu", "imu_bias"}.isdisjoint(chosen)
        self.area = flight_area(settings.world, settings.world_seed)
        self.plant = BatchPlant(
            count,
            settings.rig,
            self.quadrotor,
            step_s=1.0 / settings.physics_rate_hz,
            surroundings=collision_spec(settings.world, settings.world_seed) if self.task.obstacles else None,
            ground_m=float(self.area.pad[2]),
            imu=self._senses,
            nthread=settings.threads,
        )
        self._mode = action_mode(settings.action, self.quadrotor, settings.action_limits, count, self.plant.interval_s)
        self._delayed = DelayedActions(count, settings.samples, self.plant.interval_s)
        self._errors = BatchImuErrors(
            settings.rig.imu,
            count,
            np.random.default_rng(0),
            vibration_of(self.quadrotor, settings.rig, count),
        )
        self._images = rendered_images(count, settings) if settings.images else None
        standing = float(self.area.pad[2]) + self.plant.standing_height_m
        self._bounds = Bounds(self.task.bounds_m(self.area), standing + GROUND_M)
        self._rng = np.random.default_rng(0)
        self._draws = Draws.nominal(count, settings.world_seed)
        self._states, self._goals = self.task.begin(self.area, self.quadrotor, self._rng, count)
        self._imu = np.zeros((count, settings.samples, 6))
        self._bias = np.zeros((count, 6))
        self._action = np.zeros((count, 4))
        limits = self._limits()
        self._named = {name: observation_named(name, limits) for name in chosen if name not in settings.images}
        boxes: dict[str, spaces.Box] = {name: one.space for name, one in self._named.items()}
        if self._images is not None:
            boxes.update(self._images.spaces())
        self._arrangement = Arrangement(boxes, settings.observations, settings.privileged, settings.flat)
        self.action_space = spaces.Box(-1.0, 1.0, (4,), np.float32)
        """Space of the actions of one environment."""
        self.observation_space = self._arrangement.space
        """Space of the observations of one environment."""
        self.observation_shapes = self._arrangement.shapes
        """Shapes of the observations of the policy by name, in order."""

    def reseed(self, rng: np.random.Generator) -> None:
        """Take all random numbers from a generator from now on."""
        self._rng = rng
        self.plant.reseed(rng)
        self._errors.reseed(rng)

    def reset(self, mask: Mask, options: Mapping[str, Any]) -> dict[str, Any]:
        """Start new episodes of the environments in a mask (n,).

        Args:
            mask: (n,) The environments to reset.
            options: Values to use instead of drawn ones; see `dronevio.sim.envs.options`.

        Returns:
            The drawn values and the goals by name, arrays of n rows.

        Raises:
            ConfigError: An option is unknown or has a wrong shape.
        """
        rows = np.flatnonzero(mask)
        draws = self.settings.randomization.draw(self._rng, rows.size, self.settings.world_seed)
        states, goals = self.task.begin(self.area, self.quadrotor, self._rng, rows.size)
        states, goals, draws = overridden(self.task, states, goals, draws, options, rows, self.count)
        self._goals = with_rows(self._goals, rows, goals)
        self._draws = with_rows(self._draws, rows, draws)
        everyone = with_rows(self._states, rows, states)
        self.plant.reset(mask, everyone, self._draws.parameters(self.quadrotor), self._winds())
        self._states = self.plant.states
        self._mode.reset(mask, self._states)
        self._delayed.reset(mask, self._draws.latency_s)
        self._errors.reset(mask)
        self._action[rows] = 0.0
        if self._images is not None:
            self._images.reset(mask)
        perfect = self._perfect()[rows]
        sensed = self._errors.first(perfect, rows, self.plant.rotor_speeds_rad_s[rows])
        first, bias = _scaled(perfect, *sensed, draws.imu_errors)
        self._imu[rows], self._bias[rows] = first[:, None], bias
        return self._reset_info()

    def step(self, actions: npt.NDArray[np.floating[Any]]) -> StepResult:
        """Apply actions for one step.

        Args:
            actions: (n, 4) Actions, which are clipped to [−1, 1].

        Raises:
            ConfigError: The actions are not n rows of four finite numbers.
        """
        action = checked_actions(actions, self.count)
        before, goals = self._states, self._goals
        self._delayed.push(action)
        for interval in range(self.settings.samples):
            self.plant.advance(self._mode.commands(self._delayed.at(interval), lambda: self.plant.states))
            if self._senses:
                perfect = self._perfect()
                sensed = self._errors.add_to(perfect, self.plant.rotor_speeds_rad_s)
                sample, self._bias = _scaled(perfect, *sensed, self._draws.imu_errors)
                self._imu[:, interval] = sample
        if self._images is not None:
            self._images.step()
        self._states = after = self.plant.states
        reason = failures(after, self.plant.touched, self.plant.diverged, self._bounds)
        step = Transition(before, after, action, self._action, self._t_s, reason > 0)
        self._action = action
        self._goals = self.task.advance(self.area, goals, step)
        terms = self.task.reward_terms(self.area, goals, self._goals, step)
        reason = np.where((reason == 0) & self.task.finished(self._goals), REASONS.index("success"), reason)
        info = {
            "success": self.task.success(self.area, self._goals, step) & ~step.failed,
            "termination": np.array(REASONS)[reason],
            "reward_terms": terms,
            **self._state_info(),
        }
        return StepResult(np.sum(list(terms.values()), axis=0), reason > 0, info)

    def observe(self) -> Observations:
        """Return the observations of n environments."""
        objective = self._objective()
        situation = Situation(
            self._states, objective, self._imu, self._bias, lambda: self.plant.wind_m_s, self._action, self._draws
        )
        values: dict[str, npt.NDArray[Any]] = {name: one.observe(situation) for name, one in self._named.items()}
        if self._images is not None:
            T_world_imu = self.T_world_vehicle @ self.settings.rig.T_vehicle_imu
            values.update(self._images.observe(T_world_imu, self.plant.t_ns, self._draws))
        return self._arrangement.arranged(values)

    @property
    def T_world_vehicle(self) -> Array:
        """(n, 4, 4) Poses of the vehicles."""
        return pose_matrix(self._states.R_world_vehicle, self._states.position_m)

    @property
    def goals_m(self) -> Array:
        """(n, K, 3) Current goals and the following ones in the world [m]."""
        return self._objective().position_m

    @property
    def _t_s(self) -> Array:
        """(n,) Times since the start of the episodes [s]."""
        return np.asarray(self.plant.t_ns * 1e-9, dtype=np.float64)

    @property
    def states(self) -> VehicleStates:
        """True states of the vehicles."""
        return self._states

    def save(self) -> dict[str, Any]:
        """Return the state of episodes, physics and random numbers, with arrays of its own."""
        return copy.deepcopy(
            {
                "plant": self.plant.save(),
                "errors": self._errors.save(),
                "mode": self._mode.state(),
                "delayed": self._delayed.save(),
                "images": None if self._images is None else self._images.save(),
                "rng": self._rng.bit_generator.state,
                "draws": self._draws,
                "goals": self._goals,
                "imu": self._imu,
                "bias": self._bias,
                "action": self._action,
            }
        )

    def restore(self, saved: dict[str, Any]) -> None:
        """Return to a state of `save`, of environments with the same settings."""
        saved = copy.deepcopy(saved)
        self.plant.restore(saved["plant"])
        self._errors.restore(saved["errors"])
        self._mode.restore(saved["mode"])
        self._delayed.restore(saved["delayed"])
        if self._images is not None:
            self._images.restore(saved["images"])
        self._rng.bit_generator.state = saved["rng"]
        self._draws, self._goals = saved["draws"], saved["goals"]
        self._imu, self._bias, self._action = saved["imu"], saved["bias"], saved["action"]
        self._states = self.plant.states

    def close(self) -> None:
        """Release the resources of rendering; further calls have no effect."""
        if self._images is not None:
            self._images.close()

    def _perfect(self) -> Array:
        """Return the noise-free IMU samples (n, 6) of the current time."""
        samples = self.plant.samples
        return np.concatenate([samples.gyro_rad_s, samples.accel_m_s2], axis=1)

    def _winds(self) -> Winds:
        """Return the winds at all vehicles: that of the settings, and the drawn ones."""
        wind = self.settings.wind
        return Winds(np.array(wind.mean_m_s) + self._draws.wind_m_s, wind.gusts + self._draws.gusts)

    def _objective(self) -> Objective:
        """Return the current and the following goals."""
        return self.task.objective(self.area, self._goals, self._t_s)

    def _state_info(self) -> dict[str, Any]:
        """Return values by name, arrays of n rows, that describe the current state."""
        goal = self._objective().position_m[:, 0]
        return {"distance_m": distance_m(self._states, goal), "t_ns": self.plant.t_ns}

    def _reset_info(self) -> dict[str, Any]:
        """Return values by name, arrays of n rows, that describe the start of an episode."""
        return {**self._state_info(), "randomization": self._draws.values()}

    def _limits(self) -> Limits:
        """Return the sizes and bounds of observations."""
        objective, space = self._objective(), self.area.space
        return Limits(
            reach_m=float(np.linalg.norm(space.high - space.low)),
            height_m=float(space.high[2] - space.low[2]),
            floor_m=float(self.area.pad[2]),
            rotor_speed_rad_s=self.quadrotor.rotor_speed_max_rad_s,
            samples=self.settings.samples,
            goals=objective.position_m.shape[1],
            has_gates=bool(objective.size_m.any()),
        )


def _scaled(perfect: Array, measured: Array, bias: Array, factor: Array) -> tuple[Array, Array]:
    """Return IMU samples (n, 6) and biases (n, 6) whose errors are multiplied by factors (n,)."""
    return perfect + factor[:, None] * (measured - perfect), factor[:, None] * bias
