"""Interface of tasks: what the vehicles are to do, how they start, what is rewarded, and when an episode ends.

All functions are pure and operate on n episodes at once; row k of every array belongs to episode k.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array, Mask
from dronevio.models.quadrotor import Quadrotor
from dronevio.models.ranges import Range, Settings
from dronevio.models.rotation import exp_so3
from dronevio.sim.paths.space import FlightArea
from dronevio.sim.physics.vehicle_states import Table, VehicleStates

Goals = TypeVar("Goals")


@dataclass(frozen=True, eq=False)
class Objective(Table):
    """Places that n vehicles are to reach, now and next."""

    position_m: Array
    """(n, K, 3) Current goal and the following ones in the world [m]."""
    direction: Array
    """(n, K, 3) Unit normals of the gates, in the direction of flight; zeros without gates."""
    size_m: Array
    """(n, K) Width and height of the openings of gates [m]; zeros without gates."""

    @classmethod
    def of(cls, position_m: Array) -> "Objective":
        """Return the objective of reaching points (n, K, 3) [m]."""
        return cls(position_m, np.zeros_like(position_m), np.zeros(position_m.shape[:2]))


@dataclass(frozen=True, eq=False)
class Transition:
    """One step of n episodes."""

    before: VehicleStates
    """States before the step."""
    after: VehicleStates
    """States after the step."""
    action: Array
    """(n, A) Actions of the step."""
    previous_action: Array
    """(n, A) Actions of the step before; zeros in the first step of an episode."""
    t_s: Array
    """(n,) Times since the start of the episodes, at the end of the step [s]."""
    failed: Mask
    """(n,) Whether the episodes end in this step by a collision, outside the bounds, upside down or diverged."""
    standing_m: float = 0.0
    """Height of the centre of mass of a vehicle that stands on the ground above it [m]."""
    position_sigma_m: Array = field(default_factory=lambda: np.zeros(1))
    """(n,) Standard deviations of the estimated positions along their least certain axes; zeros without an estimator
    [m]."""
    seen_m3: Array = field(default_factory=lambda: np.zeros(1))
    """(n,) Volumes that became known in the maps; zeros without maps [m³]."""


@dataclass(frozen=True)
class Start(Settings):
    """Spread of the starting states; all components are uniformly distributed."""

    position_m: Annotated[float, Range(0.0, 100.0)] = 0.5
    """Largest distance from the place of the start along each axis [m]."""
    velocity_m_s: Annotated[float, Range(0.0, 100.0)] = 0.5
    """Largest velocity along each axis [m/s]."""
    tilt_rad: Annotated[float, Range(0.0, np.pi)] = 0.2
    """Largest component of the rotation vector from level flight along x [rad]."""
    rate_rad_s: Annotated[float, Range(0.0, 100.0)] = 0.5
    """Largest angular velocity about each axis [rad/s]."""

    def states(
        self, place_m: Array, quadrotor: Quadrotor, rng: np.random.Generator, yaw_rad: Array | None = None
    ) -> VehicleStates:
        """Return states near places (n, 3), with the rotors at hover speed and full batteries.

        Args:
            place_m: (n, 3) Places of the start [m].
            quadrotor: The type of the vehicles.
            rng: Generator of the deviations.
            yaw_rad: (n,) Headings [rad]; along x by default.
        """
        n = len(place_m)
        deviation = rng.uniform(-1.0, 1.0, (4, n, 3))
        R = exp_so3(self.tilt_rad * deviation[1])
        if yaw_rad is not None:
            R = exp_so3(np.stack([np.zeros(n), np.zeros(n), yaw_rad], axis=1)) @ R
        return VehicleStates.at(
            place_m + self.position_m * deviation[0],
            R,
            self.velocity_m_s * deviation[2],
            self.rate_rad_s * deviation[3],
            quadrotor.hover_speed_rad_s,
            rotors=quadrotor.rotor_count,
        )


class Task(Protocol[Goals]):
    """Interface of a task. ``Goals`` is a frozen dataclass of arrays with the goals and the progress of n episodes."""

    default_observations: ClassVar[tuple[str, ...]]
    """Names of the default observations; see `dronevio.sim.envs.sensing.observations`."""
    default_action: ClassVar[str]
    """Name of the default action mode; see `dronevio.sim.envs.episodes.actions`."""
    lands: ClassVar[bool]
    """Whether standing on the ground is part of the task; otherwise it is a failure."""
    maps: ClassVar[bool]
    """Whether the task depends on maps of what has been seen."""
    ends_with_success: ClassVar[bool]
    """Whether a success ends the episode; otherwise it goes on until the time limit."""

    @property
    def world(self) -> str:
        """Name of the world."""

    @property
    def episode_s(self) -> float:
        """Time limit of an episode [s]."""

    @property
    def obstacles(self) -> bool:
        """Whether the obstacles and walls of the world are part of the physics; otherwise only a floor is."""

    def bounds_m(self, area: FlightArea) -> Array:
        """Return the box (2, 3) that vehicles must not leave [m]."""

    def begin(
        self, area: FlightArea, quadrotor: Quadrotor, rng: np.random.Generator, count: int
    ) -> tuple[VehicleStates, Goals]:
        """Draw the initial states and the goals of ``count`` episodes in a world.

        What an episode needs of its world is part of its goals. Vehicles whose height is below that of a standing
        vehicle start standing on the ground.
        """

    def objective(self, goals: Goals, t_s: Array) -> Objective:
        """Return the current and the following goals at times (n,) since the start of the episodes [s]."""

    def advance(self, goals: Goals, step: Transition) -> Goals:
        """Return the goals after a step."""

    def reward_terms(self, before: Goals, goals: Goals, step: Transition) -> dict[str, Array]:
        """Return the terms of the reward (n,) by name, whose sum is the reward.

        Args:
            before: The goals before the step.
            goals: The goals after the step.
            step: The step.
        """

    def success(self, goals: Goals, step: Transition) -> Mask:
        """Return in which episodes (n,) the vehicles do at this time what the task demands."""

    def failed(self, goals: Goals, step: Transition) -> Mask:
        """Return which episodes (n,) end by a failure of this task, beside those that `Termination` lists.

        Args:
            goals: The goals before the step.
            step: The step, whose `Transition.failed` has the other failures.
        """

    def with_goal(self, goals: Goals, goal_m: Array) -> Goals:
        """Return goals whose first goal is given, (n, 3) [m].

        Raises:
            ConfigError: The goals of this task cannot be given.
        """


AnyTask = Task[Any]
"""A task with goals of any type."""


@dataclass(frozen=True, eq=False)
class PointGoals(Table):
    """One point to reach for each of n episodes."""

    goal_m: Array
    """(n, 3) Points in the world [m]."""


@dataclass(frozen=True)
class BaseTask(Settings, ABC):
    """Base of tasks: what most of them have in common, and the defaults of a task of one's own.

    A subclass defines `begin` and `reward_terms`, and `success` if it is to end otherwise than by a failure or the time
    limit. Its goals are `PointGoals`, or any frozen dataclass of arrays derived from
    `dronevio.sim.physics.vehicle_states.Table`, with `objective`, `advance` and `with_goal` of its own.
    """

    default_observations: ClassVar[tuple[str, ...]] = ("position", "rotation", "velocity", "rate")
    """Names of the default observations; see `dronevio.sim.envs.sensing.observations`."""
    default_action: ClassVar[str] = "rates"
    """Name of the default action mode; see `dronevio.sim.envs.episodes.actions`."""
    lands: ClassVar[bool] = False
    """Whether standing on the ground is part of the task; otherwise it is a failure."""
    maps: ClassVar[bool] = False
    """Whether the task depends on maps of what has been seen."""
    ends_with_success: ClassVar[bool] = True
    """Whether a success ends the episode; otherwise it goes on until the time limit."""

    world: str = "room"
    """Name of the world."""
    episode_s: Annotated[float, Range(0.1, 1e5)] = 10.0
    """Time limit of an episode [s]."""
    obstacles: bool = False
    """Whether the obstacles and walls of the world are part of the physics; otherwise only a floor is."""

    def bounds_m(self, area: FlightArea) -> Array:
        """Return the free box (2, 3) of the world [m]."""
        return area.free_box

    @abstractmethod
    def begin(
        self, area: FlightArea, quadrotor: Quadrotor, rng: np.random.Generator, count: int
    ) -> tuple[VehicleStates, Any]:
        """Draw the initial states and the goals of ``count`` episodes."""

    def objective(self, goals: Any, t_s: Array) -> Objective:
        """Return the points to reach."""
        return Objective.of(goals.goal_m[:, None])

    def advance(self, goals: Any, step: Transition) -> Any:
        """Return the same goals."""
        return goals

    @abstractmethod
    def reward_terms(self, before: Any, goals: Any, step: Transition) -> dict[str, Array]:
        """Return the terms of the reward (n,) by name."""

    def success(self, goals: Any, step: Transition) -> Mask:
        """Return False everywhere."""
        return np.zeros(len(step.t_s), dtype=np.bool_)

    def failed(self, goals: Any, step: Transition) -> Mask:
        """Return False everywhere."""
        return np.zeros(len(step.t_s), dtype=np.bool_)

    def with_goal(self, goals: Any, goal_m: Array) -> Any:
        """Return given points (n, 3) [m]."""
        return replace(goals, goal_m=goal_m)


def flight_box_m(area: FlightArea, margin_m: float) -> Array:
    """Return the box (2, 3) without obstacles of a world, reduced by a margin on all sides but at least that above the
    floor [m].
    """
    low, high = area.free_box[0] + margin_m, area.free_box[1] - margin_m
    low[2] = max(low[2], area.pad[2] + margin_m)
    return np.stack([np.minimum(low, high), high])


def distance_m(states: VehicleStates, goal_m: Array) -> Array:
    """Return the distances (n,) of vehicles from goals (n, 3) [m]."""
    return _length(states.position_m - goal_m)


def rate_rad_s(states: VehicleStates) -> Array:
    """Return the angular speeds (n,) of vehicles [rad/s]."""
    return _length(states.rate_rad_s)


def action_change(step: Transition) -> Array:
    """Return the mean squared changes (n,) of the components of the actions."""
    change = step.action - step.previous_action
    return np.asarray(np.vecdot(change, change) / change.shape[1])


def approach_m(step: Transition, goal_m: Array) -> Array:
    """Return how much nearer (n,) vehicles have come to goals (n, 3) in a step [m]."""
    return distance_m(step.before, goal_m) - distance_m(step.after, goal_m)


def closeness(states: VehicleStates, goal_m: Array, distance_scale_m: float, rate_scale_rad_s: float) -> Array:
    """Return a reward (n,) that is 1 for vehicles that hover at goals (n, 3), and decreases exponentially."""
    return np.exp(-distance_m(states, goal_m) / distance_scale_m - rate_rad_s(states) / rate_scale_rad_s)


def penalties(step: Transition, rate: float, smoothness: float, failure: float) -> dict[str, Array]:
    """Return the negative terms of the reward (n,) by name: angular velocity, change of the action, and failure.

    Args:
        step: The step.
        rate: Weight of the angular velocity [s/rad].
        smoothness: Weight of the mean squared change of the action.
        failure: Penalty of a failure.
    """
    return {
        "rate": -rate * rate_rad_s(step.after),
        "smoothness": -smoothness * action_change(step),
        "failure": weighted(-failure, step.failed),
    }


def weighted(weight: float, values: npt.ArrayLike) -> Array:
    """Return values (n,), which may be counts or masks, multiplied by a weight."""
    return np.asarray(weight * np.asarray(values, dtype=np.float64))


def _length(vectors: Array) -> Array:
    """Return the lengths (n,) of vectors (n, 3)."""
    return np.asarray(np.sqrt(np.vecdot(vectors, vectors)))
