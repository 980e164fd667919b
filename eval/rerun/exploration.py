"""A flight through an unknown world: the map grows as in `DenseMapLog`, with plans, routes, decisions and the truth.

The frame `WORLD` is that of the map. What is known in the frame of the true world stands below `TRUTH`, whose transform
is known at the end of the flight. Plans and decisions are logged at the end, too, at the times at which they were made;
a viewer receives them as they come.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from dronevio.eval import colours
from dronevio.eval.exploration import ExploredFlight, TimedDecision
from dronevio.eval.rerun.blueprint import BACKGROUND, TIMELINE, collapsed_panels
from dronevio.eval.rerun.dense_map import ABOVE, DEPTH, IMAGE, PATH_SO_FAR, DenseMapLog
from dronevio.eval.rerun.log import log_surroundings
from dronevio.eval.rerun.sink import Sink
from dronevio.eval.rerun.surroundings import Surroundings
from dronevio.eval.scene import fit_view
from dronevio.models.arrays import Array
from dronevio.models.depth import DepthImage
from dronevio.models.imu import Times
from dronevio.models.occupancy import PlacedSubmap
from dronevio.models.state import Estimate, Trajectory

WORLD = "world"
"""Path of the frame of the map."""
TRUTH = f"{WORLD}/truth"
"""Path of the frame of the true world."""
SURROUNDINGS = f"{TRUTH}/surroundings"
"""Path of the true surfaces, which are not shown unless somebody switches them on."""
TRUE_PATH_SO_FAR = f"{TRUTH}/path_so_far"
"""Path of the true flight up to the time cursor."""
PLAN, ROUTE = f"{TRUTH}/plan", f"{TRUTH}/route"
"""Paths of the trajectory that is flown, and of the route that it follows."""
GOAL, PAD = f"{TRUTH}/goal", f"{TRUTH}/pad"
"""Paths of goal and landing pad."""
DECISIONS, DECISION_PLACES = "decisions", f"{TRUTH}/decisions"
"""Paths of the decisions as text, and of their places."""
SPEED, HEIGHT = "speed", "height"
"""Paths of the plots."""
_GOAL_RADIUS_M, _PAD_HALF_M = 0.15, (0.3, 0.3, 0.02)
_AROUND_M = np.array([2.5, 2.5, 0.0])  # around the places that the 3D view shows
_ELEVATION_DEG = 55.0
_MAX_POINTS = 1500  # of a drawn path: the truth has 200 poses per second


class ExplorationLog:
    """Logs a flight through an unknown world while it is flown."""

    def __init__(self, sink: Sink, pad_m: Array, goal_m: Array | None, *, is_live: bool = False) -> None:
        """Log pad and goal.

        Args:
            sink: Output.
            pad_m: (3,) Landing pad in the world [m].
            goal_m: (3,) Goal in the world [m]; None without one.
            is_live: Whether plans and decisions are logged as they come, rather than at the end.
        """
        self._sink, self._map, self._is_live = sink, DenseMapLog(sink), is_live
        self._decided = 0
        goal = rr.Points3D(
            [] if goal_m is None else [goal_m],
            radii=_GOAL_RADIUS_M,
            colors=colours.rgb(colours.LANDMARKS),
            labels=[] if goal_m is None else ["goal"],
        )
        pad = rr.Boxes3D(
            centers=[pad_m], half_sizes=[_PAD_HALF_M], colors=colours.rgb(colours.SURROUNDINGS), labels="pad"
        )
        sink.static(GOAL, goal)
        sink.static(PAD, pad)

    def depth(self, depth: DepthImage, estimate: Estimate, submaps: Callable[[], Sequence[PlacedSubmap]]) -> None:
        """Add a depth image; see `DenseMapLog.depth`."""
        self._map.depth(depth, estimate, submaps)

    def under_way(
        self, t_ns: int, T_map_world: Array, plan_m: Array, route_m: Array, decisions: Sequence[TimedDecision]
    ) -> None:
        """Add what is decided at a time; a log that is not live leaves it to the end.

        Args:
            t_ns: Time of a frame [ns].
            T_map_world: (4, 4) Pose of the world in the frame of the map.
            plan_m: (N, 3) The trajectory that is flown, in the world [m].
            route_m: (M, 3) Its route [m].
            decisions: All decisions so far.
        """
        if not self._is_live:
            return
        if not self._decided:
            self._log_world(T_map_world)
            self._log_styles()
        for entity, strip in ((PLAN, plan_m), (ROUTE, route_m)):
            self._log_strips(entity, np.array([t_ns]), [strip])
        self._log_decisions(decisions[self._decided :])
        self._decided = len(decisions)

    def finish(self, flight: ExploredFlight, submaps: Sequence[PlacedSubmap], surroundings: Surroundings) -> None:
        """Log the end of the map, and all that is known after the flight.

        Args:
            flight: The flight.
            submaps: The parts of the map.
            surroundings: What is around the drone in truth.
        """
        self._map.close(submaps)
        self._log_world(flight.T_map_world)
        drawn = flight.truth[:: max(1, len(flight.truth) // _MAX_POINTS)]
        log_surroundings(self._sink, surroundings, drawn.t_ns, SURROUNDINGS, f"{SURROUNDINGS}/moving")
        self._log_truth(drawn)
        if not self._is_live:
            self._log_styles()
            self._log_plans(flight)
            self._log_decisions(flight.decisions)
        self._log_plots(flight, drawn)

    def _log_world(self, T_map_world: Array) -> None:
        """Log the pose of the true world in the frame of the map."""
        self._sink.static(TRUTH, rr.Transform3D(translation=T_map_world[:3, 3], mat3x3=T_map_world[:3, :3]))

    def _log_styles(self) -> None:
        """Log how plans, routes and places of decisions are drawn."""
        for entity, colour, width in ((PLAN, colours.PLAN, 3.0), (ROUTE, colours.ROUTE, 1.5)):
            style = rr.LineStrips3D.from_fields(colors=colours.rgb(colour), radii=rr.Radius.ui_points(width))
            self._sink.static(entity, style)
        self._sink.static(DECISION_PLACES, rr.Points3D.from_fields(colors=[255, 255, 255], radii=0.05))

    def _log_truth(self, truth: Trajectory) -> None:
        """Log the true path, which is shown up to the time cursor."""
        rgb, p = colours.rgb(colours.TRUTH), truth.p_world_imu
        self._sink.static(TRUE_PATH_SO_FAR, rr.LineStrips3D.from_fields(colors=rgb, radii=rr.Radius.ui_points(2.0)))
        self._sink.segments(TRUE_PATH_SO_FAR, truth.t_ns[1:], p[:-1], p[1:])

    def _log_plans(self, flight: ExploredFlight) -> None:
        """Log each plan and its route from the time on from which it was flown."""
        t_ns = np.array([plan.t_ns for plan in flight.plans], dtype=np.int64)
        plans = [plan.positions_m for plan in flight.plans]
        routes = [plan.route_m if len(plan.route_m) else plan.positions_m[-1:] for plan in flight.plans]
        self._log_strips(PLAN, t_ns, plans)
        self._log_strips(ROUTE, t_ns, routes)

    def _log_strips(self, entity: str, t_ns: Times, strips: Sequence[Array]) -> None:
        """Log polylines (N, 3), one at each time."""
        if strips:
            columns = rr.LineStrips3D.columns(strips=[strip.astype(np.float32) for strip in strips])
            self._sink.columns(entity, t_ns, columns)

    def _log_decisions(self, decisions: Sequence[TimedDecision]) -> None:
        """Log decisions as text, and the latest one at its place."""
        t_ns = np.array([each.t_ns for each in decisions], dtype=np.int64)
        texts = [each.what for each in decisions]
        if not texts:
            return
        self._sink.columns(DECISIONS, t_ns, rr.TextLog.columns(text=texts, level=["INFO"] * len(texts)))
        positions = np.array([each.position_m for each in decisions], np.float32)
        self._sink.columns(DECISION_PLACES, t_ns, rr.Points3D.columns(positions=positions, labels=texts))

    def _log_plots(self, flight: ExploredFlight, truth: Trajectory) -> None:
        """Log true and estimated speed and height over time."""
        for trajectory, name, colour in (
            (truth, "truth", colours.TRUTH),
            (flight.estimate, "estimate", colours.ESTIMATE),
        ):
            values = {HEIGHT: trajectory.p_world_imu[:, 2]}
            if trajectory.velocity_m_s is not None:
                values[SPEED] = np.linalg.norm(trajectory.velocity_m_s, axis=1)
            for plot, of_plot in values.items():
                self._sink.curve_styles(f"{plot}/{name}", [name], [colour])
                self._sink.values(f"{plot}/{name}", trajectory.t_ns, of_plot)


@contextmanager
def exploration_file(
    path: Path, name: str, pad_m: Array, goal_m: Array | None, *, has_images: bool = True
) -> Iterator[ExplorationLog]:
    """Open the rerun file of a flight, which is complete when the context is left.

    Args:
        path: File to write, with the suffix ``.rrd``.
        name: Name of the flight.
        pad_m: (3,) Landing pad in the world [m].
        goal_m: (3,) Goal in the world [m]; None without one.
        has_images: Whether the depth images belong to camera images.
    """
    places_m = np.stack([pad_m] if goal_m is None else [pad_m, goal_m])
    with Sink.to_file(path, name, _blueprint(has_images, places_m), 0) as sink:
        yield ExplorationLog(sink, pad_m, goal_m)


@contextmanager
def exploration_viewer(
    url: str, name: str, pad_m: Array, goal_m: Array | None, *, has_images: bool = True
) -> Iterator[ExplorationLog]:
    """Show a flight in a viewer while it is flown.

    Args:
        url: Address of the viewer, such as ``rerun+http://127.0.0.1:9876/proxy``.
        name: Name of the flight.
        pad_m: (3,) Landing pad in the world [m].
        goal_m: (3,) Goal in the world [m]; None without one.
        has_images: Whether the depth images belong to camera images.
    """
    with Sink.to_viewer(url, name, _blueprint(has_images, is_live=True), 0) as sink:
        yield ExplorationLog(sink, pad_m, goal_m, is_live=True)


def _blueprint(has_images: bool, places_m: Array | None = None, *, is_live: bool = False) -> rrb.Blueprint:
    """Return the layout: map, plan and paths beside image, depth, decisions and plots.

    Args:
        has_images: Whether there are camera images.
        places_m: (N, 3) Places in the world that the 3D view shows with their surroundings [m]; everything if None.
        is_live: Whether the view follows the newest time.
    """
    cursor = rrb.TimeRangeBoundary.cursor_relative()
    so_far = rrb.VisibleTimeRanges(timeline=TIMELINE, start=rrb.TimeRangeBoundary.infinite(), end=cursor)
    hidden = rrb.EntityBehavior(visible=False)
    eye = None
    if places_m is not None:
        low, high = places_m.min(axis=0) - _AROUND_M, places_m.max(axis=0) + _AROUND_M
        corners = np.stack(np.meshgrid(*np.stack([low, high], axis=1), indexing="ij"), axis=-1).reshape(-1, 3)
        position, target = fit_view(corners, elevation_deg=_ELEVATION_DEG, aspect=1.15)
        kind = rrb.Eye3DKind.Orbital
        eye = rrb.EyeControls3D(kind=kind, position=position, look_target=target, eye_up=[0.0, 0.0, 1.0])
    growing = rrb.Spatial3DView(
        origin=TRUTH,
        contents=f"/{WORLD}/**",
        name="Map: occupied cells by height; plan (orange), route (purple), truth (green), estimate (red)",
        eye_controls=eye,
        line_grid=False,
        background=BACKGROUND,
        overrides={PATH_SO_FAR: so_far, TRUE_PATH_SO_FAR: so_far, ABOVE: hidden, SURROUNDINGS: hidden},
    )
    images: list[rrb.View] = [rrb.Spatial2DView(origin=IMAGE, name="Undistorted image")] if has_images else []
    images.append(rrb.Spatial2DView(origin=DEPTH, name="Depth: near (red) to far (blue)"))
    right = rrb.Vertical(
        *images,
        rrb.TextLogView(origin=DECISIONS, name="Decisions", columns=rrb.TextLogColumns(text_log_columns=["Body"])),
        rrb.TimeSeriesView(origin=SPEED, name="Speed [m/s]"),
        rrb.TimeSeriesView(origin=HEIGHT, name="Height [m]"),
        row_shares=[1.2] * len(images) + [0.8, 0.7, 0.7],
    )
    return rrb.Blueprint(
        rrb.Horizontal(growing, right, column_shares=[2.0, 1.0]),
        *collapsed_panels(is_live),
        auto_views=False,
        auto_layout=False,
    )
