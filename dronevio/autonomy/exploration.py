"""Flights through unknown worlds on the drone's own estimate: sensors, estimate, map, plan and control in one process.

The truth moves the vehicle, draws the goal and scores the flight. The pilot receives frames, IMU samples and the goal.
"""

import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from dronevio.autonomy.goals import HOVER_M, drawn_goal, reachable_places, shortest_m
from dronevio.autonomy.pilot.explorer import Explorer, FlightListener, Outcome
from dronevio.autonomy.pilot.flight_log import Decision, Plan, StageTimes, TimedFrames
from dronevio.autonomy.pilot.moment import moved
from dronevio.autonomy.pilot.tasks import Cover, ReachGoal, Task
from dronevio.autonomy.planning.body import Body
from dronevio.autonomy.ray_sensing import DriftingOdometry, RayCameras, RaySensing
from dronevio.autonomy.settings import ExploreSettings
from dronevio.autonomy.true_map import true_map
from dronevio.estimator.mapping.depth_source import DepthSource
from dronevio.estimator.odometry import VisualInertialOdometry
from dronevio.estimator.slam.visual_slam import VisualSlam
from dronevio.estimators.driver import TimedEstimator
from dronevio.eval.metrics.scores import score_trajectory
from dronevio.eval.run import EstimatorRun
from dronevio.models.arrays import Array
from dronevio.models.depth import DepthImage
from dronevio.models.errors import ConfigError, EvaluationError
from dronevio.models.occupancy import FREE, OccupancyGrid, PlacedSubmap
from dronevio.models.progress import Progress, notebook_line
from dronevio.models.protocols import Estimator
from dronevio.models.rig_presets import rig_named
from dronevio.models.rotation import inverse_pose
from dronevio.models.state import CameraFrame, Estimate
from dronevio.recording.recorder import cameras_of
from dronevio.sim.closed_loop.flight import fly_closed_loop
from dronevio.sim.closed_loop.frame_source import FrameSource
from dronevio.sim.flight import Flight
from dronevio.sim.paths.plan import FlightPlan
from dronevio.sim.scenario import Scenario
from dronevio.sim.scenarios import SCENARIOS, scenario_named
from dronevio.sim.world import WORLDS, flight_area, resolved_world, solid_space
from dronevio.sim.worlds.own.names import FORMS, file_stem, is_file, is_python

TaskName = Literal["reach", "cover"]
"""What a flight is for."""
LONGEST_S = 120.0
"""Default duration after which a flight to a goal ends [s]."""
RIG = "euroc-stereo"
"""Default sensors."""

_STEP_S = 0.05  # between the points whose distances make the length of the path


@dataclass(frozen=True)
class ExplorationScores:
    """How a flight ended, by the truth."""

    outcome: Outcome
    """How it ended: as the pilot says, or by a collision or the time."""
    collided: bool
    """Whether the vehicle touched anything but the ground with its feet."""
    distance_to_goal_m: float | None
    """True distance from the goal at the end [m]; None without a goal."""
    path_m: float
    """Length of the true path after take-off and turns [m]."""
    shortest_m: float | None
    """Length of the shortest path to the goal on the true map [m]; inf without one, None without a goal."""
    time_s: float
    """Duration of the flight [s]."""
    covered_share: float
    """Share of the places that the body reaches in the true world that the map knows to be free."""
    ate_m: float | None
    """Absolute trajectory error of the estimate (RMSE) [m]; None without a pose."""
    median_speed_m_s: float
    """Median true speed while it is more than 0.2 m/s, after take-off and turns [m/s]."""


@dataclass(frozen=True, eq=False)
class Exploration:
    """A flight through an unknown world."""

    scenario: Scenario
    """World, sensors and vehicle."""
    goal_m: Array | None
    """(3,) Goal in the world [m]; None for coverage."""
    scores: ExplorationScores
    """How the flight ended."""
    flight: Flight
    """The true flight, without its images."""
    run: EstimatorRun
    """The estimates of all frames, and their cost."""
    occupancy: OccupancyGrid | None
    """What is free, occupied and unknown at the end, in the map frame; None without depth."""
    submaps: tuple[PlacedSubmap, ...]
    """The parts of the map."""
    T_world_map: Array
    """(4, 4) Pose of the map frame in the world, by the known pose of the pad."""
    decisions: tuple[Decision, ...]
    """What the pilot decided."""
    plans: tuple[Plan, ...]
    """The trajectories that were flown, in the order of time."""
    coverage: Array
    """(N, 2) Times on the clock of the course [s], and the `covered_share` then; about once a second."""
    times: StageTimes
    """Processor times of depth, map and plan."""
    cpu_s: float
    """Processor time of physics, estimator with its map, pilot and controller, but not of rendering [s]."""
    settings: ExploreSettings
    """Settings of the flight."""
    waited_ns: int
    """How long the vehicle waited on its pad for the estimator: decisions and plans have times on the clock of the
    course, which stood still meanwhile [ns]."""
    true_pose: bool
    """Whether pilot, map and controller received the true pose."""


@dataclass(frozen=True, eq=False)
class Sensing:
    """How a flight sees: its frames, its estimator, and its source of depth."""

    frames: FrameSource
    """Renders the frames."""
    estimator: Estimator
    """Estimator before its first measurement."""
    depth: DepthSource | None = None
    """Source of depth images; by default from the images of the rig."""


def exploration_scenario(name: str, seed: int = 0, rig: str = RIG) -> Scenario:
    """Return a scenario to explore: that of a world, or a scenario by its name, of which the plan is not flown.

    Args:
        name: Name of a world, see `dronevio.sim.world.resolved_world`, or of a scenario.
        seed: Seed of the world, the goal and the errors of the sensors.
        rig: Sensors; see `rig_named`.

    Raises:
        ConfigError: There is neither such a world nor such a scenario.
    """
    if name in WORLDS or is_file(name) or is_python(name):
        plan, stem = FlightPlan(shape="tour"), file_stem(name)
        world = resolved_world(name)
        return Scenario(f"explore-{stem}-v0", f"a flight through {stem}", plan, world, rig_named(rig), seed=seed)
    if name not in SCENARIOS and f"{name}-v0" not in SCENARIOS:
        raise ConfigError(
            f"{name!r} to explore; expected a scenario or one of the worlds {', '.join((*WORLDS, *FORMS))}"
        )
    return replace(scenario_named(name, seed), rig=rig_named(rig))


def explore(
    scenario: str | Scenario = "office",
    goal: Sequence[float] | None = None,
    *,
    task: TaskName = "reach",
    seed: int = 0,
    longest_s: float = LONGEST_S,
    settings: ExploreSettings | None = None,
    slam: bool = True,
    true_pose: bool = False,
    without_images: RaySensing | None = None,
    listeners: Sequence[FlightListener] = (),
    on_frame: Callable[[CameraFrame], None] = lambda frame: None,
    progress: Progress | None = None,
) -> Exploration:
    """Fly through an unknown world on the drone's own estimate, to a goal or to see all that can be reached.

    Args:
        scenario: A scenario, or the name of a world or of a scenario.
        goal: (3,) Goal in the world [m]; by default one behind obstacles, drawn by the seed.
        task: ``reach`` the goal, or ``cover`` the world: fly to where most of what is unknown will be seen, within
            the bounds of its flight space.
        seed: Seed of a named scenario.
        longest_s: Duration after which the flight ends [s].
        settings: Settings of mapping, planning and flight.
        slam: Whether loops correct the map and with it goal and route; otherwise they drift as the odometry does.
        true_pose: Whether pilot, map and controller receive the true pose in place of the estimate, which is an upper
            bound.
        without_images: Errors of depth along rays and of a drifting odometry, in place of images and estimator.
        listeners: Receive the depth images, and the pilot, while the map grows.
        on_frame: Receives every frame.
        progress: Called with the number of completed control steps and their total; by default, a notebook shows it.

    Returns:
        The flight. The same arguments give the same flight on the same kind of processor.

    Raises:
        ConfigError: An argument is wrong, or the world has no goal behind obstacles.
        GraphicsError: There is no off-screen OpenGL.
    """
    flown = exploration_scenario(scenario, seed) if isinstance(scenario, str) else scenario
    where = None if task == "cover" else goal_in(flown, goal)
    progress = progress or notebook_line("flying")
    if task == "cover" and goal is not None:
        raise ConfigError(f"goal = {goal} for the task cover; expected no goal")
    if without_images is not None:
        cameras = RayCameras(flown.world, flown.seed_of_world, flown.rig, flown.seed, without_images)
        sensing = Sensing(cameras, DriftingOdometry(cameras, flown.seed, without_images), cameras)
        return _flown(flown, where, longest_s, settings, sensing, true_pose, listeners, on_frame, progress)
    with closing(cameras_of(flown)) as rendered:
        estimator = VisualSlam(flown.rig) if slam else VisualInertialOdometry(flown.rig)
        sensing = Sensing(rendered, estimator)
        return _flown(flown, where, longest_s, settings, sensing, true_pose, listeners, on_frame, progress)


def goal_in(scenario: Scenario, goal: Sequence[float] | None) -> Array:
    """Return a goal (3,) of a scenario [m], by default the one that is drawn by the seed.

    Raises:
        ConfigError: It is not three finite numbers, or the world has no goal behind obstacles.
    """
    where = np.array(
        drawn_goal(scenario.world, scenario.seed_of_world, scenario.seed) if goal is None else goal, np.float64
    )
    if where.shape != (3,) or not np.isfinite(where).all():
        raise ConfigError(f"goal = {goal}; expected three finite numbers [m]")
    return where


def _flown(
    scenario: Scenario,
    goal: Array | None,
    longest_s: float,
    settings: ExploreSettings | None,
    sensing: Sensing,
    true_pose: bool,
    listeners: Sequence[FlightListener],
    on_frame: Callable[[CameraFrame], None],
    progress: Progress,
) -> Exploration:
    """Fly and score."""
    settings = settings or ExploreSettings()
    covering = _Coverage(scenario, settings.body)
    space = flight_area(scenario.world, scenario.seed_of_world).space
    area = np.stack([space.low, space.high])
    task: Task = Cover(area, settings.views) if goal is None else ReachGoal(goal)
    pilot = Explorer(task, longest_s, settings, sensing.depth, (*listeners, covering))
    estimator, frames = TimedEstimator(sensing.estimator), TimedFrames(sensing.frames, pilot.times.rendering)
    began = time.process_time()
    flight = fly_closed_loop(
        scenario, estimator, frames, progress=progress, on_frame=on_frame, pilot=pilot, true_state=true_pose
    )
    cpu_s = time.process_time() - began - 1e-3 * sum(pilot.times.rendering + pilot.times.listeners)
    run = estimator.run
    if isinstance(sensing.estimator, VisualSlam):
        cpu_s += sensing.estimator.map_cost.worker_cpu_s
        run = replace(run, map=sensing.estimator.final_map())
    mapper = pilot.mapper
    T_world_map = np.eye(4) if pilot.T_world_odom is None else pilot.T_world_odom
    occupancy = mapper.fused()
    # The clock of the course stands still while the vehicle waits on its pad.
    waited_ns = int(flight.truth.t_ns[-1]) - pilot.now_ns
    covered_share = covering.share(occupancy, T_world_map)
    scores = _scores(scenario, goal, settings.body, flight, run, pilot, waited_ns, covered_share)
    submaps, decisions, plans = mapper.submaps, tuple(pilot.decisions), tuple(pilot.plans)
    mapper.close()
    return Exploration(
        scenario,
        goal,
        scores,
        flight,
        run,
        occupancy,
        submaps,
        T_world_map,
        decisions,
        plans,
        np.array(covering.shares).reshape(-1, 2),
        pilot.times,
        cpu_s,
        settings,
        waited_ns,
        true_pose,
    )


def _scores(
    scenario: Scenario,
    goal: Array | None,
    body: Body,
    flight: Flight,
    run: EstimatorRun,
    pilot: Explorer,
    waited_ns: int,
    covered_share: float,
) -> ExplorationScores:
    """Return the scores of a flight by the truth."""
    truth = flight.truth
    rig = flight.true_rig
    lever = rig.T_vehicle_imu[:3, :3].T @ rig.T_vehicle_imu[:3, 3]
    position = truth.p_world_imu - truth.rotations @ lever
    under_way = truth.t_ns >= pilot.departs_ns + waited_ns
    stride = max(round(_STEP_S * rig.imu.rate_hz), 1)
    steps = np.diff(position[under_way][::stride], axis=0)
    assert truth.velocity_m_s is not None
    speed = np.linalg.norm(truth.velocity_m_s[under_way], axis=1)
    outcome: Outcome = pilot.outcome or "timeout"
    try:
        ate_m = float(score_trajectory(truth, run.trajectory).scores.ate_m.rmse)
    except EvaluationError:
        ate_m = None
    return ExplorationScores(
        outcome="collision" if flight.collision is not None else outcome,
        collided=flight.collision is not None,
        distance_to_goal_m=None if goal is None else float(np.linalg.norm(position[-1] - goal)),
        path_m=float(np.linalg.norm(steps, axis=1).sum()),
        shortest_m=None if goal is None else _shortest_m(scenario, goal, body),
        time_s=float(truth.t_s[-1]),
        covered_share=covered_share,
        ate_m=ate_m,
        median_speed_m_s=float(np.median(speed[speed > 0.2])) if np.any(speed > 0.2) else 0.0,
    )


def _start_of(scenario: Scenario) -> Array:
    """Return where a flight begins (3,) above the pad [m]."""
    return np.asarray(flight_area(scenario.world, scenario.seed_of_world).pad + [0.0, 0.0, HOVER_M])


def _shortest_m(scenario: Scenario, goal: Array, body: Body) -> float:
    """Return the length of the shortest path of a body to a goal (3,) on the true map [m]."""
    grid = true_map(solid_space(scenario.world, scenario.seed_of_world))
    return shortest_m(grid, _start_of(scenario), goal, body)


class _Coverage:
    """Measures once a second how much of the places that the body reaches in truth is known to be free."""

    def __init__(self, scenario: Scenario, body: Body) -> None:
        """Find the places that a body reaches."""
        self._places = reachable_places(scenario.world, scenario.seed_of_world, _start_of(scenario), body)
        self.shares: list[tuple[float, float]] = []

    def __call__(self, depth: DepthImage, estimate: Estimate, pilot: Explorer) -> None:
        """Measure, if a second has passed; implements `FlightListener`."""
        now_s = 1e-9 * pilot.now_ns
        if pilot.T_world_odom is not None and (not self.shares or now_s >= self.shares[-1][0] + 1.0):
            self.shares.append((now_s, self.share(pilot.mapper.fused(), pilot.T_world_odom)))

    def share(self, occupancy: OccupancyGrid | None, T_world_map: Array) -> float:
        """Return the share of the places that a map knows to be free."""
        if occupancy is None or not len(self._places):
            return 0.0
        return float(np.mean(occupancy.at(moved(inverse_pose(T_world_map), self._places)) == FREE))
