"""Task Track: follow a moving reference."""

from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array, Mask
from dronevio.models.errors import ConfigError
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
    flight_box_m,
)
from dronevio.sim.paths.space import FlightArea
from dronevio.sim.physics.vehicle_states import Table, VehicleStates

_START = Start(position_m=0.3, velocity_m_s=0.3)
_MARGIN_M = 0.5  # of the reference from the bounds
_AHEAD, _SPACING_S = 5, 0.1  # observed positions of the reference, now and later


@dataclass(frozen=True, eq=False)
class TrackGoals(Table):
    """References of n episodes: one sinusoid for each axis, and the errors so far."""

    centre_m: Array
    """(n, 3) Centres of the curves in the world [m]."""
    amplitude_m: Array
    """(n, 3) Amplitudes along the axes [m]."""
    frequency_rad_s: Array
    """(n, 3) Angular frequencies [rad/s]."""
    phase_rad: Array
    """(n, 3) Phases at the start [rad]."""
    summed_m: Array
    """(n,) Sums of the distances from the reference over all steps [m]."""
    steps: npt.NDArray[np.int64]
    """(n,) Numbers of steps."""

    def position_m(self, t_s: Array) -> Array:
        """Return the positions (n, K, 3) of the references at times (n, K) [s]."""
        phase = self.frequency_rad_s[:, None] * t_s[..., None] + self.phase_rad[:, None]
        return np.asarray(self.centre_m[:, None] + self.amplitude_m[:, None] * np.sin(phase))

    def initial_velocity_m_s(self) -> Array:
        """Return the velocities (n, 3) of the references at the start [m/s]."""
        return np.asarray(self.amplitude_m * self.frequency_rad_s * np.cos(self.phase_rad))


@dataclass(frozen=True)
class Track(BaseTask):
    """Follow a reference that moves on a random Lissajous curve: ``dronevio/Track-v0``.

    ## Description
    The reference is a point that moves in the free space of the furnished room, sinusoidally along each axis with
    random amplitudes, phases and periods of 5 to 12 s. The quadrotor starts near it and has to follow it.

    ## Action space
    ``Box(-1, 1, (4,), float32)``. By default collective thrust and body rates (mode ``rates``);
    `dronevio.sim.envs.episodes.actions` describes all modes and their units.

    ## Observation space
    A ``Dict`` of ``Box`` with these entries by default; `dronevio.sim.envs.sensing.observations` describes all that can
    be chosen.

    | key | shape | content |
    |---|---|---|
    | ``goals`` | (5, 3) float32 | reference now and 0.1, 0.2, 0.3 and 0.4 s later, relative to the vehicle, in its \
frame [m] |
    | ``rotation`` | (3, 3) float32 | rotation matrix, vehicle to world |
    | ``body_velocity`` | (3,) float32 | velocity in the vehicle frame [m/s] |
    | ``rate`` | (3,) float32 | angular velocity in the vehicle frame [rad/s] |
    | ``last_action`` | (4,) float32 | action of the last step |

    ## Rewards
    The sum of two terms per step, which are in ``info["reward_terms"]``. With the distance d from the reference, the
    angular velocity ω and the change Δa of the action:

    - ``closeness``: exp(−d / 0.3 m − |ω| / 10 rad/s)
    - ``smoothness``: −0.01 · mean of Δa²

    ## Starting state
    Around the reference, with its velocity. The deviations are uniform: position within ±0.3 m, velocity within
    ±0.3 m/s, rotation vector within ±0.2 rad and angular velocity within ±0.5 rad/s, each on each axis (``start``).

    ## Episode end
    Terminated by a contact with the floor, outside the free space of the world, and if the vehicle tilts by more than
    90°. Truncated after 15 s, 750 steps. ``info["success"]`` tells whether the mean distance since the start is below
    0.2 m.

    ## Arguments
    `dronevio.sim.envs.single.DroneEnv` describes the arguments that all environments have. Those of this task are the
    fields of this class: ``gymnasium.make("dronevio/Track-v0", task=Track(period_s=(3.0, 6.0)))``.

    ## Version history
    - v0: initial version.
    """

    default_observations: ClassVar[tuple[str, ...]] = ("goals", "rotation", "body_velocity", "rate", "last_action")
    """Names of the default observations."""
    default_action: ClassVar[str] = "rates"
    """Name of the default action mode."""
    ends_with_success: ClassVar[bool] = False
    """Whether a success ends the episode."""

    world: str = "room"
    """Name of the world."""
    episode_s: Annotated[float, Range(0.1, 1e5)] = 15.0
    """Time limit of an episode [s]."""
    period_s: Annotated[tuple[float, float], Range(0.1, 1e4)] = (5.0, 12.0)
    """Shortest and longest period of an axis [s]."""
    extent: Annotated[tuple[float, float], Range(0.0, 1.0)] = (0.3, 0.9)
    """Smallest and largest amplitude relative to that which fits into the free space."""
    start: Start = _START
    """Spread of the starting states around the reference."""
    tolerance_m: Annotated[float, Range(above=0.0, high=100.0)] = 0.2
    """Largest mean distance from the reference for a success [m]."""
    distance_scale_m: Annotated[float, Range(above=0.0, high=1e3)] = 0.3
    """Distance at which the closeness has decreased by the factor e [m]."""
    rate_scale_rad_s: Annotated[float, Range(above=0.0, high=1e3)] = 10.0
    """Angular velocity at which the closeness has decreased by the factor e [rad/s]."""
    smoothness: Annotated[float, Range(0.0, 1e3)] = 0.01
    """Weight of the mean squared change of the action."""
    obstacles: bool = False
    """Whether the obstacles of the world are part of the physics; there are none in the free space of a world."""

    def begin(
        self, area: FlightArea, quadrotor: Quadrotor, rng: np.random.Generator, count: int
    ) -> tuple[VehicleStates, TrackGoals]:
        """Draw references, and initial states around them."""
        box = flight_box_m(area, _MARGIN_M)
        goals = TrackGoals(
            centre_m=np.tile(box.mean(axis=0), (count, 1)),
            amplitude_m=rng.uniform(*self.extent, (count, 3)) * 0.5 * (box[1] - box[0]),
            frequency_rad_s=2.0 * np.pi / rng.uniform(*self.period_s, (count, 3)),
            phase_rad=rng.uniform(-np.pi, np.pi, (count, 3)),
            summed_m=np.zeros(count),
            steps=np.zeros(count, dtype=np.int64),
        )
        states = self.start.states(goals.position_m(np.zeros((count, 1)))[:, 0], quadrotor, rng)
        return replace(states, velocity_m_s=states.velocity_m_s + goals.initial_velocity_m_s()), goals

    def objective(self, goals: TrackGoals, t_s: Array) -> Objective:
        """Return the reference now and later."""
        return Objective.of(goals.position_m(t_s[:, None] + _SPACING_S * np.arange(_AHEAD)))

    def advance(self, goals: TrackGoals, step: Transition) -> TrackGoals:
        """Add the distance of this step."""
        distance = distance_m(step.after, goals.position_m(step.t_s[:, None])[:, 0])
        return replace(goals, summed_m=goals.summed_m + distance, steps=goals.steps + 1)

    def reward_terms(self, before: TrackGoals, goals: TrackGoals, step: Transition) -> dict[str, Array]:
        """Return closeness and smoothness."""
        reference = goals.position_m(step.t_s[:, None])[:, 0]
        return {
            "closeness": closeness(step.after, reference, self.distance_scale_m, self.rate_scale_rad_s),
            "smoothness": -self.smoothness * action_change(step),
        }

    def success(self, goals: TrackGoals, step: Transition) -> Mask:
        """Return where the mean distance is below the tolerance."""
        return goals.summed_m < self.tolerance_m * goals.steps

    def with_goal(self, goals: TrackGoals, goal_m: Array) -> TrackGoals:
        """Raise ConfigError, since the goal moves."""
        raise ConfigError("a goal for the task Track; expected none, since its reference moves")
