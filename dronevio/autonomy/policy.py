"""A policy without learning for environments with a goal and a depth camera: map, plan, and track.

It receives what any policy receives, the observation: the depth image, the state, true or estimated, and the goal
relative to the vehicle. The frame of its map has the axes of the world and begins at the goal, so that rotation and
goal give the pose of the vehicle. Each plan leads along a path on which unknown space is taken as free, as far as it is
known to be free; the action follows the planned trajectory.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import atan2, hypot, pi, remainder
from typing import Any

import numpy as np
import numpy.typing as npt

from dronevio.autonomy.observed_map import ObservedMap
from dronevio.autonomy.pilot.map_route import MapRoute
from dronevio.autonomy.pilot.moment import Moment
from dronevio.autonomy.pilot.path_following import PathFollowing, is_blocked
from dronevio.autonomy.planning.known_space import LocalSpace, with_free_column
from dronevio.autonomy.planning.local_plan import (
    braking,
    sampled,
    straight,
)
from dronevio.autonomy.planning.trajectory import CorridorTrajectory
from dronevio.autonomy.policy_settings import PlannerSettings
from dronevio.estimator.threads import single_threaded
from dronevio.models.actions import ActionLimits
from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.occupancy import OccupancyGrid
from dronevio.models.rig import RigCamera
from dronevio.models.rotation import pose_matrix, yaw_rad_from_matrix
from dronevio.models.state import Estimate, Health

OBSERVATIONS = ("depth", "goals", "rotation", "body_velocity")
"""Names of the observations that the policy needs."""

_ROUTE_NS = 1_000_000_000  # between two routes
_AHEAD_M = 1.5  # along the path, where the vehicle looks
_SLOW_M_S = 0.5  # at which a plan that leads further is expected to be flown
_CHECK_S = 0.05  # between the points of a trajectory whose clearance is checked
_OFF_M = 0.4  # between vehicle and trajectory, from where on a plan begins at the vehicle
_CLIMB_M_S = 0.6
_FREE_BELOW_M = 0.4  # depth and height of the space around a start in the air that is free


@dataclass(frozen=True, eq=False)
class _Reference:
    """What is flown: a trajectory from a time on, and a heading."""

    trajectory: CorridorTrajectory
    begins_s: float
    yaw_rad: float

    def state(self, t_s: float) -> Array:
        """Return position, velocity, acceleration and jerk (4, 3) at a time [s]."""
        state = self.trajectory.state(t_s - self.begins_s)
        if t_s - self.begins_s >= self.trajectory.duration_s:
            state[1:] = 0.0
        return state


class PlannerPolicy:
    """Flies one vehicle to its goal by map and plans; `reset` begins an episode.

    Example:
        >>> env = gymnasium.make("dronevio.envs:dronevio/Navigate-v0")
        >>> policy = PlannerPolicy.of(env.unwrapped.settings)
        >>> observation, _ = env.reset(seed=0)
        >>> observation, *_ = env.step(policy.action(observation))
    """

    def __init__(
        self,
        camera: RigCamera,
        T_vehicle_imu: Array,
        action_rate_hz: float,
        *,
        takes_off: bool = False,
        action_limits: ActionLimits | None = None,
        settings: PlannerSettings | None = None,
    ) -> None:
        """Define vehicle and rates.

        Args:
            camera: The camera that observes depth.
            T_vehicle_imu: (4, 4) Mounting of the IMU.
            action_rate_hz: Rate of the actions [Hz].
            takes_off: Whether episodes begin on the ground.
            action_limits: Velocities of actions of ±1 in the mode ``velocity``; the defaults by default.
            settings: Settings.
        """
        self._camera, self._T_vehicle_imu, self._rate_hz = camera, T_vehicle_imu, action_rate_hz
        self._takes_off, self._limits = takes_off, action_limits or ActionLimits()
        self._settings = settings or PlannerSettings()
        self.decisions: list[tuple[float, str]] = []
        self.reset()

    @classmethod
    def of(cls, environment: Any, settings: PlannerSettings | None = None) -> "PlannerPolicy":
        """Return the policy for environments with some `EnvironmentSettings`: cameras, rates and limits of actions.

        Raises:
            ConfigError: The environment has other actions than velocities, or lacks an observation.
        """
        missing = [name for name in OBSERVATIONS if name not in environment.policy_names]
        if missing or environment.action != "velocity":
            raise ConfigError(
                f"planner in an environment with the action mode {environment.action!r} and the observations"
                f" {', '.join(environment.policy_names)}; expected 'velocity' and {', '.join(OBSERVATIONS)}"
            )
        return cls(
            environment.rig.cameras[environment.camera],
            environment.rig.T_vehicle_imu,
            environment.action_rate_hz,
            takes_off=environment.task.lands,
            action_limits=environment.action_limits,
            settings=settings,
        )

    def reset(self) -> None:
        """Begin an episode."""
        c = self._settings
        self.decisions.clear()
        self._map = ObservedMap(self._camera, self._T_vehicle_imu, c.cell_m, c.range_m)
        self._route = MapRoute(_ROUTE_NS, self._say)
        self._steps = 0
        self._start: Array | None = None
        self._reference: _Reference | None = None
        self._departs_s = self._map_due_s = self._plan_due_s = 0.0
        self._following = PathFollowing(c.limits)

    def action(self, observation: Mapping[str, npt.ArrayLike]) -> npt.NDArray[np.float32]:
        """Return the action (4,) of the mode ``velocity`` for the next observation of the episode.

        Args:
            observation: ``depth`` (H, W, 1), ``goals`` (K, 3), ``rotation`` (3, 3) and ``body_velocity`` (3,).
        """
        c, t_s = self._settings, self._steps / self._rate_hz
        R = np.asarray(observation["rotation"], np.float64)
        position = -R @ np.asarray(observation["goals"], np.float64)[0]
        velocity = R @ np.asarray(observation["body_velocity"], np.float64)
        yaw = float(yaw_rad_from_matrix(R))
        if self._reference is None:
            self._begin(position, velocity, yaw)
        # What is late by less than half a step is due
        now_s = t_s + 0.5 / self._rate_hz
        image = np.asarray(observation["depth"], np.float32)
        with single_threaded():
            pose = pose_matrix(R, position)
            if now_s >= self._map_due_s and not self._map.is_held(image, pose):
                self._map.add(image, pose)
                self._map_due_s = t_s + 1.0 / c.map_rate_hz
            if now_s >= max(self._plan_due_s, self._departs_s):
                self._decide(self._moment(t_s, position, velocity, yaw))
                self._plan_due_s = t_s + 1.0 / c.plan_rate_hz
        self._steps += 1
        return self._tracking(t_s + 1.0 / self._rate_hz, position, yaw)

    def _begin(self, position: Array, velocity: Array, yaw: float) -> None:
        """Take off, or brake."""
        c = self._settings
        trajectory = braking(np.stack([position, velocity, np.zeros(3), np.zeros(3)]), c.limits)
        self._start = position
        if self._takes_off:
            trajectory = straight(position, position + [0.0, 0.0, c.take_off_m], _CLIMB_M_S)
            self._departs_s = trajectory.duration_s
        self._following.begin(round(1e9 * self._departs_s))
        self._reference = _Reference(trajectory, 0.0, yaw)

    def _moment(self, t_s: float, position: Array, velocity: Array, yaw: float) -> Moment:
        """Return what is known now."""
        assert self._reference is not None
        start = self._reference.state(t_s)
        if np.linalg.norm(start[0] - position) > _OFF_M:
            start = np.stack([position, velocity, np.zeros(3), np.zeros(3)])
        grid, t_ns = self._with_start(self._map.around(start[0])), round(1e9 * t_s)
        unmoved, estimate = np.eye(4), Estimate(t_ns, Health.TRACKING, None)
        return Moment(t_ns, t_ns, start, yaw, 0.0, self._settings.body, grid, unmoved, unmoved, estimate)

    def _with_start(self, grid: OccupancyGrid) -> OccupancyGrid:
        """Return a grid in which what is unknown around the start is free."""
        c = self._settings
        assert self._start is not None
        top_m = 2.0 * _FREE_BELOW_M + (c.take_off_m if self._takes_off else 0.0)
        return with_free_column(grid, self._start - [0.0, 0.0, _FREE_BELOW_M], c.start_radius_m, top_m)

    def _heights(self) -> Array:
        """Return the least and the greatest height (2,) of paths [m]."""
        c = self._settings
        assert self._start is not None
        start_m = float(self._start[2]) + (c.take_off_m if self._takes_off else 0.0)
        return np.array([min(start_m, 0.0) - c.below_m, max(start_m, 0.0) + c.above_m])

    def _decide(self, m: Moment) -> None:
        """Decide what is flown from now on."""
        assert m.grid is not None
        space = LocalSpace.of(m.grid, m.body, m.position_m, self._heights())
        path = self._route.path(m, self._known, np.zeros(3), self._heights())
        if path is None:
            self._say("no path: hold")
            self._follow(m, self._following.halt(m, space), m.yaw_rad)
            return
        self._fly_along(m, space, sampled(path, m.position_m, self._settings.horizon_m))

    def _known(self) -> OccupancyGrid | None:
        """Return the whole map with the start."""
        known = self._map.known
        return None if known is None else self._with_start(known)

    def _fly_along(self, m: Moment, space: LocalSpace, ahead: Array) -> None:
        """Fly along a path (N, 3) as far as it is known to be free, after a turn toward it."""
        c, t_s = self._settings, m.now_ns * 1e-9
        look = ahead[min(round(_AHEAD_M / 0.1), len(ahead) - 1)] - m.position_m
        assert self._reference is not None
        yaw = atan2(look[1], look[0]) if hypot(look[0], look[1]) > 0.3 else self._reference.yaw_rad
        step = self._following.step(m, space, ahead, self._rest(t_s), yaw - m.yaw_rad)
        if step.what is None or step.trajectory is None:
            return
        self._say(step.what)
        if step.what == "fly" and self._is_kept(m, space, step.trajectory):
            self._reference = replace(self._reference, yaw_rad=yaw)
        else:
            self._follow(m, step.trajectory, yaw)
        if step.is_stuck:
            self._route.give_up(m, c.body, ahead)
            self._following.wait(m.now_ns)

    def _is_kept(self, m: Moment, space: LocalSpace, newer: CorridorTrajectory) -> bool:
        """Return whether what is flown is still clear, and a newer plan leads on more slowly."""
        assert self._reference is not None
        flown, t_s = self._reference, m.now_ns * 1e-9
        remaining_s = flown.begins_s + flown.trajectory.duration_s - t_s
        further_m = np.linalg.norm(newer.control_points[-1, -1] - flown.trajectory.control_points[-1, -1])
        is_slower = newer.duration_s > remaining_s + float(further_m) / _SLOW_M_S
        return remaining_s > 0.0 and is_slower and not is_blocked(m, space, self._rest(t_s))

    def _rest(self, t_s: float) -> Array:
        """Return the points (N, 3) of what is still to be flown [m]."""
        assert self._reference is not None
        trajectory, begun_s = self._reference.trajectory, t_s - self._reference.begins_s
        times = np.arange(begun_s, trajectory.duration_s + _CHECK_S, _CHECK_S)
        return np.asarray(trajectory.path(np.clip(times, 0.0, trajectory.duration_s))).reshape(-1, 3)

    def _follow(self, m: Moment, trajectory: CorridorTrajectory, yaw: float) -> None:
        """Follow a trajectory with a heading from now on."""
        self._reference = _Reference(trajectory, m.now_ns * 1e-9, yaw)

    def _tracking(self, t_s: float, position: Array, yaw: float) -> npt.NDArray[np.float32]:
        """Return the action (4,) that follows the reference, as it will be at a time [s]."""
        c, limits = self._settings, self._limits
        assert self._reference is not None
        wanted = self._reference.state(t_s)
        velocity = wanted[1] + c.gain_per_s * (wanted[0] - position)
        ahead = np.array([np.cos(yaw), np.sin(yaw)])
        forward, left = float(ahead @ velocity[:2]), float(ahead[0] * velocity[1] - ahead[1] * velocity[0])
        turn = c.gain_per_s * remainder(self._reference.yaw_rad - yaw, 2.0 * pi)
        rate = float(np.clip(turn, -c.limits.yaw_rate_rad_s, c.limits.yaw_rate_rad_s))
        moved = np.array([forward, left, velocity[2]]) / limits.velocity_m_s
        return np.asarray(np.clip(np.append(moved, rate / limits.yaw_rate_rad_s), -1.0, 1.0), np.float32)

    def _say(self, what: str) -> None:
        """Record a decision, unless it is the last one again."""
        if not self.decisions or self.decisions[-1][1] != what:
            self.decisions.append((self._steps / self._rate_hz, what))
