"""Task Race: fly laps of a course of gates."""

from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array, Mask
from dronevio.models.errors import ConfigError
from dronevio.models.quadrotor import Quadrotor
from dronevio.models.ranges import Range
from dronevio.sim.envs.tasks.task import BaseTask, Objective, Start, Transition, penalties, weighted
from dronevio.sim.paths.space import FlightArea
from dronevio.sim.physics.vehicle_states import Table, VehicleStates

_START = Start(position_m=0.3)
_START_HEIGHT_M = 1.5  # above the landing pad
_BEHIND_M = 2.0  # distance behind a gate at which episodes start on the course
_MARGIN_M = 0.1  # between the centre of the vehicle and the frame of a gate
_AHEAD = 2  # observed gates: the current one and the next


@dataclass(frozen=True, eq=False)
class RaceGoals(Table):
    """Progress of n episodes on the course."""

    first: npt.NDArray[np.int64]
    """(n,) Indices of the first gates of the episodes."""
    passed: npt.NDArray[np.int64]
    """(n,) Numbers of gates that have been passed."""
    total: npt.NDArray[np.int64]
    """(n,) Numbers of gates to pass."""
    middle_m: Array
    """(n, G, 3) Centres of all gates in the world [m]."""
    ahead: Array
    """(n, G, 3) Unit normals of the gates, in the direction of flight."""
    opening_m: Array
    """(n, G) Width and height of the gates [m]."""


@dataclass(frozen=True)
class Race(BaseTask):
    """Fly three laps through the gates of a race course: ``dronevio/Race-v0``.

    ## Description
    Ten gates stand on a field of 44 × 29 m in the world ``gates``, whose seed determines their positions, heights and
    openings of 1.9 to 2.4 m. A gate counts when the centre of the vehicle crosses the plane of its opening in
    the direction of the course, 10 cm or more from the frame. Gates have to be passed in order. Frames and objects
    beside the course are obstacles.

    ## Action space
    ``Box(-1, 1, (4,), float32)``. By default collective thrust and body rates (mode ``rates``);
    `dronevio.sim.envs.episodes.actions` describes all modes and their units.

    ## Observation space
    A ``Dict`` of ``Box`` with these entries by default; `dronevio.sim.envs.sensing.observations` describes all that can
    be chosen.

    | key | shape | content |
    |---|---|---|
    | ``gates`` | (2, 4, 3) float32 | corners of the openings of the next two gates relative to the vehicle, in its \
frame [m] |
    | ``rotation`` | (3, 3) float32 | rotation matrix, vehicle to world |
    | ``body_velocity`` | (3,) float32 | velocity in the vehicle frame [m/s] |
    | ``rate`` | (3,) float32 | angular velocity in the vehicle frame [rad/s] |
    | ``last_action`` | (4,) float32 | action of the last step |

    ## Rewards
    The sum of these terms per step, which are in ``info["reward_terms"]``:

    - ``progress``: 1 per metre of approach to the current gate, at most 0.1 m per step, which is 5 m/s: a faster flight
      is not rewarded, since it fails more often. The distance from a gate is √(a² + 2 c²), a along its axis and c
      across it, so that the shortest way ends on the axis
    - ``passed``: 3 for each gate that is passed
    - ``rate``: −0.01 per rad/s of angular velocity
    - ``smoothness``: −0.02 · mean of the squared change of the action
    - ``failure``: −5 if the episode ends by a failure

    ## Starting state
    Half of the episodes start above the landing pad before the first gate, the others 2 m behind a random gate with the
    next one ahead; ``on_course`` is the fraction of the latter. The deviations are uniform: position within ±0.3 m,
    velocity within ±0.5 m/s, rotation vector within ±0.2 rad and angular velocity within ±0.5 rad/s, each on each axis
    (``start``). All episodes have the same number of gates to pass.

    ## Episode end
    Terminated with success when all gates of all laps are passed. Terminated by a contact with ground or obstacles,
    outside the field, and if the vehicle tilts by more than 90°. Truncated after 90 s, 4500 steps.

    ## Arguments
    `dronevio.sim.envs.single.DroneEnv` describes the arguments that all environments have; ``world_seed`` selects the
    course. Those of this task are the fields of this class: ``gymnasium.make("dronevio/Race-v0", task=Race(laps=1))``.

    ## Version history
    - v0: initial version.
    """

    default_observations: ClassVar[tuple[str, ...]] = ("gates", "rotation", "body_velocity", "rate", "last_action")
    """Names of the default observations."""
    default_action: ClassVar[str] = "rates"
    """Name of the default action mode."""

    world: str = "gates"
    """Name of the world, which must have gates."""
    episode_s: Annotated[float, Range(0.1, 1e5)] = 90.0
    """Time limit of an episode [s]."""
    laps: Annotated[int, Range(1, 1000)] = 3
    """Number of laps."""
    on_course: Annotated[float, Range(0.0, 1.0)] = 0.5
    """Fraction of the episodes that start behind a random gate instead of above the landing pad."""
    start: Start = _START
    """Spread of the starting states."""
    progress: Annotated[float, Range(0.0, 1e3)] = 1.0
    """Reward of a metre of approach [1/m]."""
    approach_m: Annotated[float, Range(0.0, 10.0)] = 0.1
    """Largest approach in a step that is rewarded [m]."""
    across: Annotated[float, Range(0.0, 1e3)] = 2.0
    """Weight of squared distances across the axis of a gate relative to those along it."""
    passed: Annotated[float, Range(0.0, 1e4)] = 3.0
    """Reward of a gate that is passed."""
    rate: Annotated[float, Range(0.0, 1e3)] = 0.01
    """Weight of the angular velocity [s/rad]."""
    smoothness: Annotated[float, Range(0.0, 1e3)] = 0.02
    """Weight of the mean squared change of the action."""
    failure: Annotated[float, Range(0.0, 1e4)] = 5.0
    """Penalty of a failure."""
    obstacles: bool = True
    """Whether gates and other obstacles are part of the physics."""

    def bounds_m(self, area: FlightArea) -> Array:
        """Return the bounds (2, 3) of the field [m]."""
        return np.stack([area.space.low, area.space.high])

    def begin(
        self, area: FlightArea, quadrotor: Quadrotor, rng: np.random.Generator, count: int
    ) -> tuple[VehicleStates, RaceGoals]:
        """Draw initial states on the course."""
        middles, ahead, openings = _course(area)
        on_course = rng.random(count) < self.on_course
        behind = rng.integers(0, len(middles), count)
        pad = area.pad + [0.0, 0.0, _START_HEIGHT_M]
        place = np.where(on_course[:, None], middles[behind] + _BEHIND_M * ahead[behind], pad)
        first = np.where(on_course, (behind + 1) % len(middles), 0)
        heading = middles[first] - place
        states = self.start.states(place, quadrotor, rng, np.arctan2(heading[:, 1], heading[:, 0]))
        total = np.full(count, self.laps * len(middles), dtype=np.int64)
        course = (np.tile(part, (count, *[1] * part.ndim)) for part in (middles, ahead, openings))
        return states, RaceGoals(first, np.zeros(count, dtype=np.int64), total, *course)

    def objective(self, goals: RaceGoals, t_s: Array) -> Objective:
        """Return the current and the next gate."""
        index = (goals.first + goals.passed)[:, None] + np.arange(_AHEAD)
        gates = np.arange(len(index))[:, None], index % goals.middle_m.shape[1]
        return Objective(goals.middle_m[gates], goals.ahead[gates], goals.opening_m[gates])

    def advance(self, goals: RaceGoals, step: Transition) -> RaceGoals:
        """Count the gates that are passed."""
        objective = self.objective(goals, step.t_s)
        middle, ahead = objective.position_m[:, 0], objective.direction[:, 0]
        from_before = np.vecdot(step.before.position_m - middle, ahead)
        from_after = np.vecdot(step.after.position_m - middle, ahead)
        crossed = (from_before < 0.0) & (from_after >= 0.0)
        share = from_before / np.where(crossed, from_before - from_after, 1.0)
        at = step.before.position_m + share[:, None] * (step.after.position_m - step.before.position_m) - middle
        beside = np.abs(at[:, 0] * ahead[:, 1] - at[:, 1] * ahead[:, 0])
        reach = 0.5 * objective.size_m[:, 0] - _MARGIN_M
        passed = crossed & (beside < reach) & (np.abs(at[:, 2]) < reach)
        return replace(goals, passed=goals.passed + passed)

    def reward_terms(self, before: RaceGoals, goals: RaceGoals, step: Transition) -> dict[str, Array]:
        """Return the terms of the reward."""
        gate = self.objective(before, step.t_s)
        approach_m = self._distance_m(step.before, gate) - self._distance_m(step.after, gate)
        return {
            "progress": self.progress * np.minimum(approach_m, self.approach_m),
            "passed": weighted(self.passed, goals.passed - before.passed),
            **penalties(step, self.rate, self.smoothness, self.failure),
        }

    def _distance_m(self, states: VehicleStates, gate: Objective) -> Array:
        """Return the distances (n,) of vehicles from the first gates, with a weight on those across their axes [m].

        The steepest descent of this distance is a curve on which the distance across the axis is proportional to a
        power of that along the axis, whose exponent is the weight. Above 1, the curve is tangential to the axis.
        """
        offset = states.position_m - gate.position_m[:, 0]
        along = np.vecdot(offset, gate.direction[:, 0])
        return np.asarray(np.sqrt(self.across * (np.vecdot(offset, offset) - along**2) + along**2))

    def success(self, goals: RaceGoals, step: Transition) -> Mask:
        """Return where all laps are complete."""
        return goals.passed >= goals.total

    def with_goal(self, goals: RaceGoals, goal_m: Array) -> RaceGoals:
        """Raise ConfigError, since the course has no other goals."""
        raise ConfigError("a goal for the task Race; expected none, since the gates of the world are its goals")


def _course(area: FlightArea) -> tuple[Array, Array, Array]:
    """Return centres (G, 3), directions (G, 3) and openings (G,) of the gates.

    Raises:
        ConfigError: The world has no gates.
    """
    if not area.gates:
        raise ConfigError("the task Race in a world without gates; expected the world 'gates'")
    gates = area.gates
    return (
        np.stack([gate.middle for gate in gates]),
        np.stack([gate.ahead for gate in gates]),
        np.array([gate.opening_m for gate in gates]),
    )
