"""Core of all environments: n quadrotors with a task, actions, observations and randomization, stepped together."""

import copy
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from dronevio.models.errors import ConfigError
from dronevio.models.imu import Times
from dronevio.models.rotation import pose_matrix
from dronevio.sim.envs.episodes.actions import action_mode, checked_actions
from dronevio.sim.envs.episodes.batches import with_rows
from dronevio.sim.envs.episodes.endings import GROUND_M, REASONS, Bounds, failures
from dronevio.sim.envs.episodes.latency import DelayedActions
from dronevio.sim.envs.episodes.options import overridden
from dronevio.sim.envs.episodes.randomization import RandomizedParameters
from dronevio.sim.envs.sensing.arrangement import Arrangement
from dronevio.sim.envs.sensing.camera_observation import Images
from dronevio.sim.envs.sensing.estimation import EstimatorFactory
from dronevio.sim.envs.sensing.estimator_loop import EstimatorLoop
from dronevio.sim.envs.sensing.held_images import HeldImages
from dronevio.sim.envs.sensing.imu_window import ImuWindow
from dronevio.sim.envs.sensing.observations import ObservedState, limits_of, observation_named
from dronevio.sim.envs.settings import EnvironmentSettings
from dronevio.sim.envs.tasks import Objective, Transition
from dronevio.sim.envs.tasks.task import distance_m
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
            ConfigError: The settings are not possible, or there is an estimator and more than one environment.
        """
        if settings.estimator is not None and count != 1:
            raise ConfigError(
                f"estimator in {count} environments of a native vector; expected single environments, for many of them"
                ' gymnasium.make_vec with vectorization_mode="async", which is an AsyncVectorEnv'
            )
        self.count, self.settings = count, settings
        self.task, self.quadrotor = settings.task, settings.vehicle
        chosen = (*settings.observations, *settings.privileged)
        self._senses = settings.estimator is not None or not {"imu", "imu_bias"}.isdisjoint(chosen)
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
        self._imu = ImuWindow(self.plant, settings.rig, self.quadrotor, settings.samples)
        self._images = (
            HeldImages(count, settings.steps_per_image, settings.image_source, settings.world_seed)
            if settings.images
            else None
        )
        self._standing_m = float(self.area.pad[2]) + self.plant.standing_height_m
        ground_m = -np.inf if self.task.lands else self._standing_m + GROUND_M
        self._bounds = Bounds(self.task.bounds_m(self.area), ground_m)
        self._rng = np.random.default_rng(0)
        self._draws = RandomizedParameters.nominal(count, settings.world_seed)
        self._states, self._goals = self._begin(count)
        self._loop: EstimatorLoop | None = None
        self._begun_ns = np.zeros(count, dtype=np.int64)
        self._action = np.zeros((count, 4))
        limits = limits_of(self.area, self._objective(), self.quadrotor, settings.samples)
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
        self._imu.reseed(rng)

    def reset(self, mask: Mask, options: Mapping[str, Any]) -> dict[str, Any]:
        """Start new episodes of the environments in a mask (n,).

        Args:
            mask: (n,) The environments to reset.
            options: Values to use instead of drawn ones; see `dronevio.sim.envs.episodes.options`.

        Returns:
            The drawn values and the goals by name, arrays of n rows.

        Raises:
            ConfigError: An option is unknown or has a wrong shape.
        """
        rows = np.flatnonzero(mask)
        draws = self.settings.randomization.draw(self._rng, rows.size, self.settings.world_seed)
        states, goals = self._begin(rows.size)
        states, goals, draws = overridden(self.task, states, goals, draws, options, rows, self.count)
        self._goals = with_rows(self._goals, rows, goals)
        self._draws = with_rows(self._draws, rows, draws)
        everyone = with_rows(self._states, rows, states)
        self.plant.reset(mask, everyone, self._draws.parameters(self.quadrotor), self._winds())
        self._states = self.plant.states
        self._begun_ns[rows] = 0
        self._delayed.reset(mask, self._draws.latency_s)
        self._action[rows] = 0.0
        if self._images is not None:
            self._images.reset(mask)
        self._imu.reset(mask, self._draws.imu_errors)
        if self.settings.estimator is not None:
            self._wait_for_estimate(self.settings.estimator, states)
        self._mode.reset(mask, self._perceived())
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
        unestimated = np.full(self.count, self._loop is not None and not self._loop.ready)
        for interval in range(self.settings.samples):
            self._advance(self._mode.commands(self._delayed.at(interval), self._perceived), interval)
        if self._images is not None:
            self._images.step()
        self._states = after = self.plant.states
        reason = failures(after, self.plant.touched, self.plant.diverged, unestimated, self._bounds)
        step = self._transition(before, after, action, reason > 0)
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
        """Return the observations of n environments: of the policy as perceived, of the critic as they are."""
        true = ObservedState(
            self._states,
            self._objective(),
            self._imu.samples,
            self._imu.bias,
            lambda: self.plant.wind_m_s,
            self._action,
            self._draws,
        )
        images: Images = {}
        if self._images is not None:
            T_world_imu = self.T_world_vehicle @ self.settings.rig.T_vehicle_imu
            images = self._images.observe(T_world_imu, self.plant.t_ns, self._draws)
        seen = true
        if self._loop is not None:
            seen = replace(true, states=self._loop.states(), imu_bias=self._loop.bias)
        return self._arrangement.arranged(
            {**self._observed(seen, self.settings.observations), **images},
            {**self._observed(true, self.settings.privileged), **images},
        )

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
        return np.asarray(self._t_ns * 1e-9, dtype=np.float64)

    @property
    def _t_ns(self) -> Times:
        """(n,) Times since the start of the episodes, after the wait for an estimate [ns]."""
        return self.plant.t_ns - self._begun_ns

    @property
    def states(self) -> VehicleStates:
        """True states of the vehicles."""
        return self._states

    def save(self) -> dict[str, Any]:
        """Return the state of episodes, physics and random numbers, with arrays of its own.

        Raises:
            ConfigError: There is an estimator, whose state cannot be copied.
        """
        self._require_copyable()
        return copy.deepcopy(
            {
                "plant": self.plant.save(),
                "imu": self._imu.save(),
                "mode": self._mode.state(),
                "delayed": self._delayed.save(),
                "images": None if self._images is None else self._images.save(),
                "rng": self._rng.bit_generator.state,
                "draws": self._draws,
                "goals": self._goals,
                "action": self._action,
            }
        )

    def restore(self, saved: dict[str, Any]) -> None:
        """Return to a state of `save`, of environments with the same settings.

        Raises:
            ConfigError: There is an estimator, whose state cannot be replaced.
        """
        self._require_copyable()
        saved = copy.deepcopy(saved)
        self.plant.restore(saved["plant"])
        self._imu.restore(saved["imu"])
        self._mode.restore(saved["mode"])
        self._delayed.restore(saved["delayed"])
        if self._images is not None:
            self._images.restore(saved["images"])
        self._rng.bit_generator.state = saved["rng"]
        self._draws, self._goals = saved["draws"], saved["goals"]
        self._action = saved["action"]
        self._states = self.plant.states

    def close(self) -> None:
        """Release the resources of rendering; further calls have no effect."""
        if self._images is not None:
            self._images.close()
        self._close_loop()

    def _begin(self, count: int) -> tuple[VehicleStates, Any]:
        """Draw initial states, of which none is below that of a standing vehicle, and goals of the task."""
        states, goals = self.task.begin(self.area, self.quadrotor, self._rng, count)
        height = np.maximum(states.position_m[:, 2:], self._standing_m)
        return replace(states, position_m=np.hstack([states.position_m[:, :2], height])), goals

    def _advance(self, commands: Array, interval: int) -> None:
        """Advance physics, IMU and estimator by one IMU interval of a step, with commands (n, 4) [rad/s]."""
        self.plant.advance(commands)
        if not self._senses:
            return
        sample = self._imu.measure(interval, self._draws.imu_errors)
        if self._loop is not None:
            self._loop.measure(int(self.plant.t_ns[0]), sample[0], self.plant.states)

    def _perceived(self) -> VehicleStates:
        """Return the states that the inner loops and the policy see: the estimate if there is one, else the truth."""
        return self.plant.states if self._loop is None else self._loop.states()

    def _wait_for_estimate(self, make: EstimatorFactory, planned: VehicleStates) -> None:
        """Make an estimator, and simulate the standing vehicle until it has a state, or the longest wait is over.

        Raises:
            ConfigError: The vehicle does not stand.
        """
        moving = np.any(planned.velocity_m_s) or np.any(planned.rotor_speed_rad_s) or np.any(planned.rate_rad_s)
        if moving or abs(planned.position_m[0, 2] - self._standing_m) > GROUND_M:
            raise ConfigError(
                f"estimator of a vehicle that starts at {planned.position_m[0].tolist()} m or moves; expected one that"
                f" stands at a height of {self._standing_m:.3f} m with standing rotors"
            )
        self._close_loop()
        T = pose_matrix(planned.R_world_vehicle[0], planned.position_m[0])
        settings = self.settings
        cameras = settings.cameras_of_episode(self._draws, int(self._rng.integers(2**31)))
        self._loop = EstimatorLoop(make, settings.rig, settings.estimation, cameras, T, self._states)
        self._loop.measure(0, self._imu.samples[0, -1], self._states)
        longest_ns = self.settings.estimation.longest_wait_s * 1e9
        while not self._loop.ready and self.plant.t_ns[0] < longest_ns:
            self._advance(np.zeros((1, 4)), -1)
        self._imu.repeat_last()
        self._states, self._begun_ns = self.plant.states, self.plant.t_ns
        self._loop.start()

    def _close_loop(self) -> None:
        """Release the resources of the estimator's cameras."""
        if self._loop is not None:
            self._loop.close()
            self._loop = None

    def _transition(self, before: VehicleStates, after: VehicleStates, action: Array, failed: Mask) -> Transition:
        """Return the step that has just been simulated."""
        sigma = np.zeros(self.count) if self._loop is None else self._loop.position_sigma_m
        standing = self.plant.standing_height_m
        return Transition(before, after, action, self._action, self._t_s, failed, standing, sigma)

    def _observed(self, state: ObservedState, names: tuple[str, ...]) -> Images:
        """Return some observations other than images by name."""
        return {name: self._named[name].observe(state) for name in names if name in self._named}

    def _require_copyable(self) -> None:
        """Raise ConfigError if there is an estimator."""
        if self.settings.estimator is not None:
            raise ConfigError(
                "state of an environment with an estimator, which cannot be copied; expected to repeat the episode with"
                " the same seed and actions, or an environment without an estimator"
            )

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
        estimated = {} if self._loop is None else self._loop.info()
        return {"distance_m": distance_m(self._states, goal), "t_ns": self._t_ns, **estimated}

    def _reset_info(self) -> dict[str, Any]:
        """Return values by name, arrays of n rows, that describe the start of an episode."""
        return {**self._state_info(), "randomization": self._draws.values()}
