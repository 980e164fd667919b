"""Task VioHover: take off from the pad, hover, and land on it, flown on an estimate of the state."""

from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np

from dronevio.models.arrays import Array, Mask
from dronevio.models.quadrotor import Quadrotor
from dronevio.models.ranges import Range
from dronevio.sim.envs.tasks.task import BaseTask, Objective, Transition, action_change, closeness, weighted
from dronevio.sim.paths.space import FlightArea
from dronevio.sim.physics.vehicle_states import Table, VehicleStates

_ON_GROUND_M = 0.03  # height above that of a standing vehicle below which it touches down
_AT_REST_M_S = 0.05
_AT_REST_S = 0.5  # time for which a vehicle has to stand at rest until it has landed
_BELOW_PAD_M = 1.0  # the goal descends so far below the pad, so that errors of the estimate do not prevent a landing


@dataclass(frozen=True, eq=False)
class VioHoverGoals(Table):
    """Hover points and progress of n episodes."""

    pad_m: Array
    """(n, 3) Centres of the landing pads in the world [m]."""
    hover_m: Array
    """(n, 3) Points above the pad at which to hover, in the world [m]."""
    impact_m_s: Array
    """(n,) Largest downward speeds at the ground since the start, of all touchdowns [m/s]."""
    rest_from_s: Array
    """(n,) Times from which on the vehicles stand at rest after the hover; infinite for others [s]."""
    landed: Mask
    """(n,) Whether the vehicles have landed softly on the pad."""


@dataclass(frozen=True)
class VioHover(BaseTask):
    """Take off, hover for 60 s and land, flown on visual-inertial odometry: ``dronevio/VioHover-v0``.

    ## Description
    The quadrotor stands on the landing pad of the furnished room. The goal rises to a point 1.2 m above the pad, stays
    there for 60 s, and descends again. Observations and inner control loops use the estimate of a visual-inertial
    odometry with one camera, which receives its frames with latency; rewards, ends and success use the true state. The
    drift of the estimate is therefore a drift of the vehicle. `dronevio.sim.envs.sensing.estimation` describes how the
    estimator is simulated, and how another one is chosen.

    ## Action space
    ``Box(-1, 1, (4,), float32)``. By default velocity and yaw rate (mode ``velocity``);
    `dronevio.sim.envs.episodes.actions` describes all modes and their units.

    ## Observation space
    A ``Dict`` of ``Box`` with these entries by default; `dronevio.sim.envs.sensing.observations` describes all that can
    be chosen.

    | key | shape | content |
    |---|---|---|
    | ``goals`` | (1, 3) float32 | goal relative to the vehicle, in its frame, by the estimate [m] |
    | ``rotation`` | (3, 3) float32 | rotation matrix, vehicle to world, by the estimate |
    | ``body_velocity`` | (3,) float32 | velocity in the vehicle frame, by the estimate [m/s] |
    | ``last_action`` | (4,) float32 | action of the last step |

    ## Rewards
    The sum of these terms per step, which are in ``info["reward_terms"]``. With the true distance d from the goal, the
    true angular velocity ω, the change Δa of the action and the standard deviation σ of the estimated position:

    - ``closeness``: exp(−d / 0.5 m − |ω| / 5 rad/s)
    - ``smoothness``: −0.01 · mean of Δa²
    - ``uncertainty``: −w · σ / 1 m with the weight w = 0 (``uncertainty``)
    - ``landed``: 100 for a successful landing
    - ``failure``: −100 if the episode ends by a failure

    ## Starting state
    Standing on the pad with standing rotors, heading along x. The reset includes the time until the estimator has
    initialized.

    ## Episode end
    Terminated with success when the vehicle has stood at rest for 0.5 s after the hover, within 0.2 m of the centre of
    the pad, and no touchdown of the episode was faster than 0.6 m/s. Terminated by any contact but that of the feet
    with the ground, outside the free space of the world, if the vehicle tilts by more than 90°, and in the first step
    if the estimator has not initialized. Truncated after 80 s, 4000 steps.

    ## Arguments
    `dronevio.sim.envs.single.DroneEnv` describes the arguments that all environments have. Those of this task are the
    fields of this class: ``gymnasium.make("dronevio/VioHover-v0", task=VioHover(hover_s=10.0))``.

    ## Version history
    - v0: initial version.
    """

    default_observations: ClassVar[tuple[str, ...]] = ("goals", "rotation", "body_velocity", "last_action")
    """Names of the default observations."""
    default_action: ClassVar[str] = "velocity"
    """Name of the default action mode."""
    lands: ClassVar[bool] = True
    """Whether standing on the ground is part of the task."""

    world: str = "room"
    """Name of the world."""
    episode_s: Annotated[float, Range(0.1, 1e5)] = 80.0
    """Time limit of an episode [s]."""
    height_m: Annotated[float, Range(above=0.0, high=100.0)] = 1.2
    """Height of the hover point above the landing pad [m]."""
    hover_s: Annotated[float, Range(0.0, 1e5)] = 60.0
    """Duration of the hover [s]."""
    climb_m_s: Annotated[float, Range(above=0.0, high=100.0)] = 0.5
    """Speed at which the goal rises [m/s]."""
    descent_m_s: Annotated[float, Range(above=0.0, high=100.0)] = 0.3
    """Speed at which the goal descends [m/s]."""
    tolerance_m: Annotated[float, Range(above=0.0, high=100.0)] = 0.2
    """Largest horizontal distance from the centre of the pad at which a landing is a success [m]."""
    impact_m_s: Annotated[float, Range(above=0.0, high=100.0)] = 0.6
    """Largest downward speed of a touchdown in an episode that is a success [m/s]."""
    distance_scale_m: Annotated[float, Range(above=0.0, high=1e3)] = 0.5
    """Distance at which the closeness has decreased by the factor e [m]."""
    rate_scale_rad_s: Annotated[float, Range(above=0.0, high=1e3)] = 5.0
    """Angular velocity at which the closeness has decreased by the factor e [rad/s]."""
    smoothness: Annotated[float, Range(0.0, 1e3)] = 0.01
    """Weight of the mean squared change of the action."""
    uncertainty: Annotated[float, Range(0.0, 1e3)] = 0.0
    """Weight of the standard deviation of the estimated position [1/m]."""
    landed: Annotated[float, Range(0.0, 1e4)] = 100.0
    """Reward of a successful landing."""
    failure: Annotated[float, Range(0.0, 1e4)] = 100.0
    """Penalty of a failure."""
    obstacles: bool = False
    """Whether the obstacles of the world are part of the physics; there are none in the free space of a world."""

    @property
    def descent_from_s(self) -> float:
        """Time from the start of an episode at which the goal begins to descend [s]."""
        return self.height_m / self.climb_m_s + self.hover_s

    def begin(
        self, area: FlightArea, quadrotor: Quadrotor, rng: np.random.Generator, count: int
    ) -> tuple[VehicleStates, VioHoverGoals]:
        """Return vehicles on the pad."""
        pad = np.tile(area.pad, (count, 1))
        hover = pad + [0.0, 0.0, self.height_m]
        never = np.full(count, np.inf)
        states = VehicleStates.at(pad, rotors=quadrotor.rotor_count)
        return states, VioHoverGoals(pad, hover, np.zeros(count), never, np.zeros(count, dtype=np.bool_))

    def objective(self, goals: VioHoverGoals, t_s: Array) -> Objective:
        """Return the goals at times (n,) since the start [s]."""
        return Objective.of(self._goal_m(goals, t_s)[:, None])

    def advance(self, goals: VioHoverGoals, step: Transition) -> VioHoverGoals:
        """Record touchdowns and landings."""
        on_ground = step.after.position_m[:, 2] - goals.pad_m[:, 2] < step.standing_m + _ON_GROUND_M
        # each touchdown counts, also after a hop that is lower than this height
        impact = np.maximum(goals.impact_m_s, np.where(on_ground, -step.before.velocity_m_s[:, 2], 0.0))
        at_rest = on_ground & (np.linalg.norm(step.after.velocity_m_s, axis=1) < _AT_REST_M_S)
        at_rest &= step.t_s > self.descent_from_s
        rest_from_s = np.where(at_rest, np.minimum(goals.rest_from_s, step.t_s), np.inf)
        aside = np.linalg.norm(step.after.position_m[:, :2] - goals.pad_m[:, :2], axis=1)
        softly = (aside < self.tolerance_m) & (impact <= self.impact_m_s)
        return replace(
            goals,
            impact_m_s=impact,
            rest_from_s=rest_from_s,
            landed=goals.landed | (softly & (step.t_s - rest_from_s >= _AT_REST_S)),
        )

    def reward_terms(self, before: VioHoverGoals, goals: VioHoverGoals, step: Transition) -> dict[str, Array]:
        """Return the terms of the reward."""
        goal_m = self._goal_m(goals, step.t_s)
        goal_m[:, 2] = np.maximum(goal_m[:, 2], goals.pad_m[:, 2] + step.standing_m)
        return {
            "closeness": closeness(step.after, goal_m, self.distance_scale_m, self.rate_scale_rad_s),
            "smoothness": -self.smoothness * action_change(step),
            "uncertainty": np.broadcast_to(-self.uncertainty * step.position_sigma_m, step.t_s.shape),
            "landed": weighted(self.landed, goals.landed & ~before.landed & ~step.failed),
            "failure": weighted(-self.failure, step.failed),
        }

    def success(self, goals: VioHoverGoals, step: Transition) -> Mask:
        """Return which vehicles have landed."""
        return goals.landed

    def with_goal(self, goals: VioHoverGoals, goal_m: Array) -> VioHoverGoals:
        """Return goals with given hover points (n, 3) [m]."""
        return replace(goals, hover_m=goal_m)

    def _goal_m(self, goals: VioHoverGoals, t_s: Array) -> Array:
        """Return the goals (n, 3) at times (n,) since the start [m]."""
        goal = goals.hover_m.copy()
        climbed = goals.pad_m[:, 2] + self.climb_m_s * t_s
        descended = goal[:, 2] - self.descent_m_s * np.maximum(t_s - self.descent_from_s, 0.0)
        goal[:, 2] = np.maximum(np.minimum(climbed, descended), goals.pad_m[:, 2] - _BELOW_PAD_M)
        return goal
