"""Flights through unknown space: a pilot that maps, plans and decides while it flies.

The frames: the *world* is that of the simulator, in which pad and goal are given; the *odometry* frame is continuous,
and trajectories are planned in it; the *map* frame is corrected by loops, and holds target and route. At the start, map
and odometry frame are the same. A correction moves target and route in the odometry frame; the trajectory that is flown
stays until the next plan.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from math import atan2, hypot, pi, radians
from typing import Literal

import numpy as np

from dronevio.autonomy.pilot.decided_course import DecidedCourse, Motion
from dronevio.autonomy.pilot.flight_log import Decision, Plan, StageTimes, TimedDepth
from dronevio.autonomy.pilot.heading import Turn
from dronevio.autonomy.pilot.map_route import MapRoute
from dronevio.autonomy.pilot.margin import RelativeMargin
from dronevio.autonomy.pilot.moment import Moment, moved
from dronevio.autonomy.pilot.path_following import STILL_M_S, PathFollowing
from dronevio.autonomy.pilot.tasks import Target, Task
from dronevio.autonomy.planning.known_space import LocalSpace, with_free_column
from dronevio.autonomy.planning.landing import landing_place
from dronevio.autonomy.planning.local_plan import (
    braking,
    sampled,
    slowed,
    stop,
    straight,
    trajectory_along,
)
from dronevio.autonomy.planning.trajectory import CorridorTrajectory
from dronevio.autonomy.settings import ExploreSettings
from dronevio.estimator.mapping.dense_mapper import DenseMapper
from dronevio.estimator.mapping.depth_source import DepthSource, depth_source
from dronevio.estimator.threads import single_threaded
from dronevio.models.arrays import Array
from dronevio.models.depth import DepthImage
from dronevio.models.imu import ImuSamples
from dronevio.models.occupancy import OccupancyGrid
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
FlightListener = Callable[[DepthImage, Estimate, "Explorer"], None]
"""Receives each depth image with its estimate and the pilot, whose map it has entered."""

_CLIMB_M_S = 0.8
_DESCENT_M_S = 0.5
_LOOK_FROM_M, _LOOK_ABOVE_M = 0.5, 0.3  # heights of the turns after the take-off, above the stand and the hover
_YAW_ACCEL_RAD_S2 = 3.0
_AHEAD_M = 1.5  # along the route, where the vehicle looks
GOAL_M = 0.5
"""Distance from the goal within which a flight must end."""
_NEAR_M = 0.25  # from the goal, where it is reached
_SPARE_M = 0.1  # for the error of the estimate, where it is reached from farther away
_STOP_AFTER_NS, _LAND_AFTER_NS = 300_000_000, 1_000_000_000  # without depth; later if it is due less often
_ROUTE_NS = 1_000_000_000  # between two routes
_CHECK_NS = 25_000_000  # between the points of a trajectory whose clearance is checked: half a cell at 2 m/s
_SINK_M = 0.05  # by which the descent ends below the ground
_IMPACT_M_S2, _IMPACT_NS = 20.0, 20_000_000  # specific force at the ground, twice that of flight, and its time
_REST_NS = 300_000_000  # after the rotors have stopped
_TAKEN_M, _TURNED_RAD = 0.6, radians(10.0)  # of a view, within which it is taken
_EARLY_NS = 1_000_000  # by which a plan may be made before it is due, for time stamps that jitter


class Explorer:
    """Flies through unknown space where a task leads; implements `dronevio.sim.closed_loop.flight.Pilot`."""

    def __init__(
        self,
        task: Task,
        longest_s: float,
        settings: ExploreSettings | None = None,
        source: DepthSource | None = None,
        listeners: Sequence[FlightListener] = (),
    ) -> None:
        """Define a flight.

        Args:
            task: Tells where the flight leads.
            longest_s: Duration after which the flight ends [s].
            settings: Settings.
            source: Source of depth images; by default from the images of the rig.
            listeners: Receive the depth images, and the pilot, while the map grows.
        """
        self._task, self._longest_s, self._source, self._listeners = task, longest_s, source, listeners
        self._settings = settings or ExploreSettings()
        self.outcome: Outcome | None = None
        self.decisions: list[Decision] = []
        self.plans: list[Plan] = []
        self.times = StageTimes()
        self.T_world_odom: Array | None = None
        self._route = MapRoute(_ROUTE_NS, self._say)
        self._target: Target | None = None
        self._following = PathFollowing(self._settings.limits)
        self._to_floor_until_ns = 0
        self._depth_ns = 0
        self._margin = RelativeMargin()
        self._plan_due_ns = 0
        self._ends_ns: int | None = None
        self._is_going_home = self._is_landing = False
        self._felt: list[tuple[int, Array]] = []  # times and specific forces of the last samples of a landing

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
            scenario.rig, c.map, TimedDepth(self._source or depth_source(scenario.rig), self.times.depth)
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
        """Stop the rotors when the vehicle meets the ground, whose height a lost estimate does not know."""
        if not self._is_landing or not len(samples):
            return
        # The mean over some samples is that of any rate, and vibration has none.
        felt = [*self._felt, *zip(samples.t_ns.tolist(), samples.accel_m_s2, strict=True)]
        self._felt = [each for each in felt if each[0] > samples.t_ns[-1] - _IMPACT_NS]
        is_whole = len(self._felt) < len(felt)
        if is_whole and np.linalg.norm(np.mean([accel for _, accel in self._felt], axis=0)) > _IMPACT_M_S2:
            self._stop_rotors(self._course.now_ns)

    def add_frame(self, frame: CameraFrame, estimate: Estimate, T_world_odom: Array | None) -> None:
        """Map a frame, and decide what is flown next."""
        if T_world_odom is None:
            return
        self.T_world_odom = T_world_odom
        now_ns, before, began = self._course.now_ns, len(self.times.depth), time.process_time()
        with single_threaded():
            depth = self._mapper.add_frame(frame, estimate)
        if depth is not None:
            self._depth_ns = now_ns
            self.times.map.append(1e3 * (time.process_time() - began) - sum(self.times.depth[before:]))
            began = time.process_time()
            for listener in self._listeners:
                listener(depth, estimate, self)
            self.times.listeners.append(1e3 * (time.process_time() - began))
        if self._ends_ns is None and now_ns >= self._plan_due_ns - _EARLY_NS:
            began = time.process_time()
            with single_threaded():
                self._decide(self._moment(now_ns, estimate, T_world_odom))
            self.times.plan.append(1e3 * (time.process_time() - began))
            self._plan_due_ns = now_ns + round(1e9 / self._settings.plan_rate_hz)

    def _moment(self, now_ns: int, estimate: Estimate, T_world_odom: Array) -> Moment:
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
        return Moment(now_ns, begins_ns, start, yaw, yaw_rate, body, grid, T_world_odom, T_map_odom, estimate)

    def _with_pad(self, grid: OccupancyGrid, T_grid_world: Array) -> OccupancyGrid:
        """Return a grid in which what is unknown above the pad is free."""
        c = self._settings
        top_m = c.height_m + _LOOK_ABOVE_M + c.body.half_height_m + 0.1
        return with_free_column(grid, moved(T_grid_world, self._stand), c.pad_radius_m, top_m)

    def _decide(self, m: Moment) -> None:
        """Decide what is flown from the beginning of a plan on."""
        c = self._settings
        # Without a valid estimate, brake and land; without depth, stop, and land if it does not come back.
        is_lost = m.estimate.health in (Health.LOST, Health.INITIALIZING) or m.estimate.track != 0
        without_ns = m.now_ns - self._depth_ns
        if is_lost or m.grid is None or without_ns > max(_LAND_AFTER_NS, 5e9 / c.map.rate_hz):
            self._brake_and_land(m, "the estimate is lost" if is_lost else "no depth", is_lost)
            return
        space = LocalSpace.of(m.grid, m.body, m.position_m, self._heights(m))
        if without_ns > max(_STOP_AFTER_NS, 2.5e9 / c.map.rate_hz):
            self._say("no depth: stop")
            self._follow(m, stop(space, m.start, m.body, c.limits), self._turn(m, None))
            return
        # The target of the task or, on the way home, the hover above the pad.
        known = cache(lambda: self._known(m))
        if self._has_taken(m):  # in passing
            self._leave(m)
        target = self._chosen(m, known()) if self._route.is_due(m.now_ns) else self._target
        self._target = target
        if target is None:
            self._end("covered", m)
            return
        target_odom = m.from_map(target.position_map_m)
        if np.linalg.norm(m.position_m - target_odom) < _NEAR_M and m.speed_m_s < STILL_M_S:
            self._arrive(m, space, target)
            return
        path = self._route.path(m, known, target.position_map_m, self._heights(m))
        if path is None:
            if not self._is_there(m, target):
                self._turn_back(m)
            elif m.speed_m_s < STILL_M_S:
                self._arrive(m, space, target)
            if self._ends_ns is None:
                self._follow(m, self._following.halt(m, space), self._turn(m, None))
            return
        # Where the body has no room at the target, the path ends at the nearest place.
        if np.linalg.norm(m.position_m - path[-1]) < _NEAR_M and m.speed_m_s < STILL_M_S:
            if np.linalg.norm(path[-1] - target_odom) <= GOAL_M:
                self._arrive(m, space, target)
            else:
                self._turn_back(m)
            return
        self._fly_along(m, space, sampled(path, m.position_m, c.horizon_m), target)

    def _chosen(self, m: Moment, known: OccupancyGrid | None) -> Target | None:
        """Return the target by what is known."""
        if self._is_going_home:
            return Target(m.from_world(self._hover))
        return self._target if known is None else self._task.target(m, known, self._heights(m))

    def _known(self, m: Moment) -> OccupancyGrid | None:
        """Return the map with the column above the pad."""
        known = self._mapper.fused()
        return None if known is None else self._with_pad(known, inverse_pose(m.T_world_odom))

    def _heights(self, m: Moment) -> Array:
        """Return the least and the greatest height (2,) of routes in the map frame [m]."""
        ground_m = m.from_world(self._stand)[2]
        return np.array([ground_m + self._settings.lowest_m, ground_m + self._settings.highest_m])

    def _fly_along(self, m: Moment, space: LocalSpace, ahead: Array, target: Target) -> None:
        """Fly along a path (N, 3) as far as it is known to be free, after a turn toward it."""
        # Look along the path or, near its end, in the direction of the view.
        look = ahead[min(round(_AHEAD_M / 0.1), len(ahead) - 1)] - m.position_m
        toward, at_end = atan2(look[1], look[0]) if hypot(look[0], look[1]) > 0.3 else None, _view_rad(m, target)
        is_near = at_end is not None and bool(
            np.linalg.norm(m.from_map(target.position_map_m) - m.position_m) < _AHEAD_M
        )
        turn = self._turn(m, at_end if is_near else toward)
        askew = None if toward is None or is_near else turn.yaw_rad + turn.angle_rad - m.yaw_rad
        rest = m.from_world(self._course.positions_from(m.begins_ns)[:: max(_CHECK_NS // self._course.interval_ns, 1)])
        is_there = self._is_there(m, target)
        step = self._following.step(m, space, ahead, rest, askew, peeks=not (is_there or self._task.has_others))
        if step.what is None or step.trajectory is None:
            return
        self._say("fly home" if step.what == "fly" and self._is_going_home else step.what)
        self._follow(m, step.trajectory, turn)
        if step.is_stuck and is_there:
            self._arrive(m, space, target)
        elif step.is_stuck:
            self._give_up(m, ahead)

    def _is_there(self, m: Moment, target: Target) -> bool:
        """Return whether a goal is so near that it counts as reached if it cannot be approached any further."""
        apart_m = float(np.linalg.norm(m.position_m - m.from_map(target.position_map_m)))
        return apart_m < GOAL_M - _SPARE_M and target.yaw_map_rad is None and not self._is_going_home

    def _give_up(self, m: Moment, ahead: Array) -> None:
        """Give up what is unknown on the path, for another one; a task that has other targets takes the next one."""
        if self._route.give_up(m, self._settings.body, ahead) and not self._task.has_others:
            self._following.wait(m.now_ns)
        else:  # all is known, and the body does not fit
            self._turn_back(m)

    def _arrive(self, m: Moment, space: LocalSpace, target: Target) -> None:
        """End the flight at the goal, land at home, or turn to the heading of a view."""
        if self._is_going_home:
            self._land(m, "home: land")
        elif target.yaw_map_rad is None:
            self._end("reached", m)
        else:
            self._say("turn to the view")
            self._follow(m, self._following.halt(m, space), self._turn(m, _view_rad(m, target)))

    def _has_taken(self, m: Moment) -> bool:
        """Return whether the target is a view, and is seen now."""
        target = self._target
        if target is None or target.yaw_map_rad is None:
            return False
        apart_m = np.linalg.norm(m.position_map_m - target.position_map_m)
        return bool(apart_m < _TAKEN_M) and abs(self._turn(m, _view_rad(m, target)).angle_rad) < _TURNED_RAD

    def _turn_back(self, m: Moment) -> None:
        """Take the next target; without one go home, since there is no way to the goal; land if there is none home."""
        if self._is_going_home:
            self._land(m, "no way home: land")
        elif not self._leave(m):
            self._say("unreachable: return home")
            self.outcome, self._is_going_home = "unreachable", True
            self._route.drop()

    def _leave(self, m: Moment) -> bool:
        """Leave a target, and return whether the task has others."""
        if not self._task.has_others:
            return False
        self._task.leave()
        self._route.drop()
        self._following.begin(m.now_ns)
        return True

    def _end(self, outcome: Outcome, m: Moment) -> None:
        """End the flight in the air."""
        self._say(outcome)
        self.outcome, self._ends_ns = outcome, m.begins_ns

    def _brake_and_land(self, m: Moment, why: str, is_lost: bool) -> None:
        """Stop, then land: here if the estimate is lost, else where level floor was observed, else not yet."""
        space = None if m.grid is None else LocalSpace.of(m.grid, m.body, m.position_m)
        if m.now_ns < self._to_floor_until_ns and not is_lost:
            return
        if not m.is_at_rest:
            self._say(f"{why}: brake")
            limits = self._settings.limits
            trajectory = braking(m.start, limits) if space is None else stop(space, m.start, m.body, limits)
            self._follow(m, trajectory, self._turn(m, None))
            return
        place = None if space is None else landing_place(space, m.position_m, m.body)
        if is_lost or (place is not None and np.linalg.norm(place - m.position_m) < _NEAR_M):
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

    def _land(self, m: Moment, why: str) -> None:
        """Descend and stop the rotors, once the vehicle is at rest."""
        if not m.is_at_rest:
            self._follow(m, braking(m.start, self._settings.limits), self._turn(m, None))
            return
        self._say(why)
        course, above = self._course, moved(m.T_world_odom, m.position_m)
        down = straight(above, np.append(above[:2], self._stand[2] - _SINK_M), _DESCENT_M_S)
        course.follow(Motion.of(down, self._turn(m, None), m.begins_ns, course.interval_ns))
        self._stop_rotors(course.decided_until_ns)
        self._is_landing = True

    def _stop_rotors(self, t_ns: int) -> None:
        """Stop the rotors at a time [ns], and end the flight soon after."""
        self._course.stop_rotors(t_ns)
        self._ends_ns, self._is_landing = t_ns + _REST_NS, False

    def _turn(self, m: Moment, toward_rad: float | None) -> Turn:
        """Return the turn toward a heading in the odometry frame, or to rest."""
        bounds = self._settings.limits.yaw_rate_rad_s, _YAW_ACCEL_RAD_S2
        if toward_rad is None:
            angle = 0.5 * m.yaw_rate_rad_s * abs(m.yaw_rate_rad_s) / _YAW_ACCEL_RAD_S2
            return Turn(m.yaw_rad, m.yaw_rate_rad_s, angle, *bounds)
        target = toward_rad + float(yaw_rad_from_matrix(m.T_world_odom[:3, :3]))
        return Turn.toward(m.yaw_rad, m.yaw_rate_rad_s, target, *bounds)

    def _follow(self, m: Moment, trajectory: CorridorTrajectory, turn: Turn) -> None:
        """Follow a trajectory of the odometry frame."""
        course = self._course
        in_world = replace(trajectory, control_points=moved(m.T_world_odom, trajectory.control_points))
        motion = Motion.of(in_world, turn, m.begins_ns, course.interval_ns)
        course.follow(motion)
        placed = self._route.placed(m)
        path = np.zeros((0, 3)) if placed is None else placed
        every = max(round(1e8 / course.interval_ns), 1)
        self.plans.append(Plan(m.begins_ns, motion.states[::every, 0], moved(m.T_world_odom, path)))

    def _say(self, what: str) -> None:
        """Record a decision, unless it is the last one again."""
        if not self.decisions or self.decisions[-1].what != what:
            x, y, z = self._course.planned(self._course.now_ns)[0][0].tolist()
            self.decisions.append(Decision(self._course.now_ns, what, (x, y, z)))


def _view_rad(m: Moment, target: Target) -> float | None:
    """Return the heading of a view in the odometry frame, None if it does not matter."""
    if target.yaw_map_rad is None:
        return None
    return target.yaw_map_rad - float(yaw_rad_from_matrix(m.T_map_odom[:3, :3]))
