"""Layout of a recording in the rerun viewer: one estimator in detail, or several beside each other."""

from collections.abc import Iterable
from dataclasses import dataclass

import rerun.blueprint as rrb

from dronevio.eval.rerun import entities
from dronevio.eval.rerun.entities import EstimateEntities
from dronevio.eval.scene import fit_view
from dronevio.models.arrays import Array

TIMELINE = "time"
BACKGROUND = [18, 21, 26]
"""Colour of the background of 3D views: red, green, blue."""


def collapsed_panels(is_live: bool) -> tuple[rrb.BlueprintPanel, rrb.SelectionPanel, rrb.TimePanel]:
    """Return the panels of a viewer, collapsed, whose time loops, or follows the newest data of a live view."""
    time = rrb.TimePanel(
        state="collapsed",
        timeline=TIMELINE,
        loop_mode="off" if is_live else "all",
        play_state="following" if is_live else None,
    )
    return rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed"), time


@dataclass(frozen=True)
class RecordingContents:
    """What a recording contains, which determines its layout."""

    names: tuple[str, ...]
    """Names of the estimators."""
    n_cameras: int
    """Number of cameras of the rig."""
    has_truth: bool = True
    """Whether there are a true path and errors."""
    has_frame_estimates: bool = True
    """Whether there are estimates of all frames, with tracks, health, events and costs."""
    has_map: bool = False
    """Whether the estimators have a map that corrects them."""

    @property
    def estimates(self) -> tuple[EstimateEntities, ...]:
        """Paths of the entities of each estimator."""
        return tuple(EstimateEntities(name) for name in self.names)

    @property
    def is_single(self) -> bool:
        """Whether there is only one estimator."""
        return len(self.names) == 1


def flight_blueprint(contents: RecordingContents, points: Array) -> rrb.Blueprint:
    """Return the layout: world and errors on the left, images and sensor data on the right.

    Args:
        contents: What the recording contains.
        points: (N, 3) Points that the 3D view shows [m].
    """
    left: list[rrb.Container | rrb.View] = [_world(contents, points)]
    left += [_errors(contents)] if contents.has_truth else []
    right = [_images(contents), _overview(contents), _details(contents)]
    several_images = contents.n_cameras > 1 and (contents.is_single or not contents.has_frame_estimates)
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(*left, row_shares=[2.2, 1.0][: len(left)]),
            rrb.Vertical(*right, row_shares=[1.0 if several_images else 1.7, 0.8, 1.5]),
            column_shares=[1.6, 1.0],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, loop_mode="all"),
        auto_views=False,
        auto_layout=False,
    )


def _world(contents: RecordingContents, points: Array) -> rrb.Spatial3DView:
    """Return the 3D view, with paths up to the time cursor and all landmarks at all times."""
    beginning, end = rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.infinite()
    so_far = rrb.VisibleTimeRanges(timeline=TIMELINE, start=beginning, end=rrb.TimeRangeBoundary.cursor_relative())
    always = rrb.VisibleTimeRanges(timeline=TIMELINE, start=beginning, end=end)
    title = "World, estimate and truth" if contents.is_single else "World, estimates and truth (white)"
    return rrb.Spatial3DView(
        origin="world",
        name=title if contents.has_truth else "World frame of the estimator",
        eye_controls=_eye_controls(points),
        line_grid=False,
        background=BACKGROUND,
        contents=["$origin/**", f"- /{entities.image(0)}/tracks/**"],
        overrides={
            entities.TRUE_PATH_SO_FAR: so_far,
            **{
                entity: so_far
                for estimate in contents.estimates
                for entity in (
                    estimate.path_so_far,
                    estimate.keyframes,
                    estimate.loops,
                    estimate.event_markers,
                    estimate.map.path_so_far,
                )
            },
            **{estimate.landmarks: always for estimate in contents.estimates},
        },
    )


def _errors(contents: RecordingContents) -> rrb.Horizontal:
    """Return the plots of the errors: of one estimator with 3σ, of several after alignment."""
    corner = rrb.Corner2D.LeftTop  # errors grow towards the right
    if contents.is_single:
        return rrb.Horizontal(
            _plot("Position error [m]", entities.POSITION_ERROR, corner),
            _plot("Orientation error [°]", entities.ORIENTATION_ERROR, corner),
        )
    position = [estimate.position_error.aligned for estimate in contents.estimates]
    orientation = [estimate.orientation_error.aligned for estimate in contents.estimates]
    return rrb.Horizontal(
        _plot("Position error, aligned [m]", entities.POSITION_ERROR, corner, position),
        _plot("Orientation error, aligned [°]", entities.ORIENTATION_ERROR, corner, orientation),
    )


def _images(contents: RecordingContents) -> rrb.Container | rrb.View:
    """Return the views of the cameras; the tracks of several estimators are in tabs."""
    if not contents.has_frame_estimates:
        return _side_by_side([_image(i, f"Camera {i}") for i in range(contents.n_cameras)])
    others = [_image(i, f"Camera {i}") for i in range(1, contents.n_cameras)]
    if contents.is_single:
        title = "Camera, tracks from new (blue) to old (yellow)" if not others else "Camera 0, tracks by age"
        return _side_by_side([_image(0, title, contents.estimates[0]), *others])
    tracks = [_image(0, f"Tracks of {n}", e) for n, e in zip(contents.names, contents.estimates, strict=True)]
    return rrb.Tabs(*tracks, *others, active_tab=0)


def _image(index: int, name: str, estimate: EstimateEntities | None = None) -> rrb.Spatial2DView:
    """Return the view of a camera, with the tracks of an estimator if one is given."""
    tracks = [] if estimate is None else [f"+ /{estimate.tracks}"]
    return rrb.Spatial2DView(origin=entities.image(index), name=name, contents=["$origin", *tracks])


def _side_by_side(views: list[rrb.Container | rrb.View]) -> rrb.Container | rrb.View:
    return views[0] if len(views) == 1 else rrb.Horizontal(*views)


def _overview(contents: RecordingContents) -> rrb.Container | rrb.View:
    """Return the speed of one estimator, or the scores of several."""
    speed = _plot("Speed [m/s]", entities.SPEED)
    if contents.is_single:
        return speed
    return rrb.Tabs(rrb.TextDocumentView(origin=entities.SUMMARY, name="Scores"), speed, active_tab=0)


def _details(contents: RecordingContents) -> rrb.Tabs:
    """Return the tabs with IMU, biases, cost and events."""
    biases = [
        _plot("Gyroscope bias [rad/s]", entities.GYRO_BIAS),
        _plot("Accelerometer bias [m/s²]", entities.ACCEL_BIAS),
    ]
    imu = rrb.Vertical(
        _plot("Gyroscope [rad/s]", entities.GYRO), _plot("Accelerometer [m/s²]", entities.ACCEL), name="IMU"
    )
    if not contents.has_frame_estimates:
        return rrb.Tabs(imu, rrb.Vertical(*biases, name="Biases"), active_tab=0)
    cost = rrb.Vertical(
        _plot("Processor time per frame [ms]", entities.COST),
        _plot("Tracks per frame", entities.TRACK_COUNT),
        name="Cost",
    )
    events = rrb.Vertical(
        rrb.StateTimelineView(origin=entities.HEALTH, name="Health"),
        rrb.TextLogView(origin=entities.EVENTS, name="Event log"),
        row_shares=[1.0, 2.0],
        name="Events",
    )
    order = [*([_map()] if contents.has_map else []), imu, rrb.Vertical(*biases, name="Biases"), cost, events]
    return rrb.Tabs(*(order if contents.is_single else [cost, events, *order[:2]]), active_tab=0)


def _map() -> rrb.Container:
    """Return the plots of the map: its correction of the odometry and the number of loops."""
    return rrb.Vertical(
        _plot("Position of the odometry frame in the map [m]", entities.CORRECTION_POSITION),
        _plot("Yaw of the odometry frame in the map [°]", entities.CORRECTION_YAW),
        _plot("Closed loops", entities.LOOP_COUNT),
        name="Map",
    )


def _plot(
    name: str, origin: str, legend: rrb.Corner2D = rrb.Corner2D.RightTop, curves: Iterable[str] | None = None
) -> rrb.TimeSeriesView:
    """Return a plot of all entities below ``origin``, or of some of them."""
    contents = ["$origin/**"] if curves is None else [f"+ /{curve}" for curve in curves]
    return rrb.TimeSeriesView(origin=origin, name=name, plot_legend=rrb.PlotLegend(legend), contents=contents)


def _eye_controls(points: Array) -> rrb.EyeControls3D:
    """Return the viewpoint of the 3D view, above a corner of the scene at the smallest distance that shows all."""
    if len(points) == 0:
        return rrb.EyeControls3D()
    position, target = fit_view(points)
    return rrb.EyeControls3D(kind=rrb.Eye3DKind.Orbital, position=position, look_target=target, eye_up=[0.0, 0.0, 1.0])
