"""Task Hover: bring a disturbed quadrotor to a point and keep it there."""

from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np

from dronevio.models.arrays import Array, Mask
from dronevio.models.quadrotor import Quadrotor
from dronevio.models.ranges import Range
from dronevio.sim.envs.tasks.task import (
    BaseTask,
    Objective,
    Start,
    Transition,
    action_change,
    closeness,
    distance_m,
)
from dronevio.sim.paths.space import FlightArea
from dronevio.sim.physics.vehicle_states import Table, VehicleStates

_START = Start()
_KEPT_S = 1.0  # time for which a vehicle has to be at its target until it keeps it


@dataclass(frozen=True, eq=False)
class HoverGoals(Table):
    """Targets of n episodes."""

    target_m: Array
    """(n, 3) Positions to keep in the world [m]."""
    away_s: Array
    """(n,) Times at which the vehicles were last away from their targets; minus infinity if never [s]."""


@dataclass(frozen=True)
class Hover(BaseTask):
    """Bring a disturbed quadrotor to a point 1.2 m above the landing pad and keep it there: ``dronevio/Hover-v0``.

    ## Description
    The quadrotor starts in the air near the target with random velocity and tilt, its rotors at hover speed. It has to
    fly to the target and stay there. The world is the furnished room, of which the free space in the middle is used.

    ## Action space
    ``Box(-1, 1, (4,), float32)``. By default collective thrust and body rates (mode ``rates``);
    `dronevio.sim.envs.episodes.actions` describes all modes and their units.

    ## Observation space
    A ``Dict`` of ``Box`` with these entries by default; `dronevio.sim.envs.sensing.observations` describes all that can
    be chosen.

    | key | shape | content |
    |---|---|---|
    | ``position`` | (3,) float32 | position relative to the target, in the world frame [m] |
    | ``rotation`` | (3, 3) float32 | rotation matrix, vehicle to world |
    | ``velocity`` | (3,) float32 | velocity in the world frame [m/s] |
    | ``rate`` | (3,) float32 | angular velocity in the vehicle frame [rad/s] |

    ## Rewards
    The sum of two terms per step, which are in ``info["reward_terms"]``. With the distance d from the target, the
    angular velocity ω and the change Δa of the action:

    - ``closeness``: exp(−d / 0.5 m − |ω| / 5 rad/s), 1 at perfect hover
    - ``smoothness``: −0.01 · mean of Δa²

    ## Starting state
    Uniform: position within ±0.5 m of the target, velocity within ±0.5 m/s, rotation vector within ±0.2 rad and angular
    velocity within ±0.5 rad/s, each on each axis (``start``).

    ## Episode end
    Terminated by a contact with the floor, outside the free space of the world (5.6 × 3.8 × 2.4 m in the room), and if
    the vehicle tilts by more than 90°. Truncated after 10 s, 500 steps. ``info["success"]`` tells whether the distance
    has been below 0.1 m for one second.

    ## Arguments
    `dronevio.sim.envs.single.DroneEnv` describes the arguments that all environments have. Those of this task are the
    fields of this class: ``gymnasium.make("dronevio/Hover-v0", task=Hover(height_m=1.5))``.

    ## Version history
    - v0: initial version.
    """

    ends_with_success: ClassVar[bool] = False
    """Whether a success ends the episode."""

    world: str = "room"
    """Name of the world."""
    episode_s: Annotated[float, Range(0.1, 1e5)] = 10.0
    """Time limit of an episode [s]."""
    height_m: Annotated[float, Range(above=0.0, high=100.0)] = 1.2
    """Height of the target above the landing pad [m]."""
    start: Start = _START
    """Spread of the starting states around the target."""
    tolerance_m: Annotated[float, Range(above=0.0, high=100.0)] = 0.1
    """Largest distance from the target at which hovering is a success [m]."""
    distance_scale_m: Annotated[float, Range(above=0.0, high=1e3)] = 0.5
    """Distance at which the closeness has decreased by the factor e [m]."""
    rate_scale_rad_s: Annotated[float, Range(above=0.0, high=1e3)] = 5.0
    """Angular velocity at which the closeness has decreased by the factor e [rad/s]."""
    smoothness: Annotated[float, Range(0.0, 1e3)] = 0.01
    """Weight of the mean squared change of the action."""
    obstacles: bool = False
    """Whether the obstacles of the world are part of the physics; there are none in the free space of a world."""

    def begin(
        self, area: FlightArea, quadrotor: Quadrotor, rng: np.random.Generator, count: int
    ) -> tuple[VehicleStates, HoverGoals]:
        """Draw initial states around the target."""
        target = np.tile(area.pad + [0.0, 0.0, self.height_m], (count, 1))
        return self.start.states(target, quadrotor, rng), HoverGoals(target, np.full(count, -np.inf))

    def objective(self, goals: HoverGoals, t_s: Array) -> Objective:
        """Return the targets."""
        return Objective.of(goals.target_m[:, None])

    def advance(self, goals: HoverGoals, step: Transition) -> HoverGoals:
        """Record when vehicles are away from their targets."""
        return replace(goals, away_s=np.where(self._is_near(goals, step), goals.away_s, step.t_s))

    def reward_terms(self, before: HoverGoals, goals: HoverGoals, step: Transition) -> dict[str, Array]:
        """Return closeness and smoothness."""
        return {
            "closeness": closeness(step.after, goals.target_m, self.distance_scale_m, self.rate_scale_rad_s),
            "smoothness": -self.smoothness * action_change(step),
        }

    def success(self, goals: HoverGoals, step: Transition) -> Mask:
        """Return which vehicles keep their targets."""
        return self._is_near(goals, step) & (step.t_s - goals.away_s >= _KEPT_S)

    def with_goal(self, goals: HoverGoals, goal_m: Array) -> HoverGoals:
        """Return goals with given targets (n, 3) [m]."""
        return replace(goals, target_m=goal_m)

    def _is_near(self, goals: HoverGoals, step: Transition) -> Mask:
        """Return which vehicles are at their targets after a step."""
        return distance_m(step.after, goals.target_m) < self.tolerance_m
