"""Flights to a goal through unknown space: a pilot that maps, plans and decides while it flies.

The frames: the *world* is that of the simulator, in which pad and goal are given; the *odometry* frame is continuous,
and trajectories are planned in it; the *map* frame is corrected by loops, and holds goal and route. At the start, map
and odometry frame are the same. A correction moves goal and route in the odometry frame; the trajectory that is flown
stays until the next plan.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import atan2, hypot, pi, radians, remainder
from typing import Literal

import numpy as np

from dronevio.autonomy.body import Body
from dronevio.autonomy.decided_course import DecidedCourse, Motion
from dronevio.autonomy.goal_path import path_to_goal
from dronevio.autonomy.heading import Turn
from dronevio.autonomy.known_space import LocalSpace, around, with_free_column
from dronevio.autonomy.landing import landing_place
from dronevio.autonomy.local_plan import (
    at_rest,
    braking,
    place_beside,
    sampled,
    slowed,
    stop,
    straight,
    trajectory_along,
)
from dronevio.autonomy.margin import RelativeMargin
from dronevio.autonomy.route import NoRoute
from dronevio.autonomy.settings import ExploreSettings
from dronevio.autonomy.trajectory import CorridorTrajectory
from dronevio.dense_mapping import DepthListener
from dronevio.estimator.mapping.dense_mapper import DenseMapper
from dronevio.estimator.mapping.depth_source import DepthSource, depth_source
from dronevio.estimator.threads import single_threaded
from dronevio.models.arrays import Array
from dronevio.models.depth import DepthImage
from dronevio.models.imu import ImuSamples
from dronevio.models.occupancy import OCCUPIED, UNKNOWN, OccupancyGrid
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
_DESCENT_M_S = 0.5
_LOOK_FROM_M, _LOOK_ABOVE_M = 0.5, 0.3  # heights of the turns after the take-off, above the stand and the hover
_YAW_ACCEL_RAD_S2 = 3.0
_AHEAD_M = 1.5  # along the route, where the vehicle looks
_ASKEW_RAD = radians(50.0)  # between heading and route, from where on the vehicle turns before it flies
_SLOW_M_S = 0.5  # while it turns
_STILL_M_S = 0.1
_REST = np.array([1e-3, 1e-2])  # speed and acceleration at rest [m/s, m/s²]
GOAL_M = 0.5
"""Distance from the goal within which a flight must end."""
_NEAR_M = 0.25  # from the goal, where it is reached
_LEAST_STEP_M, _PROGRESS_M = 0.15, 0.6  # lengths of a plan that is worth to be flown, and that leads on
_STOP_AFTER_NS, _LAND_AFTER_NS = 300_000_000, 1_000_000_000  # without depth; later if it is due less often
_ROUTE_NS = 1_000_000_000  # between two routes
_CHECK_NS = 25_000_000  # between the points of a trajectory whose clearance is checked: half a cell at 2 m/s
_STUCK_NS = 2_000_000_000  # without progress, after which unseen space on the route is given up
_PEEKS = 3  # places from which a path is looked at
_RETRIES = 2  # of what was given up, before the goal is unreachable
_SINK_M = 0.05  # by which the descent ends below the ground
_EARLY_NS = 1_000_000  # by which a plan may be made before it is due, for time stamps that jitter


@dataclass(frozen=True)
class Decision:
    """A decision of the pilot, for people."""

    t_ns: int
    """Time on the clock of the course [ns]."""
    what: str
    """What was decided, and why."""
    position_m: tuple[float, float, float]
    """Where the vehicle was to be in the world [m]."""


@dataclass(frozen=True, eq=False)
class Plan:
    """A trajectory that was flown for a while, and the route that it follows."""

    t_ns: int
    """Time from which it was flown, on the clock of the course [ns]."""
    positions_m: Array
    """(N, 3) Positions in the world at equal intervals of a tenth of a second or less, to its end at rest [m]."""
    route_m: Array
    """(M, 3) Route to the goal in the world as it was then placed [m]."""


@dataclass
class StageTimes:
    """Processor times of the stages [ms], beside which the latencies of the settings are declared."""

    depth: list[float] = field(default_factory=list)
    """Of each depth image."""
    map: list[float] = field(default_factory=list)
    """Of each entry in the map."""
    plan: list[float] = field(default_factory=list)
    """Of each plan."""


class _TimedDepth:
    """A source of depth images with the processor time of each; implements `DepthSource`."""

    def __init__(self, source: DepthSource, times_ms: list[float]) -> None:
        self._source, self._times_ms = source, times_ms

    def depth(self, frame: CameraFrame, estimate: Estimate) -> DepthImage | None:
        """Return the depth image that is known with a frame; None if there is none."""
        began = time.process_time()
        depth = self._source.depth(frame, estimate)
        self._times_ms.append(1e3 * (time.process_time() - began))
        return depth


@dataclass(frozen=True, eq=False)
class _Moment:
    """What is known when a plan is made, in the odometry frame unless another is named."""

    now_ns: int
    """Time of the plan on the clock of the course [ns]."""
    begins_ns: int
    """Time from which it will be flown [ns]."""
    start: Array
    """(4, 3) State at that time, as decided so far [m, s]."""
    yaw_rad: float
    """Heading at that time in the world [rad]."""
    yaw_rate_rad_s: float
    """Its rate [rad/s]."""
    body: Body
    """The body with the margin for the error of the estimate relative to the local map."""
    grid: OccupancyGrid | None
    """The local map."""
    T_world_odom: Array
    """(4, 4) Pose of the odometry frame in the world."""
    T_map_odom: Array
    """(4, 4) Its pose in the map frame."""
    estimate: Estimate
    """The newest estimate."""

    @property
    def speed_m_s(self) -> float:
        """Speed at the start [m/s]."""
        return float(np.linalg.norm(self.start[1]))

    @property
    def is_at_rest(self) -> bool:
        """Whether the vehicle stands still at the start, so that another motion can begin from rest without a step."""
        return bool(np.all(np.linalg.norm(self.start[1:3], axis=1) < _REST))

    def from_world(self, points: Array) -> Array:
        """Return points (…, 3) of the world in the odometry frame."""
        return moved(inverse_pose(self.T_world_odom), points)


def moved(T_a_b: Array, points: Array) -> Array:
    """Return points (…, 3) of frame b in frame a."""
    return np.asarray(points @ T_a_b[:3, :3].T + T_a_b[:3, 3])


class Explorer:
    """Flies to a goal through unknown space; implements `dronevio.sim.closed_loop.flight.Pilot`."""

    def __init__(
        self,
        goal: Array,
        longest_s: float,
        settings: ExploreSettings | None = None,
        source: DepthSource | None = None,
        listeners: Sequence[DepthListener] = (),
    ) -> None:
        """Define a flight.

        Args:
            goal: (3,) Goal in the world [m].
            longest_s: Duration after which the flight ends [s].
            settings: Settings.
            source: Source of depth images; by default from the images of the rig.
            listeners: Receive the depth images while the map grows.
        """
        self._goal, self._longest_s, self._source, self._listeners = goal, longest_s, source, listeners
        self._settings = settings or ExploreSettings()
        self.outcome: Outcome | None = None
        self.decisions: list[Decision] = []
        self.plans: list[Plan] = []
        self.times = StageTimes()
        self.T_world_odom: Array | None = None
        self._route_map: Array | None = None
        self._given_up = np.zeros((0, 3))
        self._retries = _RETRIES
        self._peeks = self._peeking_until_ns = self._to_floor_until_ns = 0
        self._depth_ns = 0
        self._margin = RelativeMargin()
        self._plan_due_ns = self._route_due_ns = self._progress_ns = 0
        self._ends_ns: int | None = None
        self._is_going_home = False

    @property
    def finished(self) -> bool:
        """Whether the flight has ended."""
        return self._ends_ns is not None and self._course.now_ns >= self._ends_ns

    @property
    def mapper(self) -> DenseMapper:
        """The map; it exists from the start of the flight on."""
        return self._mapper

    @property
    def now_ns(self) -> int:
        """Time on the clock of the course, which stands still while the vehicle waits on its pad [ns]."""
        return self._course.now_ns

    @property
    def departs_ns(self) -> int:
        """Time at which take-off and turns end and the first plan is due, on the clock of the course [ns]."""
        return self._departs_ns

    def course(self, scenario: Scenario, plant: QuadrotorPlant) -> Course:
        """Return the course, which begins with the take-off and two turns."""
        c = self._settings
        self._mapper = DenseMapper(
            scenario.rig, c.map, _TimedDepth(self._source or depth_source(scenario.rig), self.times.depth)
        )
        self._stand = flight_area(scenario.world, scenario.seed_of_world).pad + [0.0, 0.0, plant.standing_height_m]
        self._hover = self._stand + [0.0, 0.0, c.height_m]
        self._course = course = DecidedCourse(self._stand, 0.0, plant.interval_ns, round(self._longest_s * 1e9))
        begins_ns = round(scenario.plan.initial_rest_s * 1e9) // plant.interval_ns * plant.interval_ns
        # Climb, turn while rising and again while sinking: near space is seen from several heights.
        low, high = self._stand + [0.0, 0.0, _LOOK_FROM_M], self._hover + [0.0, 0.0, _LOOK_ABOVE_M]
        yaw = 0.0
        for start, end, angle in ((self._stand, low, 0.0), (low, high, 2.0 * pi), (high, self._hover, 2.0 * pi)):
            turn = Turn(yaw, 0.0, angle, c.limits.yaw_rate_rad_s, _YAW_ACCEL_RAD_S2)
            trajectory = slowed(straight(start, end, _CLIMB_M_S), turn.duration_s)
            course.follow(Motion.of(trajectory, turn, max(begins_ns, course.decided_until_ns), plant.interval_ns))
            yaw += angle
        self._plan_due_ns = self._departs_ns = course.decided_until_ns
        return course

    def controller(self, course: Course, T_vehicle_imu: Array, quadrotor: Quadrotor) -> Controller:
        """Return the controller of the scenarios."""
        return SE3Controller(course, T_vehicle_imu, quadrotor)

    def add_imu(self, samples: ImuSamples) -> None:
        """Do nothing: the estimates contain what the samples tell."""

    def add_frame(self, frame: CameraFrame, estimate: Estimate, T_world_odom: Array | None) -> None:
        """Map a frame, and decide what is flown next."""
        if T_world_odom is None:
            return
        now_ns, before, began = self._course.now_ns, len(self.times.depth), time.process_time()
        with single_threaded():
            depth = self._mapper.add_frame(frame, estimate)
        if depth is not None:
            self._depth_ns = now_ns
            self.times.map.append(1e3 * (time.process_time() - began) - sum(self.times.depth[before:]))
            for listener in self._listeners:
                listener(depth, estimate, self._mapper)
        self.T_world_odom = T_world_odom
        if self._ends_ns is None and now_ns >= self._plan_due_ns - _EARLY_NS:
            began = time.process_time()
            with single_threaded():
                self._decide(self._moment(now_ns, estimate, T_world_odom))
            self.times.plan.append(1e3 * (time.process_time() - began))
            self._plan_due_ns = now_ns + round(1e9 / self._settings.plan_rate_hz)

    def _moment(self, now_ns: int, estimate: Estimate, T_world_odom: Array) -> _Moment:
        """Return what is known now."""
        c, course = self._settings, self._course
        begins_ns = now_ns + round(c.latency_s * 1e9) // course.interval_ns * course.interval_ns
        state_world, yaw, yaw_rate = course.planned(begins_ns)
        T_odom_world = inverse_pose(T_world_odom)
        start = state_world @ T_odom_world[:3, :3].T
        start[0] += T_odom_world[:3, 3]
        grid = self._mapper.local_map
        if grid is not None:
            grid = self._with_pad(grid, T_odom_world)
        T_map_odom = np.eye(4) if estimate.T_map_odom is None else estimate.T_map_odom
        body = c.body.grown(self._margin.add(now_ns, None if estimate.state is None else estimate.state.covariance))
        return _Moment(now_ns, begins_ns, start, yaw, yaw_rate, body, grid, T_world_odom, T_map_odom, estimate)

    def _with_pad(self, grid: OccupancyGrid, T_grid_world: Array) -> OccupancyGrid:
        """Return a grid in which what is unknown above the pad is free."""
        c = self._settings
        top_m = c.height_m + _LOOK_ABOVE_M + c.body.half_height_m + 0.1
        return with_free_column(grid, moved(T_grid_world, self._stand), c.pad_radius_m, top_m)

    def _decide(self, m: _Moment) -> None:
        """Decide what is flown from the beginning of a plan on."""
        c = self._settings
        # Without a valid estimate, brake and land; without depth, stop, and land if it does not come back.
        is_lost = m.estimate.health in (Health.LOST, Health.INITIALIZING) or m.estimate.track != 0
        without_ns = m.now_ns - self._depth_ns
        if is_lost or m.grid is None or without_ns > max(_LAND_AFTER_NS, 5e9 / c.map.rate_hz):
            self._brake_and_land(m, "the estimate is lost" if is_lost else "no depth", is_lost)
            return
        space = LocalSpace.of(m.grid, m.body, m.start[0])
        if without_ns > max(_STOP_AFTER_NS, 2.5e9 / c.map.rate_hz):
            self._say("no depth: stop")
            self._follow(m, stop(space, m.start, m.body, c.limits), self._turn(m, None))
            return
        # The goal or, on the way home, the hover above the pad.
        goal = m.from_world(self._target)  # the map frame is the odometry frame of the start
        goal_odom = moved(inverse_pose(m.T_map_odom), goal)
        if np.linalg.norm(m.start[0] - goal_odom) < _NEAR_M and m.speed_m_s < _STILL_M_S:
            self._arrive(m)
            return
        path = self._path(m, goal)
        if path is None:
            self._turn_back(m)
            if self._ends_ns is None:
                self._follow(m, self._halt(m, space), self._turn(m, None))
            return
        # Where the body has no room at the goal, the path ends at the nearest place.
        if np.linalg.norm(m.start[0] - path[-1]) < _NEAR_M and m.speed_m_s < _STILL_M_S:
            if np.linalg.norm(path[-1] - goal_odom) <= GOAL_M:
                self._arrive(m)
            else:
                self._turn_back(m)
            return
        self._fly_along(m, space, sampled(path, m.start[0], c.horizon_m))

    @property
    def _target(self) -> Array:
        """(3,) Where the flight leads, in the world [m]."""
        return self._hover if self._is_going_home else self._goal

    def _fly_along(self, m: _Moment, space: LocalSpace, ahead: Array) -> None:
        """Fly along a path (N, 3) as far as it is known to be free, after a turn toward it."""
        c = self._settings
        look = ahead[min(round(_AHEAD_M / 0.1), len(ahead) - 1)] - m.start[0]
        toward = atan2(look[1], look[0]) if hypot(look[0], look[1]) > 0.3 else None
        turn = self._turn(m, toward)
        is_askew = toward is not None and abs(remainder(turn.yaw_rad + turn.angle_rad - m.yaw_rad, 2 * pi)) > _ASKEW_RAD
        if is_askew and m.speed_m_s < _STILL_M_S:
            self._say("turn")
            self._follow(m, self._halt(m, space), turn)
            self._progress_ns = m.now_ns
            return
        limits = replace(c.limits, speed_m_s=max(_SLOW_M_S, 0.8 * m.speed_m_s)) if is_askew else c.limits
        trajectory = trajectory_along(space, ahead, m.start, m.body, limits)
        length_m = 0.0 if trajectory is None else float(np.linalg.norm(trajectory.control_points[-1, -1] - m.start[0]))
        if length_m > _PROGRESS_M or (length_m > _LEAST_STEP_M and m.now_ns > self._peeking_until_ns):
            assert trajectory is not None
            self._say("fly home" if self._is_going_home else "fly")
            self._follow(m, trajectory, turn)
            if length_m > _PROGRESS_M:
                self._progress_ns, self._peeks = m.now_ns, 0
            return
        # Without a new trajectory: fly on if the last one is still free, otherwise stop.
        rest = m.from_world(self._course.positions_from(m.begins_ns)[:: max(_CHECK_NS // self._course.interval_ns, 1)])
        if m.speed_m_s > 0.5 * _STILL_M_S and np.any(space.clearances(rest) < m.body.radius_m - space.grid.cell_m):
            self._say("the trajectory is blocked: stop")
            self._follow(m, stop(space, m.start, m.body, c.limits), turn)
        elif m.speed_m_s < _STILL_M_S:
            self._say("look")
            self._follow(m, self._halt(m, space), turn)
            if m.now_ns - self._progress_ns > _STUCK_NS:
                self._try_otherwise(m, space, ahead, turn)

    def _halt(self, m: _Moment, space: LocalSpace) -> CorridorTrajectory:
        """Return the trajectory to rest, or at rest."""
        return at_rest(m.start[0]) if m.is_at_rest else stop(space, m.start, m.body, self._settings.limits)

    def _path(self, m: _Moment, goal: Array) -> Array | None:
        """Return the path to a goal (3,) of the map in the odometry frame; None if it is unreachable.

        It is sought anew once a second, and when the local map has an obstacle on it.
        """
        assert m.grid is not None
        T_odom_map = inverse_pose(m.T_map_odom)
        path = None if self._route_map is None else moved(T_odom_map, self._route_map)
        if path is None or m.now_ns >= self._route_due_ns or np.any(m.grid.at(sampled(path, path[0])) == OCCUPIED):
            path_map = self._sought(m, goal)
            path = None if path_map is None else moved(T_odom_map, path_map)
            self._route_map, self._route_due_ns = path_map, m.now_ns + _ROUTE_NS
        return path

    def _sought(self, m: _Moment, goal: Array) -> Array | None:
        """Return a path in the map to a goal (3,), through all that was not seen to be occupied; None without one."""
        known, c = self._mapper.fused(), self._settings
        if known is None:
            return None
        known = self._with_pad(known, inverse_pose(m.T_world_odom))
        ground_m = float(m.from_world(self._stand)[2])
        heights_m, start = (ground_m + c.lowest_m, ground_m + c.highest_m), moved(m.T_map_odom, m.start[0])
        found = path_to_goal(known, start, goal, m.body, heights_m, self._given_up)
        if isinstance(found, NoRoute) and found.cause == "goal" and len(self._given_up) and self._retries:
            self._say("no route: try again what was given up")
            self._given_up, self._retries = self._given_up[:0], self._retries - 1
            found = path_to_goal(known, start, goal, m.body, heights_m, self._given_up)
        if isinstance(found, NoRoute):
            self._say(f"no route: {found.reason}")
            return None
        return found.waypoints

    def _try_otherwise(self, m: _Moment, space: LocalSpace, ahead: Array, turn: Turn) -> None:
        """Look at the path from another place; give up what is unknown on it if that has not helped."""
        place = None if self._peeks == _PEEKS else place_beside(space, m.start[0], ahead[-1], m.body)
        there = None if place is None else trajectory_along(space, place[None], m.start, m.body, self._settings.limits)
        if there is None:
            self._give_up(m, ahead)
            return
        self._say("look from another place")
        self._peeks += 1
        self._progress_ns = m.now_ns + round(1e9 * there.duration_s) - _STUCK_NS // 2
        self._peeking_until_ns = m.begins_ns + round(1e9 * there.duration_s)
        self._follow(m, there, turn)

    def _give_up(self, m: _Moment, ahead: Array) -> None:
        """Take what is unknown around the next part of a path as occupied, since it cannot be seen from here."""
        assert m.grid is not None
        points = around(ahead[:10], self._settings.body, m.grid.cell_m)
        unseen = np.unique(m.grid.cells(points[m.grid.at(points) == UNKNOWN]), axis=0)
        if not len(unseen):  # all is known, and the body does not fit
            self._turn_back(m)
            return
        self._say(f"give up {len(unseen)} cells of the route, which cannot be seen")
        self._given_up = np.concatenate([self._given_up, moved(m.T_map_odom, m.grid.centres(unseen))])
        self._route_due_ns, self._progress_ns = m.now_ns, m.now_ns

    def _arrive(self, m: _Moment) -> None:
        """End the flight at the goal, or land at home."""
        if self._is_going_home:
            self._land(m, "home: land")
        else:
            self._say("reached")
            self.outcome, self._ends_ns = "reached", m.begins_ns

    def _turn_back(self, m: _Moment) -> None:
        """Go home, since there is no way to the goal; land if there is none home."""
        if self._is_going_home:
            self._land(m, "no way home: land")
        else:
            self._say("unreachable: return home")
            self.outcome, self._is_going_home, self._route_map = "unreachable", True, None

    def _brake_and_land(self, m: _Moment, why: str, is_lost: bool) -> None:
        """Stop, then land: here if the estimate is lost, else where level floor was observed, else not yet."""
        space = None if m.grid is None else LocalSpace.of(m.grid, m.body, m.start[0])
        if m.now_ns < self._to_floor_until_ns and not is_lost:
            return
        if not m.is_at_rest:
            self._say(f"{why}: brake")
            limits = self._settings.limits
            trajectory = braking(m.start, limits) if space is None else stop(space, m.start, m.body, limits)
            self._follow(m, trajectory, self._turn(m, None))
            return
        place = None if space is None else landing_place(space, m.start[0], m.body)
        if is_lost or (place is not None and np.linalg.norm(place - m.start[0]) < _NEAR_M):
            self._land(m, f"{why}: land")
            self.outcome = "lost"
        elif space is None or place is None:
            self._say(f"{why}: hold, no floor was observed")
        else:
            self._say(f"{why}: fly to observed floor")
            trajectory_there = trajectory_along(space, place[None], m.start, m.body, self._settings.limits)
            if trajectory_there is not None:
                self._follow(m, trajectory_there, self._turn(m, None))
                self._to_floor_until_ns = m.begins_ns + round(1e9 * trajectory_there.duration_s)

    def _land(self, m: _Moment, why: str) -> None:
        """Descend and stop the rotors, once the vehicle is at rest."""
        if not m.is_at_rest:
            self._follow(m, braking(m.start, self._settings.limits), self._turn(m, None))
            return
        self._say(why)
        course, above = self._course, moved(m.T_world_odom, m.start[0])
        down = straight(above, np.append(above[:2], self._stand[2] - _SINK_M), _DESCENT_M_S)
        course.follow(Motion.of(down, self._turn(m, None), m.begins_ns, course.interval_ns))
        course.stop_rotors(course.decided_until_ns)
        self._ends_ns = course.decided_until_ns + 300_000_000

    def _turn(self, m: _Moment, toward_rad: float | None) -> Turn:
        """Return the turn toward a heading in the odometry frame, or to rest."""
        bounds = self._settings.limits.yaw_rate_rad_s, _YAW_ACCEL_RAD_S2
        if toward_rad is None:
            angle = 0.5 * m.yaw_rate_rad_s * abs(m.yaw_rate_rad_s) / _YAW_ACCEL_RAD_S2
            return Turn(m.yaw_rad, m.yaw_rate_rad_s, angle, *bounds)
        target = toward_rad + float(yaw_rad_from_matrix(m.T_world_odom[:3, :3]))
        return Turn.toward(m.yaw_rad, m.yaw_rate_rad_s, target, *bounds)

    def _follow(self, m: _Moment, trajectory: CorridorTrajectory, turn: Turn) -> None:
        """Follow a trajectory of the odometry frame."""
        course = self._course
        in_world = replace(trajectory, control_points=moved(m.T_world_odom, trajectory.control_points))
        motion = Motion.of(in_world, turn, m.begins_ns, course.interval_ns)
        course.follow(motion)
        path = np.zeros((0, 3)) if self._route_map is None else moved(inverse_pose(m.T_map_odom), self._route_map)
        every = max(round(1e8 / course.interval_ns), 1)
        self.plans.append(Plan(m.begins_ns, motion.states[::every, 0], moved(m.T_world_odom, path)))

    def _say(self, what: str) -> None:
        """Record a decision, unless it is the last one again."""
        if not self.decisions or self.decisions[-1].what != what:
            x, y, z = self._course.planned(self._course.now_ns)[0][0].tolist()
            self.decisions.append(Decision(self._course.now_ns, what, (x, y, z)))
