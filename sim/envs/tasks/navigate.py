"""Task Navigate: reach a goal among obstacles by camera."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from dronevio.models.arrays import Array, Mask
from dronevio.models.quadrotor import Quadrotor
from dronevio.models.ranges import Range
from dronevio.sim.envs.tasks.places import free_places
from dronevio.sim.envs.tasks.task import (
    BaseTask,
    PointGoals,
    Start,
    Transition,
    approach_m,
    distance_m,
    penalties,
    weighted,
)
from dronevio.sim.paths.space import FlightArea
from dronevio.sim.physics.vehicle_states import VehicleStates

_START = Start(position_m=0.1, velocity_m_s=0.3, tilt_rad=0.1, rate_rad_s=0.3)
_TRIES = 64  # goals drawn for each start, of which the first at a suitable distance is taken


@dataclass(frozen=True)
class Navigate(BaseTask):
    """Reach a goal among the trees of a forest by a depth camera: ``dronevio/Navigate-v0``.

    ## Description
    Start and goal are random places with 0.6 m of clearance from all obstacles, 5 to 12 m apart. The quadrotor starts
    with its camera towards the goal. It knows where the goal is, but sees the obstacles in the depth image only.

    ## Action space
    ``Box(-1, 1, (4,), float32)``. By default velocity and yaw rate (mode ``velocity``);
    `dronevio.sim.envs.episodes.actions` describes all modes and their units.

    ## Observation space
    A ``Dict`` of ``Box`` with these entries by default; `dronevio.sim.envs.sensing.observations` describes all that can
    be chosen.

    | key | shape | content |
    |---|---|---|
    | ``depth`` | (64, 64, 1) float32 | depth along the optical axis of the forward camera, at most 20 m [m] |
    | ``goals`` | (1, 3) float32 | goal relative to the vehicle, in its frame [m] |
    | ``rotation`` | (3, 3) float32 | rotation matrix, vehicle to world |
    | ``body_velocity`` | (3,) float32 | velocity in the vehicle frame [m/s] |
    | ``last_action`` | (4,) float32 | action of the last step |

    ## Rewards
    The sum of these terms per step, which are in ``info["reward_terms"]``:

    - ``progress``: 1 per metre of approach to the goal
    - ``reached``: 10 for reaching the goal
    - ``rate``: −0.02 per rad/s of angular velocity
    - ``smoothness``: −0.02 · mean of the squared change of the action
    - ``failure``: −10 if the episode ends by a failure

    ## Starting state
    At a random free place between 1 and 2.5 m above the ground, heading to the goal. The deviations are uniform:
    position within ±0.1 m, velocity within ±0.3 m/s, rotation vector within ±0.1 rad and angular velocity within
    ±0.3 rad/s, each on each axis (``start``).

    ## Episode end
    Terminated with success within 0.5 m of the goal. Terminated by a contact with ground or obstacles, outside the
    bounds of the world, and if the vehicle tilts by more than 90°. Truncated after 30 s, 1500 steps.

    ## Arguments
    `dronevio.sim.envs.single.DroneEnv` describes the arguments that all environments have; ``world`` and ``world_seed``
    select the obstacles. Those of this task are the fields of this class:
    ``gymnasium.make("dronevio/Navigate-v0", task=Navigate(distance_m=(3.0, 6.0)), world="room")``.

    ## Version history
    - v0: initial version.
    """

    default_observations: ClassVar[tuple[str, ...]] = ("depth", "goals", "rotation", "body_velocity", "last_action")
    """Names of the default observations."""
    default_action: ClassVar[str] = "velocity"
    """Name of the default action mode."""

    world: str = "forest"
    """Name of the world."""
    episode_s: Annotated[float, Range(0.1, 1e5)] = 30.0
    """Time limit of an episode [s]."""
    distance_m: Annotated[tuple[float, float], Range(above=0.0, high=1e3)] = (5.0, 12.0)
    """Smallest and largest distance from start to goal [m]."""
    height_m: Annotated[tuple[float, float], Range(above=0.0, high=100.0)] = (1.0, 2.5)
    """Smallest and largest height of start and goal above the floor [m]."""
    clearance_m: Annotated[float, Range(0.0, 10.0)] = 0.6
    """Smallest distance of start and goal from obstacles [m]."""
    tolerance_m: Annotated[float, Range(above=0.0, high=100.0)] = 0.5
    """Distance from the goal at which it is reached [m]."""
    start: Start = _START
    """Spread of the starting states."""
    progress: Annotated[float, Range(0.0, 1e3)] = 1.0
    """Reward of a metre of approach [1/m]."""
    reached: Annotated[float, Range(0.0, 1e4)] = 10.0
    """Reward of reaching the goal."""
    rate: Annotated[float, Range(0.0, 1e3)] = 0.02
    """Weight of the angular velocity [s/rad]."""
    smoothness: Annotated[float, Range(0.0, 1e3)] = 0.02
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
    ) -> tuple[VehicleStates, PointGoals]:
        """Draw starts and goals in free space."""
        places = free_places(area, self.height_m, self.clearance_m)
        start = places[rng.integers(0, len(places), count)]
        goal = drawn_goals(self, area, start, rng)
        heading = goal - start
        states = self.start.states(start, quadrotor, rng, np.arctan2(heading[:, 1], heading[:, 0]))
        return states, PointGoals(goal)

    def reward_terms(self, before: PointGoals, goals: PointGoals, step: Transition) -> dict[str, Array]:
        """Return the terms of the reward."""
        return {
            "progress": self.progress * approach_m(step, goals.goal_m),
            "reached": weighted(self.reached, self.success(goals, step)),
            **penalties(step, self.rate, self.smoothness, self.failure),
        }

    def success(self, goals: PointGoals, step: Transition) -> Mask:
        """Return which goals are reached."""
        return distance_m(step.after, goals.goal_m) < self.tolerance_m


def drawn_goals(task: Navigate, area: FlightArea, start: Array, rng: np.random.Generator) -> Array:
    """Return random free places (n, 3) at suitable distances from the starts (n, 3) of a task [m]."""
    places = free_places(area, task.height_m, task.clearance_m)
    candidates = places[rng.integers(0, len(places), (_TRIES, len(start)))]
    distance = np.linalg.norm(candidates - start, axis=2)
    # how far each distance is from the demanded range; 0 within
    excess = np.maximum(np.maximum(task.distance_m[0] - distance, distance - task.distance_m[1]), 0.0)
    return np.asarray(candidates[np.argmin(excess, axis=0), np.arange(len(start))])
