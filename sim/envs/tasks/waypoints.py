"""Task Waypoints: fly through random points one after another."""

from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array, Mask
from dronevio.models.quadrotor import Quadrotor
from dronevio.models.ranges import Range
from dronevio.sim.envs.tasks.task import (
    BaseTask,
    Objective,
    Start,
    Transition,
    approach_m,
    distance_m,
    flight_box_m,
    penalties,
    weighted,
)
from dronevio.sim.paths.space import FlightArea
from dronevio.sim.physics.vehicle_states import Table, VehicleStates

_START = Start()
_MARGIN_M = 0.5  # of waypoints from the bounds
_AHEAD = 2  # observed waypoints: the current one and the next


@dataclass(frozen=True, eq=False)
class WaypointsGoals(Table):
    """Waypoints and progress of n episodes."""

    waypoints_m: Array
    """(n, M, 3) Waypoints in order, in the world [m]."""
    reached: npt.NDArray[np.int64]
    """(n,) Numbers of waypoints that have been reached."""

    def ahead_m(self, count: int) -> Array:
        """Return the next waypoints (n, count, 3) [m]; the last one is repeated."""
        last = self.waypoints_m.shape[1] - 1
        index = np.minimum(self.reached[:, None] + np.arange(count), last)
        return np.take_along_axis(self.waypoints_m, index[..., None], axis=1)


@dataclass(frozen=True)
class Waypoints(BaseTask):
    """Fly through five random points in a room, one after another: ``dronevio/Waypoints-v0``.

    ## Description
    Five points are drawn in the free space of the furnished room, at least 1 m from one to the next. The quadrotor
    starts in the air near the centre of the free space and has to come within 0.25 m of each point in order.

    ## Action space
    ``Box(-1, 1, (4,), float32)``. By default collective thrust and body rates (mode ``rates``);
    `dronevio.sim.envs.episodes.actions` describes all modes and their units.

    ## Observation space
    A ``Dict`` of ``Box`` with these entries by default; `dronevio.sim.envs.sensing.observations` describes all that can
    be chosen.

    | key | shape | content |
    |---|---|---|
    | ``goals`` | (2, 3) float32 | current and next point relative to the vehicle, in its frame [m] |
    | ``rotation`` | (3, 3) float32 | rotation matrix, vehicle to world |
    | ``body_velocity`` | (3,) float32 | velocity in the vehicle frame [m/s] |
    | ``rate`` | (3,) float32 | angular velocity in the vehicle frame [rad/s] |
    | ``last_action`` | (4,) float32 | action of the last step |

    ## Rewards
    The sum of these terms per step, which are in ``info["reward_terms"]``:

    - ``progress``: 5 per metre of approach to the current point, at most 0.04 m per step, which is 2 m/s: a faster
      flight is not rewarded, since it fails more often
    - ``reached``: 5 for each point that is reached
    - ``rate``: −0.02 per rad/s of angular velocity
    - ``smoothness``: −0.02 · mean of the squared change of the action
    - ``failure``: −10 if the episode ends by a failure

    ## Starting state
    Uniform around the centre of the free space: position within ±0.5 m, velocity within ±0.5 m/s, rotation vector
    within ±0.2 rad and angular velocity within ±0.5 rad/s, each on each axis (``start``).

    ## Episode end
    Terminated with success when the last point is reached. Terminated by a contact with the floor, outside the free
    space of the world, and if the vehicle tilts by more than 90°. Truncated after 15 s, 750 steps.

    ## Arguments
    `dronevio.sim.envs.single.DroneEnv` describes the arguments that all environments have. Those of this task are the
    fields of this class: ``gymnasium.make("dronevio/Waypoints-v0", task=Waypoints(count=10))``.

    ## Version history
    - v0: initial version.
    """

    default_observations: ClassVar[tuple[str, ...]] = ("goals", "rotation", "body_velocity", "rate", "last_action")
    """Names of the default observations."""
    default_action: ClassVar[str] = "rates"
    """Name of the default action mode."""

    world: str = "room"
    """Name of the world."""
    episode_s: Annotated[float, Range(0.1, 1e5)] = 15.0
    """Time limit of an episode [s]."""
    count: Annotated[int, Range(1, 1000)] = 5
    """Number of points."""
    spacing_m: Annotated[float, Range(0.0, 100.0)] = 1.0
    """Smallest distance from one point to the next [m]."""
    tolerance_m: Annotated[float, Range(above=0.0, high=100.0)] = 0.25
    """Distance from a point at which it is reached [m]."""
    start: Start = _START
    """Spread of the starting states around the centre of the free space."""
    progress: Annotated[float, Range(0.0, 1e3)] = 5.0
    """Reward of a metre of approach [1/m]."""
    approach_m: Annotated[float, Range(0.0, 10.0)] = 0.04
    """Largest approach in a step that is rewarded [m]."""
    reached: Annotated[float, Range(0.0, 1e4)] = 5.0
    """Reward of a point that is reached."""
    rate: Annotated[float, Range(0.0, 1e3)] = 0.02
    """Weight of the angular velocity [s/rad]."""
    smoothness: Annotated[float, Range(0.0, 1e3)] = 0.02
    """Weight of the mean squared change of the action."""
    failure: Annotated[float, Range(0.0, 1e4)] = 10.0
    """Penalty of a failure."""
    obstacles: bool = False
    """Whether the obstacles of the world are part of the physics; there are none in the free space of a world."""

    def begin(
        self, area: FlightArea, quadrotor: Quadrotor, rng: np.random.Generator, count: int
    ) -> tuple[VehicleStates, WaypointsGoals]:
        """Draw initial states and points."""
        box = flight_box_m(area, _MARGIN_M)
        centre = np.tile(box.mean(axis=0), (count, 1))
        states = self.start.states(centre, quadrotor, rng)
        points = np.empty((count, self.count, 3))
        last = centre
        for k in range(self.count):
            points[:, k] = last = _drawn_apart(box, last, self.spacing_m, rng)
        return states, WaypointsGoals(points, np.zeros(count, dtype=np.int64))

    def objective(self, goals: WaypointsGoals, t_s: Array) -> Objective:
        """Return the current and the next point."""
        return Objective.of(goals.ahead_m(_AHEAD))

    def advance(self, goals: WaypointsGoals, step: Transition) -> WaypointsGoals:
        """Count the points that are reached."""
        reached = distance_m(step.after, goals.ahead_m(1)[:, 0]) < self.tolerance_m
        return replace(goals, reached=np.minimum(goals.reached + reached, self.count))

    def reward_terms(self, before: WaypointsGoals, goals: WaypointsGoals, step: Transition) -> dict[str, Array]:
        """Return the terms of the reward."""
        current = before.ahead_m(1)[:, 0]
        return {
            "progress": self.progress * np.minimum(approach_m(step, current), self.approach_m),
            "reached": weighted(self.reached, goals.reached - before.reached),
            **penalties(step, self.rate, self.smoothness, self.failure),
        }

    def success(self, goals: WaypointsGoals, step: Transition) -> Mask:
        """Return where all points have been reached."""
        return goals.reached >= self.count

    def with_goal(self, goals: WaypointsGoals, goal_m: Array) -> WaypointsGoals:
        """Return goals whose first point is given, (n, 3) [m]."""
        return replace(goals, waypoints_m=np.concatenate([goal_m[:, None], goals.waypoints_m[:, 1:]], axis=1))


def _drawn_apart(box: Array, last: Array, spacing_m: float, rng: np.random.Generator, tries: int = 8) -> Array:
    """Return points (n, 3) in a box, at least a spacing from other points (n, 3): the first such one of some tries."""
    candidates = rng.uniform(box[0], box[1], (tries, *last.shape))
    apart = np.linalg.norm(candidates - last, axis=2) >= spacing_m
    apart[-1] = True
    first = np.argmax(apart, axis=0)
    return np.asarray(candidates[first, np.arange(len(last))])
