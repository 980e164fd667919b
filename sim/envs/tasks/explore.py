"""Task Explore: see as much as possible of an unknown world."""

from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np

from dronevio.models.arrays import Array, Mask
from dronevio.models.errors import ConfigError
from dronevio.models.quadrotor import Quadrotor
from dronevio.models.ranges import Range
from dronevio.sim.envs.tasks.places import free_places
from dronevio.sim.envs.tasks.task import BaseTask, Objective, Start, Transition, penalties, weighted
from dronevio.sim.paths.space import FlightArea
from dronevio.sim.physics.vehicle_states import Table, VehicleStates

_START = Start(position_m=0.1, velocity_m_s=0.3, tilt_rad=0.1, rate_rad_s=0.3)


@dataclass(frozen=True, eq=False)
class ExploreGoals(Table):
    """Starts and progress of n episodes."""

    start_m: Array
    """(n, 3) Places of the starts in the world [m]."""
    seen_m3: Array
    """(n,) Volumes that have become known since the starts [m³]."""


@dataclass(frozen=True)
class Explore(BaseTask):
    """See as much as possible of an unknown office: ``dronevio/Explore-v0``.

    ## Description
    The quadrotor starts at a random place with 0.6 m of clearance from all obstacles, with any heading. The rays of its
    forward camera, which end after 4 m, fill a map of cells of 0.25 m: those that a ray passes are free, those in which
    one meets a surface are occupied, all others, and what lies behind surfaces, are unknown. The task is to make cells
    known. Nothing is rendered. `dronevio.sim.envs.sensing.ray_maps` describes the map.

    ## Action space
    ``Box(-1, 1, (4,), float32)``. By default velocity and yaw rate (mode ``velocity``);
    `dronevio.sim.envs.episodes.actions` describes all modes and their units.

    ## Observation space
    A ``Dict`` of ``Box`` with these entries by default; `dronevio.sim.envs.sensing.observations` describes all that can
    be chosen. ``position`` and ``goals`` are relative to, or lead to, the place of the start.

    | key | shape | content |
    |---|---|---|
    | ``local_map`` | (3, 32, 32) float32 | cells of 0.25 m around the vehicle, 0.5 m below, at and 0.5 m above it: \
0 unknown, −1 free, 1 occupied or outside the world; from behind to ahead and from right to left, by the heading |
    | ``height`` | (1,) float32 | height of the centre of mass above the floor [m] |
    | ``rotation`` | (3, 3) float32 | rotation matrix, vehicle to world |
    | ``body_velocity`` | (3,) float32 | velocity in the vehicle frame [m/s] |
    | ``last_action`` | (4,) float32 | action of the last step |

    ## Rewards
    The sum of these terms per step, which are in ``info["reward_terms"]``:

    - ``seen``: 0.2 per m³ of cells that become known
    - ``rate``: −0.001 per rad/s of angular velocity
    - ``smoothness``: −0.01 · mean of the squared change of the action
    - ``failure``: −10 if the episode ends by a failure

    ## Starting state
    At a random free place between 1 and 1.8 m above the floor, with a random heading. The deviations are uniform:
    position within ±0.1 m, velocity within ±0.3 m/s, rotation vector within ±0.1 rad and angular velocity within
    ±0.3 rad/s, each on each axis (``start``). What is seen from there is known without a reward.

    ## Episode end
    Terminated by a contact with ground or obstacles, outside the bounds of the world, and if the vehicle tilts by more
    than 90°. Truncated after 60 s, 3000 steps. ``info["success"]`` tells whether 150 m³ or more have become known since
    the start.

    ## Arguments
    `dronevio.sim.envs.single.DroneEnv` describes the arguments that all environments have; ``world`` and ``world_seed``
    select the surroundings, ``mapping`` the map. Those of this task are the fields of this class:
    ``gymnasium.make("dronevio/Explore-v0", task=Explore(episode_s=30.0), world="warehouse")``.

    ## Version history
    - v0: initial version.
    """

    default_observations: ClassVar[tuple[str, ...]] = (
        "local_map",
        "height",
        "rotation",
        "body_velocity",
        "last_action",
    )
    """Names of the default observations."""
    default_action: ClassVar[str] = "velocity"
    """Name of the default action mode."""
    maps: ClassVar[bool] = True
    """Whether the task depends on maps of what has been seen."""
    ends_with_success: ClassVar[bool] = False
    """Whether a success ends the episode."""

    world: str = "office"
    """Name of the world."""
    episode_s: Annotated[float, Range(0.1, 1e5)] = 60.0
    """Time limit of an episode [s]."""
    height_m: Annotated[tuple[float, float], Range(above=0.0, high=100.0)] = (1.0, 1.8)
    """Smallest and largest height of the start above the floor [m]."""
    clearance_m: Annotated[float, Range(0.0, 10.0)] = 0.6
    """Smallest distance of the start from obstacles [m]."""
    volume_m3: Annotated[float, Range(0.0, 1e6)] = 150.0
    """Volume that has to become known for a success [m³]."""
    start: Start = _START
    """Spread of the starting states."""
    seen: Annotated[float, Range(0.0, 1e3)] = 0.2
    """Reward of a volume that becomes known [1/m³]."""
    rate: Annotated[float, Range(0.0, 1e3)] = 0.001
    """Weight of the angular velocity [s/rad]."""
    smoothness: Annotated[float, Range(0.0, 1e3)] = 0.01
    """Weight of the mean squared change of the action."""
    failure: Annotated[float, Range(0.0, 1e4)] = 10.0
    """Penalty of a failure."""
    obstacles: bool = True
    """Whether the obstacles and walls of the world are part of the physics."""

    def bounds_m(self, area: FlightArea) -> Array:
        """Return the bounds (2, 3) of the world [m]."""
        return np.stack([area.space.low, area.space.high])

    def begin(
        self, area: FlightArea, quadrotor: Quadrotor, rng: np.random.Generator, count: int
    ) -> tuple[VehicleStates, ExploreGoals]:
        """Draw starts in free space, and headings."""
        places = free_places(area, self.height_m, self.clearance_m)
        start = places[rng.integers(0, len(places), count)]
        states = self.start.states(start, quadrotor, rng, rng.uniform(-np.pi, np.pi, count))
        return states, ExploreGoals(start, np.zeros(count))

    def objective(self, goals: ExploreGoals, t_s: Array) -> Objective:
        """Return the places of the starts."""
        return Objective.of(goals.start_m[:, None])

    def advance(self, goals: ExploreGoals, step: Transition) -> ExploreGoals:
        """Add the volumes of this step."""
        return replace(goals, seen_m3=goals.seen_m3 + step.seen_m3)

    def reward_terms(self, before: ExploreGoals, goals: ExploreGoals, step: Transition) -> dict[str, Array]:
        """Return the terms of the reward."""
        return {
            "seen": weighted(self.seen, step.seen_m3),
            **penalties(step, self.rate, self.smoothness, self.failure),
        }

    def success(self, goals: ExploreGoals, step: Transition) -> Mask:
        """Return where enough has become known."""
        return goals.seen_m3 >= self.volume_m3

    def with_goal(self, goals: ExploreGoals, goal_m: Array) -> ExploreGoals:
        """Raise ConfigError, since there is no goal."""
        raise ConfigError("a goal for the task Explore; expected none, since it has no goal")
