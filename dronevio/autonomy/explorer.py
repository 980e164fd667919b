"""Flights to a goal through unknown space: a pilot that maps, plans and decides while it flies.

The frames: the *world* is that of the simulator, in which the pad and the goal are given; the *odometry* frame is
continuous, and trajectories are planned in it; the *map* frame is corrected by loops, and holds goal and route. At the
start, map and odometry frame are the same. A correction moves goal and route in the odometry frame; the trajectory that
is flown stays until the next plan.
"""

import time
from dataclasses import dataclass, replace
from math import atan2, hypot, pi, radians
from typing import Literal

import numpy as np

from dronevio.autonomy.decided_course import DecidedCourse, Motion
from dronevio.autonomy.goal_path import path_to_goal
from dronevio.autonomy.heading import Turn
from dronevio.autonomy.local_plan import LocalSpace, sampled, slowed, stop, straight, trajectory_along
from dronevio.autonomy.route import NoRoute
from dronevio.autonomy.settings import ExploreSettings
from dronevio.autonomy.trajectory import CorridorTrajectory
from dronevio.estimator.mapping.config import DenseMapConfig
from dronevio.estimator.mapping.dense_mapper import DenseMapper
from dronevio.estimator.mapping.depth_source import DepthSource, depth_source
from dronevio.estimator.threads import single_threaded
from dronevio.models.arrays import Array
from dronevio.models.depth import DepthImage
from dronevio.models.imu import ImuSamples
from dronevio.models.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from dronevio.models.protocols import Controller
from dronevio.models.quadrotor import Quadrotor
from dronevio.models.rotation import inverse_pose, yaw_rad_from_matrix
from dronevio.models.state import CameraFrame, Estimate, Health
from dronevio.sim.paths.course import Course
from dronevio.sim.physics.controller import SE3Controller
from dronevio.sim.physics.plant import QuadrotorPlant
from dronevio.sim.scenario import Scenario
from dronevio.sim.world import flight_area

Outcome = Literal["reached", "covered", "unreachable", "lost", "collision", "timeout"]
"""How a flight ends."""

_CLIMB_M_S = 0.8
_LOOK_FROM_M, _LOOK_ABOVE_M = 0.5, 0.3  # heights of the turns after the take-off, above the ground and the hover
_YAW_ACCEL_RAD_S2 = 3.0
_AHEAD_M = 1.5  # along the route, where the vehicle looks
_ASKEW_RAD = radians(50.0)  # between heading and route, from where on the vehicle turns before it flies
_SLOW_M_S = 0.5  # while it turns
_NEAR_M = 0.25  # from the goal, where it is reached
_STOP_AFTER_NS = 300_000_000  # without depth
_LAND_AFTER_NS = 1_000_000_000
_ROUTE_NS = 1_000_000_000  # between two routes
_STUCK_NS = 2_000_000_000  # without progress, after which unseen space on the route is given up
_RETRIES = 2  # of what was given up, before the goal is unreachable
_SINK_M = 0.05  # by which the descent ends below the ground


@dataclass(frozen=True, eq=False)
class Decision:
    """What was decided, for people."""

    t_ns: int
    """Time on the clock of the course [ns]."""
    what: str
    """Text."""


class TimedDepth:
    """A source of depth images with the processor time of each; implements `DepthSource`."""

    def __init__(self, source: DepthSource) -> None:
        """Take a source."""
        self._source = source
        self.cpu_ms: list[float] = []

    def depth(self, frame: CameraFrame, estimate: Estimate) -> DepthImage | None:
        """Return the depth image that is known with a frame; None if there is none."""
        began = time.process_time()
        depth = self._source.depth(frame, estimate)
        self.cpu_ms.append(1e3 * (time.process_time() - began))
        return depth


class Explorer:
    """Flies to a goal through unknown space; implements `dronevio.sim.closed_loop.flight.Pilot`."""

    def __init__(
        self, goal: Array, longest_s: float, settings: ExploreSettings | None = None, source: DepthSource | None = None
    ) -> None:
        """Define a flight.

        Args:
            goal: (3,) Goal in the world [m].
            longest_s: Duration after which the flight ends [s].
            settings: Settings.
            source: Source of depth images; by default from the images of the rig.
        """
        self._source = source
        self._goal, self._longest_s, self._settings = goal, longest_s, settings or ExploreSettings()
        self.outcome: Outcome | None = None
        self.decisions: list[Decision] = []
        self.plan_ms: list[float] = []
        self.map_ms: list[float] = []
        self.route_map: Array | None = None
        self._given_up = np.zeros((0, 3))
        self._retries = _RETRIES
        self._newest: Estimate | None = None
        self._depth_ns = 0
        self._plan_due_ns = 0
        self._route_due_ns = 0
        self._progress_ns = 0
        self._ends_ns: int | None = None
        self._going = "goal"

    @property
    def finished(self) -> bool:
        """Whether the flight has ended."""
        return self._ends_ns is not None and self._course.now_ns >= self._ends_ns

    def course(self, scenario: Scenario, plant: QuadrotorPlant) -> Course:
        """Return the course, which begins with the take-off and a turn."""
        c = self._settings
        pad = flight_area(scenario.world, scenario.seed_of_world).pad
        self._stand = pad + [0.0, 0.0, plant.standing_height_m]
        hover = self._stand + [0.0, 0.0, c.height_m]
        self._course = course = DecidedCourse(self._stand, 0.0, plant.interval_ns, round(self._longest_s * 1e9))
        self._depth = TimedDepth(self._source or depth_source(scenario.rig))
        self._mapper = DenseMapper(scenario.rig, DenseMapConfig(), self._depth)
        begins_ns = round(scenario.plan.initial_rest_s * 1e9) // plant.interval_ns * plant.interval_ns
        # Climb, turn while rising and again while sinking: near space is seen from several heights.
        low, high = self._stand + [0.0, 0.0, _LOOK_FROM_M], hover + [0.0, 0.0, _LOOK_ABOVE_M]
        yaw = 0.0
        for start, end, is_turn in ((self._stand, low, False), (low, high, True), (high, hover, True)):
            turn = Turn(yaw, 0.0, 2.0 * pi if is_turn else 0.0, c.limits.yaw_rate_rad_s, _YAW_ACCEL_RAD_S2)
            trajectory = straight(start, end, _CLIMB_M_S)
            if is_turn:
                trajectory = slowed(trajectory, turn.duration_s)
            course.follow(Motion.of(trajectory, turn, max(begins_ns, course.decided_until_ns), plant.interval_ns))
            yaw += turn.angle_rad
        self._plan_due_ns = course.decided_until_ns
        return course

    def controller(self, course: Course, T_vehicle_imu: Array, quadrotor: Quadrotor) -> Controller:
        """Return the controller of the scenarios."""
        return SE3Controller(course, T_vehicle_imu, quadrotor)

    def add_imu(self, samples: ImuSamples) -> None:
        """Do nothing: the estimates contain what the samples tell."""

    def add_frame(self, frame: CameraFrame, estimate: Estimate, T_world_odom: Array | None) -> None:
        """Map a frame, and decide what is flown next."""
        now_ns = self._course.now_ns
        if T_world_odom is None:
            return
        before, began = len(self._depth.cpu_ms), time.process_time()
        with single_threaded():
            depth = self._mapper.add_frame(frame, estimate)
        if depth is not None:
            self._depth_ns = now_ns
            self.map_ms.append(1e3 * (time.process_time() - began) - sum(self._depth.cpu_ms[before:]))
        self._newest = estimate
        if self._ends_ns is None and now_ns >= self._plan_due_ns:
            began = time.process_time()
            self._decide(now_ns, estimate, T_world_odom)
            self.plan_ms.append(1e3 * (time.process_time() - began))
            self._plan_due_ns = now_ns + round(1e9 / self._settings.plan_rate_hz) - 1_000_000

    def _say(self, what: str) -> None:
        """Record a decision, unless it is the last one again."""
        if not self.decisions or self.decisions[-1].what != what:
            self.decisions.append(Decision(self._course.now_ns, what))

    def _decide(self, now_ns: int, estimate: Estimate, T_world_odom: Array) -> None:
        """Decide what is flown from the latency of a plan on."""
        c, course = self._settings, self._course
        begins_ns = now_ns + round(c.latency_s * 1e9) // course.interval_ns * course.interval_ns
        start_world, yaw, yaw_rate = course.planned(begins_ns)
        R = T_world_odom[:3, :3]
        T_odom_world = inverse_pose(T_world_odom)
        start = start_world @ R
        start[0] = T_odom_world[:3, :3] @ start_world[0] + T_odom_world[:3, 3]
        yaw_odom = yaw_rad_from_matrix(T_world_odom[:3, :3])
        without_ns = now_ns - self._depth_ns
        grid = self._local_grid(T_odom_world)

        def follow(trajectory: CorridorTrajectory, turn: Turn) -> None:
            points = trajectory.control_points @ R.T + T_world_odom[:3, 3]
            course.follow(Motion.of(replace(trajectory, control_points=points), turn, begins_ns, course.interval_ns))

        def turned(toward: float | None) -> Turn:
            if toward is None:
                return Turn(
                    yaw,
                    yaw_rate,
                    0.5 * yaw_rate * abs(yaw_rate) / _YAW_ACCEL_RAD_S2,
                    c.limits.yaw_rate_rad_s,
                    _YAW_ACCEL_RAD_S2,
                )
            return Turn.toward(yaw, yaw_rate, toward + yaw_odom, c.limits.yaw_rate_rad_s, _YAW_ACCEL_RAD_S2)

        # Without a valid estimate or depth: brake, then land.
        is_lost = estimate.health in (Health.LOST, Health.INITIALIZING) or estimate.track != 0 or grid is None
        if is_lost or without_ns > _LAND_AFTER_NS:
            if np.linalg.norm(start[1]) > 0.05:
                self._say("lost: brake" if is_lost else "no depth: brake")
                space = None if grid is None else LocalSpace.of(grid, c.body)
                follow(stop(space, start, c.body, c.limits) if space is not None else _brake(start, c), turned(None))
            else:
                self._say("lost: land" if is_lost else "no depth: land")
                self._land(start_world[0], yaw, begins_ns)
                self.outcome = "lost"
            return
        assert grid is not None
        space = LocalSpace.of(grid, c.body)
        if without_ns > _STOP_AFTER_NS:
            self._say("no depth: stop")
            follow(stop(space, start, c.body, c.limits), turned(None))
            return
        # The goal or, on the way home, the hover above the pad.
        T_map_odom = np.eye(4) if estimate.T_map_odom is None else estimate.T_map_odom
        home = T_odom_world[:3, :3] @ (self._stand + [0.0, 0.0, c.height_m]) + T_odom_world[:3, 3]
        goal = home if self._going == "home" else T_odom_world[:3, :3] @ self._goal + T_odom_world[:3, 3]
        T_odom_map = inverse_pose(T_map_odom)
        goal_odom = T_odom_map[:3, :3] @ goal + T_odom_map[:3, 3]
        state = estimate.state
        assert state is not None
        speed = float(np.linalg.norm(start[1]))
        if np.linalg.norm(start[0] - goal_odom) < _NEAR_M and speed < 0.1:
            if self._going == "goal":
                self._say("reached")
                self.outcome, self._ends_ns = "reached", begins_ns
            else:
                self._say("home: land")
                self._land(start_world[0], yaw, begins_ns)
            return
        # The route through the map, now and then and when it is blocked.
        path = self._route(now_ns, grid, start[0], goal, T_map_odom, T_odom_map, c)
        if path is None:
            if self._going == "home":
                self._say("no way home: land")
                self._land(start_world[0], yaw, begins_ns)
            else:
                self._say("unreachable: return home")
                self.outcome, self._going, self._route_due_ns = "unreachable", "home", 0
            follow(stop(space, start, c.body, c.limits), turned(None))
            return
        ahead = sampled(path, start[0], c.horizon_m)
        # Turn toward the route before it is flown.
        look = ahead[min(int(_AHEAD_M / 0.1), len(ahead) - 1)] - start[0]
        toward = atan2(look[1], look[0]) if hypot(look[0], look[1]) > 0.3 else None
        turn = turned(toward)
        askew = toward is not None and abs((toward + yaw_odom - yaw + pi) % (2.0 * pi) - pi) > _ASKEW_RAD
        if askew and speed < 0.1:
            self._say("turn")
            follow(_at_rest(start[0]), turn)
            self._progress_ns = now_ns
            return
        limits = replace(c.limits, speed_m_s=max(_SLOW_M_S, 0.8 * speed)) if askew else c.limits
        trajectory = trajectory_along(space, ahead, start, c.body, limits)
        if trajectory is not None and np.linalg.norm(trajectory.control_points[-1, -1] - start[0]) > 0.15:
            self._say("fly home" if self._going == "home" else "fly")
            self._progress_ns = now_ns
            follow(trajectory, turn)
            return
        # Without a new trajectory: fly on, if that is still free, or stop.
        rest = (course.positions_from(begins_ns) - T_world_odom[:3, 3]) @ R
        if np.any(space.clearances(rest[::10]) < c.body.radius_m - grid.cell_m) and speed > 0.05:
            self._say("blocked: stop")
            follow(stop(space, start, c.body, c.limits), turn)
            return
        if speed < 0.1:
            self._say("look")
            follow(_at_rest(start[0]), turn)
            if now_ns - self._progress_ns > _STUCK_NS:
                self._give_up(ahead, grid, T_map_odom, c)
                self._progress_ns = now_ns

    def _route(
        self,
        now_ns: int,
        grid: OccupancyGrid,
        start: Array,
        goal: Array,
        T_map_odom: Array,
        T_odom_map: Array,
        c: ExploreSettings,
    ) -> Array | None:
        """Return the route in the odometry frame; None if the goal is unreachable."""
        if self.route_map is None or now_ns >= self._route_due_ns or self._is_blocked(grid, T_odom_map):
            known = self._mapper.fused()
            if known is None:
                return None
            known = self._declared(known, T_odom_world=None)
            ground = self._ground_m
            at = T_map_odom[:3, :3] @ start + T_map_odom[:3, 3]
            found = path_to_goal(known, at, goal, c.body, (ground + c.lowest_m, ground + c.highest_m), self._given_up)
            self._route_due_ns = now_ns + _ROUTE_NS
            if isinstance(found, NoRoute):
                self._say(found.reason)
                self.route_map = None
                return None
            self.route_map = found.waypoints
        return np.asarray(self.route_map @ T_odom_map[:3, :3].T + T_odom_map[:3, 3])

    def _is_blocked(self, grid: OccupancyGrid, T_odom_map: Array) -> bool:
        """Return whether the local map has an obstacle on the route."""
        assert self.route_map is not None
        path = self.route_map @ T_odom_map[:3, :3].T + T_odom_map[:3, 3]
        legs = [
            np.linspace(a, b, 2 + int(np.linalg.norm(b - a) / 0.1)) for a, b in zip(path[:-1], path[1:], strict=True)
        ]
        return bool(np.any(grid.at(np.concatenate(legs)) == OCCUPIED))

    def _local_grid(self, T_odom_world: Array) -> OccupancyGrid | None:
        """Return the local map with the declared column of the take-off."""
        grid = self._mapper.local_map
        self._ground_m = float((T_odom_world[:3, :3] @ self._stand + T_odom_world[:3, 3])[2]) - 0.13
        self._column = T_odom_world[:3, :3] @ self._stand + T_odom_world[:3, 3]
        return None if grid is None else self._declared(grid, T_odom_world)

    def _declared(self, grid: OccupancyGrid, T_odom_world: Array | None) -> OccupancyGrid:
        """Return a grid in which the unknown cells of the column of the take-off are free."""
        c = self._settings
        radius = c.pad_radius_m
        top = self._column[2] + c.height_m + _LOOK_ABOVE_M + c.body.half_height_m + 0.1
        low = grid.cells(np.append(self._column[:2] - radius, self._column[2]))
        high = grid.cells(np.append(self._column[:2] + radius, top)) + 1
        low, high = np.clip(low, 0, grid.states.shape), np.clip(high, 0, grid.states.shape)
        if np.any(high <= low):
            return grid
        box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        states = grid.states.copy()
        cells = np.stack(np.meshgrid(*(np.arange(a, b) for a, b in zip(low, high, strict=True)), indexing="ij"), -1)
        near = np.linalg.norm((grid.centres(cells) - self._column)[..., :2], axis=-1) <= radius
        part = states[box]
        part[near & (part == UNKNOWN)] = FREE
        return replace(grid, states=states)

    def _give_up(self, ahead: Array, grid: OccupancyGrid, T_map_odom: Array, c: ExploreSettings) -> None:
        """Take what is unknown around the next part of the route as occupied, since it cannot be seen from here."""
        near = ahead[: int(1.0 / 0.1)]
        reach = np.arange(-c.body.radius_m, c.body.radius_m + 0.01, grid.cell_m)
        offsets = np.stack(
            np.meshgrid(reach, reach, reach[np.abs(reach) <= c.body.half_height_m + 0.01], indexing="ij"), -1
        )
        points = (near[:, None] + offsets.reshape(-1, 3)).reshape(-1, 3)
        unseen = np.unique(grid.cells(points[grid.at(points) == UNKNOWN]), axis=0)
        self._say(f"give up {len(unseen)} cells that cannot be seen")
        found = grid.centres(unseen) @ T_map_odom[:3, :3].T + T_map_odom[:3, 3]
        self._given_up = np.concatenate([self._given_up, found])
        self._route_due_ns = 0

    def _land(self, position: Array, yaw_rad: float, begins_ns: int) -> None:
        """Descend and stop the rotors."""
        down = np.append(position[:2], self._stand[2] - _SINK_M)
        course = self._course
        course.follow(Motion.of(straight(position, down, 0.5), _held(yaw_rad), begins_ns, course.interval_ns))
        ends_ns = course.decided_until_ns
        course.stop_rotors(ends_ns)
        self._ends_ns = ends_ns + 300_000_000


def _held(yaw_rad: float) -> Turn:
    """Return the turn that keeps a heading."""
    return Turn(yaw_rad, 0.0, 0.0, 1.0, _YAW_ACCEL_RAD_S2)


def _at_rest(position: Array) -> CorridorTrajectory:
    """Return the trajectory that stays at a position (3,)."""
    return CorridorTrajectory(np.tile(position, (1, 8, 1)), np.array([0.0, 0.1]), np.zeros(1, np.int64))


def _brake(start: Array, c: ExploreSettings) -> CorridorTrajectory:
    """Return the trajectory to rest without a map."""
    from dronevio.autonomy.local_plan import braking

    return braking(start, c.limits)
