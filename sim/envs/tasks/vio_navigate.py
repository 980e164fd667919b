"""Task VioNavigate: take off and reach a goal among obstacles, flown on an estimate of the state."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.quadrotor import Quadrotor
from dronevio.models.ranges import Range
from dronevio.models.rotation import rotation_z
from dronevio.sim.envs.tasks.navigate import Navigate, drawn_goals
from dronevio.sim.envs.tasks.task import PointGoals, Transition
from dronevio.sim.paths.space import FlightArea
from dronevio.sim.physics.vehicle_states import VehicleStates


@dataclass(frozen=True)
class VioNavigate(Navigate):
    """Take off and reach a goal among obstacles, flown on visual-inertial odometry: ``dronevio/VioNavigate-v0``.

    ## Description
    The quadrotor stands on the landing pad of a furnished hall, heading to the goal, which is a random place with 0.6 m
    of clearance from all obstacles, 3 to 12 m away. It sees the obstacles in the depth image only. Observations and
    inner control loops use the estimate of a visual-inertial odometry with one camera, which receives its frames with
    latency; rewards, ends and success use the true state. `dronevio.sim.envs.sensing.estimation` describes how the
    estimator is simulated, and how another one is chosen.

    ## Action space
    ``Box(-1, 1, (4,), float32)``. By default velocity and yaw rate (mode ``velocity``);
    `dronevio.sim.envs.episodes.actions` describes all modes and their units.

    ## Observation space
    A ``Dict`` of ``Box`` with these entries by default; `dronevio.sim.envs.sensing.observations` describes all that can
    be chosen.

    | key | shape | content |
    |---|---|---|
    | ``depth`` | (64, 64, 1) float32 | depth along the optical axis of the forward camera, at most 20 m [m] |
    | ``goals`` | (1, 3) float32 | goal relative to the vehicle, in its frame, by the estimate [m] |
    | ``rotation`` | (3, 3) float32 | rotation matrix, vehicle to world, by the estimate |
    | ``body_velocity`` | (3,) float32 | velocity in the vehicle frame, by the estimate [m/s] |
    | ``last_action`` | (4,) float32 | action of the last step |

    ## Rewards
    The sum of these terms per step, which are in ``info["reward_terms"]``; all but ``uncertainty`` use the true state:

    - ``progress``: 1 per metre of approach to the goal
    - ``reached``: 10 for reaching the goal
    - ``rate``: −0.02 per rad/s of angular velocity
    - ``smoothness``: −0.02 · mean of the squared change of the action
    - ``failure``: −10 if the episode ends by a failure
    - ``uncertainty``: −0.02 per metre of standard deviation of the estimated position along its least certain axis

    ## Starting state
    Standing on the pad with standing rotors, heading to the goal. The reset includes the time until the estimator has
    initialized.

    ## Episode end
    Terminated with success within 0.5 m of the goal. Terminated by any contact but that of the feet with the ground,
    outside the bounds of the world, if the vehicle tilts by more than 90°, and in the first step if the estimator has
    not initialized. Truncated after 40 s, 2000 steps.

    ## Arguments
    `dronevio.sim.envs.single.DroneEnv` describes the arguments that all environments have; ``world`` and ``world_seed``
    select the obstacles. Those of this task are the fields of this class:
    ``gymnasium.make("dronevio/VioNavigate-v0", task=VioNavigate(distance_m=(3.0, 6.0)), world="room")``.

    ## Version history
    - v0: initial version.
    """

    lands: ClassVar[bool] = True
    """Whether standing on the ground is part of the task."""

    world: str = "hall"
    """Name of the world."""
    episode_s: Annotated[float, Range(0.1, 1e5)] = 40.0
    """Time limit of an episode [s]."""
    distance_m: Annotated[tuple[float, float], Range(above=0.0, high=1e3)] = (3.0, 12.0)
    """Smallest and largest distance from the pad to the goal [m]."""
    uncertainty: Annotated[float, Range(0.0, 1e3)] = 0.02
    """Weight of the standard deviation of the estimated position [1/m]."""

    def begin(
        self, area: FlightArea, quadrotor: Quadrotor, rng: np.random.Generator, count: int
    ) -> tuple[VehicleStates, PointGoals]:
        """Draw goals in free space, and return vehicles on the pad."""
        pad = np.tile(area.pad, (count, 1))
        goal = drawn_goals(self, area, pad, rng)
        heading = goal - pad
        R = rotation_z(np.arctan2(heading[:, 1], heading[:, 0]))
        return VehicleStates.at(pad, R, rotors=quadrotor.rotor_count), PointGoals(goal)

    def reward_terms(self, before: PointGoals, goals: PointGoals, step: Transition) -> dict[str, Array]:
        """Return the terms of the reward."""
        return {
            **super().reward_terms(before, goals, step),
            "uncertainty": np.broadcast_to(-self.uncertainty * step.position_sigma_m, step.t_s.shape),
        }
