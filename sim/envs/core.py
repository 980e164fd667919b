"""Core of all environments: n quadrotors with a task, actions, observations and randomization, stepped together."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array, Mask
from dronevio.models.errors import ConfigError
from dronevio.models.imu import Times
from dronevio.models.rotation import pose_matrix
from dronevio.sim.envs.episodes.actions import action_mode, checked_actions, merged
from dronevio.sim.envs.episodes.endings import GROUND_M, Bounds, Termination, failures
from dronevio.sim.envs.episodes.latency import DelayedActions
from dronevio.sim.envs.episodes.options import overridden, overridden_parameters, require_known
from dronevio.sim.envs.episodes.randomization import RandomizedParameters
from dronevio.sim.envs.sensing.arrangement import Arrangement
from dronevio.sim.envs.sensing.estimation import EstimatorFactory
from dronevio.sim.envs.sensing.estimator_loop import EstimatorLoop
from dronevio.sim.envs.sensing.held_images import HeldImages, ImageRenderer
from dronevio.sim.envs.sensing.imu_window import ImuWindow
from dronevio.sim.envs.sensing.observations import ObservedState, limits_of, observation_named
from dronevio.sim.envs.sensing.range_beams import RangeBeams
from dronevio.sim.envs.sensing.ray_maps import FINER, RayMaps, world_cells
from dronevio.sim.envs.settings import EnvironmentSettings
from dronevio.sim.envs.tasks import AnyTask, Objective, Transition
from dronevio.sim.envs.tasks.task import distance_m
from dronevio.sim.envs.worlds import WorldPool
from dronevio.sim.physics.batch_plant import BatchPlant
from dronevio.sim.physics.vehicle_states import VehicleStates, with_rows
from dronevio.sim.physics.wind import Winds

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


@dataclass(frozen=True, eq=False)
class EpisodeState:
    """State of the episodes of n environments, beside those of physics, IMUs and random numbers."""

    randomized: RandomizedParameters
    """Values that were drawn for the episodes."""
    bounds: Bounds
    """Limits of the flights."""
    goals: Any
    """Goals and progress of the task."""
    states: VehicleStates
    """True states of the vehicles after the last step."""
    begun_ns: Times
    """(n,) Times of the physics at the starts of the episodes, after the wait for an estimate [ns]."""
    action: Array
    """(n, A) Actions of the last step; zeros at the start of an episode."""
    delayed: DelayedActions
    """Actions that are still to take effect."""
    loops: Any
    """State of the inner control loops."""
    images: HeldImages | None
    """Newest images; None if none are observed."""


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
        self.settings = settings
        seeds = settings.randomization.world_seeds or (settings.world_seed,)
        self._worlds = WorldPool(settings.world, seeds, settings.task)
        self.plant = BatchPlant(
            count,
            settings.rig,
            settings.vehicle,
            worlds=self._worlds.plant_worlds,
            imu=settings.has_imu,
            nthread=settings.threads,
        )
        interval_s = self.plant.interval_s
        self._mode = action_mode(settings.action, settings.vehicle, settings.action_limits, interval_s)
        self._imu = ImuWindow(self.plant, settings.rig, settings.vehicle, settings.samples)
        self._renderer = (
            ImageRenderer(
                settings.steps_per_image,
                settings.image_source,
                int(self._worlds.seeds[0]),
                settings.depth_errors,
                settings.depth_focal_px,
            )
            if settings.images
            else None
        )
        self._maps = self._unknown_maps() if settings.has_map else None
        self._beams = (
            RangeBeams(count, settings.world, self._worlds.seeds.tolist(), settings.beams, settings.steps_per_ranging)
            if settings.has_beams
            else None
        )
        self._rng = np.random.default_rng(0)
        self._loop: EstimatorLoop | None = None
        world = np.zeros(count, dtype=np.intp)
        states, goals = self._begin(world)
        self._episode = EpisodeState(
            randomized=RandomizedParameters.nominal(count, int(self._worlds.seeds[0])),
            bounds=self._worlds.bounds(world, self.plant.standing_height_m),
            goals=goals,
            states=states,
            begun_ns=np.zeros(count, dtype=np.int64),
            action=np.zeros((count, self._mode.size)),
            delayed=DelayedActions.none(count, settings.samples, interval_s, self._mode.size),
            loops=self._mode.start(states),
            images=None if self._renderer is None else self._renderer.start(count),
        )
        self.arrangement = self._arranged()

    @property
    def count(self) -> int:
        """Number of environments."""
        return self.plant.count

    @property
    def action_size(self) -> int:
        """Number A of the numbers of an action: four, or one for each rotor in the mode ``rotors``."""
        return self._mode.size

    @property
    def states(self) -> VehicleStates:
        """True states of the vehicles."""
        return self._episode.states

    def shown(self, row: int) -> tuple[int, Array, Array]:
        """Return what a picture of an environment shows: seed of its world, pose of the vehicle, goals (K, 3)."""
        T_world_vehicle = pose_matrix(self.states.R_world_vehicle[row], self.states.position_m[row])
        return int(self._episode.randomized.world_seed[row]), T_world_vehicle, self._objective().position_m[row]

    def reseed(self, rng: np.random.Generator) -> None:
        """Take all random numbers from a generator from now on."""
        self._rng = rng
        self.plant.reseed(rng)
        self._imu.reseed(rng)
        for sensor in (self._beams, self._renderer):
            if sensor is not None:
                sensor.reseed(rng)

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
        settings, last, rows = self.settings, self._episode, np.flatnonzero(mask)
        require_known(options)
        drawn = settings.randomization.draw(self._rng, rows.size, settings.world_seed)
        drawn = overridden_parameters(drawn, options.get("randomization", {}), rows, self.count)
        world = self._worlds.index(drawn.world_seed)
        states, goals = self._begin(world)
        states, goals = overridden(settings.task, settings.vehicle, states, goals, options, rows, self.count)
        randomized = with_rows(last.randomized, rows, drawn)
        winds = Winds(np.array(settings.wind.mean_m_s) + randomized.wind_m_s, settings.wind.gusts + randomized.gusts)
        self.plant.reset(
            mask,
            with_rows(last.states, rows, states),
            randomized.parameters(settings.vehicle),
            winds,
            with_rows(self.plant.now.world, rows, world),
        )
        self._imu.reset(mask, randomized.imu_errors)
        self._episode = EpisodeState(
            randomized=randomized,
            bounds=with_rows(last.bounds, rows, self._worlds.bounds(world, self.plant.standing_height_m)),
            goals=with_rows(last.goals, rows, goals),
            states=self.plant.states,
            begun_ns=np.where(mask, 0, last.begun_ns),
            action=np.where(mask[:, None], 0.0, last.action),
            delayed=last.delayed.restarted(mask, randomized.latency_s),
            loops=last.loops,
            images=None if last.images is None else last.images.restarted(mask),
        )
        if settings.estimator is not None:
            self._wait_for_estimate(settings.estimator, states)
        if self._maps is not None:
            self._maps.restart(mask, self._T_world_imu(self.states), self.plant.now.world)
        if self._beams is not None:
            self._beams.restart(mask, self.states, self.plant.now.world)
        loops = merged(mask, self._mode.start(self._perceived()), last.loops)
        self._episode = replace(self._episode, loops=loops)
        return {**self._state_info(), "randomization": randomized.values()}

    def step(self, actions: npt.NDArray[np.floating[Any]]) -> StepResult:
        """Apply actions for one step.

        Args:
            actions: (n, A) Actions, which are clipped to [−1, 1].

        Raises:
            ConfigError: The actions are not n rows of A finite numbers.
        """
        action = checked_actions(actions, self.count, self._mode.size)
        task, last = self.settings.task, self._episode
        delayed, loops = last.delayed.pushed(action), last.loops
        unestimated = np.full(self.count, self._loop is not None and not self._loop.ready)
        for interval in range(self.settings.samples):
            commands, loops = self._mode.commands(loops, delayed.at(interval), self._perceived)
            self._advance(commands, interval)
        after = self.plant.states
        now = self.plant.now
        reason = failures(after, now.touched, now.diverged, unestimated, last.bounds)
        standing_m = self.plant.standing_height_m
        sigma_m = np.zeros(self.count) if self._loop is None else self._loop.position_sigma_m
        seen_m3 = np.zeros(self.count) if self._maps is None else self._maps.advance(self._T_world_imu(after))
        if self._beams is not None:
            self._beams.advance(after)
        step = Transition(last.states, after, action, last.action, self._t_s, reason > 0, standing_m, sigma_m, seen_m3)
        failed = _checked_mask(task, "failed", task.failed(last.goals, step), self.count)
        reason = np.where((reason == 0) & failed, Termination.TASK_FAILED, reason)
        step = replace(step, failed=reason > 0)
        goals = task.advance(last.goals, step)
        terms = _checked_terms(task, task.reward_terms(last.goals, goals, step), self.count)
        images = None if last.images is None else last.images.one_step_later()
        self._episode = replace(
            last, goals=goals, states=after, action=action, delayed=delayed, loops=loops, images=images
        )
        success = _checked_mask(task, "success", task.success(goals, step), self.count) & ~step.failed
        reason = np.where(success & task.ends_with_success, Termination.SUCCESS, reason)
        info = {
            "success": success,
            "termination": reason,
            "reward_terms": terms,
            **self._state_info(),
        }
        return StepResult(np.sum(list(terms.values()), axis=0), reason > 0, info)

    def observe(self) -> Observations:
        """Return the observations of n environments: of the policy as perceived, of the critic as they are."""
        now = self._episode
        if self._renderer is not None and now.images is not None:
            images = self._renderer.renewed(now.images, self._T_world_imu(now.states), self.plant.t_ns, now.randomized)
            now = replace(now, images=images)
            self._episode = now
        true = ObservedState(
            now.states,
            self._objective(),
            self._imu.samples,
            self._imu.bias,
            lambda: self.plant.wind_m_s,
            now.action,
            now.randomized,
            None if self._maps is None else self._maps.around,
            None if self._beams is None else self._beams.ranges_m,
        )
        seen = true if self._loop is None else replace(true, states=self._loop.states(), imu_bias=self._loop.bias)
        return self.arrangement.observe(seen, true, {} if now.images is None else now.images.images)

    def save(self) -> dict[str, Any]:
        """Return the state of episodes, physics, IMUs and random numbers, with arrays that no later step changes.

        Raises:
            ConfigError: There is an estimator, whose state cannot be copied.
        """
        self.require_copyable()
        return {
            "episode": self._episode,
            "plant": self.plant.save(),
            "imu": self._imu.save(),
            "maps": None if self._maps is None else self._maps.save(),
            "beams": None if self._beams is None else self._beams.save(),
            "depth_errors": None if self._renderer is None else self._renderer.save(),
            "rng": self._rng.bit_generator.state,
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Return to a state of `save`, of environments with the same settings.

        Raises:
            ConfigError: There is an estimator, whose state cannot be replaced.
        """
        self.require_copyable()
        self._episode = saved["episode"]
        self.plant.restore(saved["plant"])
        self._imu.restore(saved["imu"])
        if self._maps is not None:
            self._maps.restore(saved["maps"])
        if self._beams is not None:
            self._beams.restore(saved["beams"])
        if self._renderer is not None:
            self._renderer.restore(saved["depth_errors"])
        self._rng.bit_generator.state = saved["rng"]

    def close(self) -> None:
        """Release the resources of rendering; further calls have no effect."""
        if self._renderer is not None:
            self._renderer.close()
        self._close_loop()

    @property
    def _t_ns(self) -> Times:
        """(n,) Times since the start of the episodes, after the wait for an estimate [ns]."""
        return self.plant.t_ns - self._episode.begun_ns

    @property
    def _t_s(self) -> Array:
        """(n,) Times since the start of the episodes [s]."""
        return np.asarray(self._t_ns * 1e-9, dtype=np.float64)

    @property
    def _standing_m(self) -> float:
        """Height of the centre of mass of a vehicle that stands on the pad, in the world [m]."""
        return self._worlds.floor_m + self.plant.standing_height_m

    def _T_world_imu(self, states: VehicleStates) -> Array:
        """Return the poses (n, 4, 4) of the IMUs of vehicles."""
        return pose_matrix(states.R_world_vehicle, states.position_m) @ self.settings.rig.T_vehicle_imu

    def _begin(self, world: npt.NDArray[np.intp]) -> tuple[VehicleStates, Any]:
        """Draw initial states and goals of the task in worlds (k,)."""
        return self._worlds.begin(self.settings.vehicle, self._rng, world, self.plant.standing_height_m)

    def _advance(self, commands: Array, interval: int) -> None:
        """Advance physics, IMU and estimator by one IMU interval of a step, with commands (n, R) [rad/s]."""
        self.plant.advance(commands)
        if not self.settings.has_imu:
            return
        sample = self._imu.measure(interval, self._episode.randomized.imu_errors)
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
        settings, begun = self.settings, self._episode
        T = pose_matrix(planned.R_world_vehicle[0], planned.position_m[0])
        cameras = settings.cameras_of_episode(begun.randomized, int(self._rng.integers(2**31)))
        self._loop = EstimatorLoop(make, settings.rig, settings.estimation, cameras, T, begun.states)
        self._loop.measure(0, self._imu.samples[0, -1], begun.states)
        longest_ns = settings.estimation.longest_wait_s * 1e9
        while not self._loop.ready and self.plant.t_ns[0] < longest_ns:
            self._advance(np.zeros((1, self.settings.vehicle.rotor_count)), -1)
        self._imu.repeat_last()
        self._episode = replace(begun, states=self.plant.states, begun_ns=self.plant.t_ns)
        self._loop.start()

    def _close_loop(self) -> None:
        """Release the resources of the estimator's cameras."""
        if self._loop is not None:
            self._loop.close()
            self._loop = None

    def require_copyable(self) -> None:
        """Check that the state can be copied.

        Raises:
            ConfigError: There is an estimator.
        """
        if self.settings.estimator is not None:
            raise ConfigError(
                "state of an environment with an estimator, which cannot be copied; expected to repeat the episode with"
                " the same seed and actions, or an environment without an estimator"
            )

    def _objective(self) -> Objective:
        """Return the current and the following goals."""
        return self.settings.task.objective(self._episode.goals, self._t_s)

    def _state_info(self) -> dict[str, Any]:
        """Return values by name, arrays of n rows, that describe the current state."""
        goal = self._objective().position_m[:, 0]
        mapped = {} if self._maps is None else {"known_m3": self._maps.known_m3.copy()}
        estimated = {} if self._loop is None else self._loop.info()
        return {"distance_m": distance_m(self.states, goal), "t_ns": self._t_ns, **mapped, **estimated}

    def _arranged(self) -> Arrangement:
        """Return the arrangement of the observations."""
        settings = self.settings
        limits = limits_of(
            self._worlds.areas,
            self._objective(),
            settings.vehicle,
            settings.samples,
            self._mode.size,
            settings.mapping.shape,
            settings.beams,
        )
        own, images = settings.own_observations, {image.text for image in settings.images}
        return Arrangement(
            {
                name: own[name].observation() if name in own else observation_named(name, limits)
                for name in settings.observed
                if name not in images
            },
            {} if self._renderer is None else self._renderer.spaces,
            settings.policy_names,
            settings.critic_names,
            settings.flat,
        )

    def _unknown_maps(self) -> RayMaps:
        """Return unknown maps."""
        c = self.settings
        solids = [world_cells(c.world, seed, c.mapping.cell_m / FINER) for seed in self._worlds.seeds.tolist()]
        return RayMaps(self.count, solids, c.rig.cameras[c.camera], c.mapping, c.steps_per_cast)


def _checked_terms(task: AnyTask, terms: Mapping[str, Any], count: int) -> dict[str, Array]:
    """Return the terms of a reward by name, each (n,).

    Raises:
        ConfigError: There is none, or one has another shape or is not finite.
    """
    checked = {name: np.asarray(values) for name, values in terms.items()}
    if not checked:
        raise ConfigError(f"{type(task).__name__}.reward_terms returned no term; expected one or more by name")
    for name, values in checked.items():
        if values.shape != (count,) or values.dtype.kind not in "fiub":
            found = f"of shape {values.shape} and type {values.dtype}"
        elif not np.isfinite(values).all():
            found = f"with the value {values[~np.isfinite(values)][0]}"
        else:
            continue
        raise ConfigError(f"reward term {name!r} of {type(task).__name__} {found}; expected {count} finite numbers")
    return checked


def _checked_mask(task: AnyTask, name: str, mask: Any, count: int) -> Mask:
    """Return a mask (n,) of a task.

    Raises:
        ConfigError: It has another shape or type.
    """
    values = np.asarray(mask)
    if values.shape != (count,) or values.dtype != np.bool_:
        found = f"shape {values.shape} and type {values.dtype}"
        raise ConfigError(f"{type(task).__name__}.{name} returned {found}; expected {count} values of type bool")
    return values
