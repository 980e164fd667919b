"""How a flight is laid out in rerun's viewer: one estimator in depth, or several beside each other."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import rerun.blueprint as rrb

from dronevio.eval.rerun import entities as at
from dronevio.eval.rerun.entities import EstimateEntities

Array = npt.NDArray[np.float64]

VIEWER_FIELD_OF_VIEW_RAD = np.radians(55.0)  # rerun's, from top to bottom
VIEW_ASPECT = 1.6  # the 3D view's width by its height, a little less than in a 16:10 window
MARGIN = 1.04
TIMELINE = "time"
_BACKGROUND = [18, 21, 26]


@dataclass(frozen=True)
class Shown:
    """What there is to lay out."""

    names: tuple[str, ...]
    """The estimators."""
    n_cameras: int
    """Cameras of the rig."""
    truth_is_known: bool = True
    """Whether there is a true path, and errors with it."""
    answers: bool = True
    """Whether estimators answered frame by frame: with tracks, health, events and costs."""

    @property
    def estimates(self) -> tuple[EstimateEntities, ...]:
        """Where the estimators' things are."""
        return tuple(EstimateEntities(name) for name in self.names)

    @property
    def alone(self) -> bool:
        """Whether there is no other estimator to compare one with."""
        return len(self.names) == 1


def flight_blueprint(shown: Shown, points: Array) -> rrb.Blueprint:
    """Return the layout: the world and the errors on the left, what was seen and felt on the right.

    Args:
        shown: What there is.
        points: (N, 3) Places that the 3D view shall show [m].
    """
    left: list[rrb.Container | rrb.View] = [_world(shown, points), *([_errors(shown)] if shown.truth_is_known else [])]
    right = [_images(shown), _in_short(shown), _in_detail(shown)]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(*left, row_shares=[2.2, 1.0][: len(left)]),
            rrb.Vertical(
                *right,
                row_shares=[1.0 if shown.n_cameras > 1 and (shown.alone or not shown.answers) else 1.7, 0.8, 1.5],
            ),
            column_shares=[1.6, 1.0],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, loop_mode="all"),
        auto_views=False,
        auto_layout=False,
    )


def _world(shown: Shown, points: Array) -> rrb.Spatial3DView:
    """Return the view of the world: paths as far as they have been flown, all that was ever mapped."""
    beginning, end = rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.infinite()
    so_far = rrb.VisibleTimeRanges(timeline=TIMELINE, start=beginning, end=rrb.TimeRangeBoundary.cursor_relative())
    always = rrb.VisibleTimeRanges(timeline=TIMELINE, start=beginning, end=end)
    title = "World: estimate laid on the truth" if shown.alone else "World: estimates laid on the truth (white)"
    return rrb.Spatial3DView(
        origin="world",
        name=title if shown.truth_is_known else "World of the estimator",
        eye_controls=_eye(points),
        line_grid=False,
        background=_BACKGROUND,
        contents=["$origin/**", f"- /{at.image(0)}/tracks/**"],
        overrides={
            at.TRUE_FLOWN: so_far,
            **{entity: so_far for e in shown.estimates for entity in (e.flown, e.keyframes, e.loops, e.markers)},
            **{estimate.map: always for estimate in shown.estimates},
        },
    )


def _errors(shown: Shown) -> rrb.Horizontal:
    """Return the plots of the errors: of one estimator with what it claims, of several after alignment."""
    corner = rrb.Corner2D.LeftTop  # they grow
    if shown.alone:
        return rrb.Horizontal(
            _plot("Position error [m]", at.POSITION_ERROR, corner),
            _plot("Orientation error [°]", at.ORIENTATION_ERROR, corner),
        )
    of_position = [estimate.position_error.aligned for estimate in shown.estimates]
    of_orientation = [estimate.orientation_error.aligned for estimate in shown.estimates]
    return rrb.Horizontal(
        _plot("Position error, aligned [m]", at.POSITION_ERROR, corner, of_position),
        _plot("Orientation error, aligned [°]", at.ORIENTATION_ERROR, corner, of_orientation),
    )


def _images(shown: Shown) -> rrb.Container | rrb.View:
    """Return the views of the cameras; several estimators' tracks lie in tabs behind each other."""
    if not shown.answers:
        return _side_by_side([_image(i, f"Camera {i}") for i in range(shown.n_cameras)])
    others = [_image(i, f"Camera {i}") for i in range(1, shown.n_cameras)]
    if shown.alone:
        title = "Camera, and tracks from new (blue) to old (yellow)" if not others else "Camera 0, tracks by age"
        return _side_by_side([_image(0, title, shown.estimates[0]), *others])
    followed = [_image(0, f"Tracks of {n}", e) for n, e in zip(shown.names, shown.estimates, strict=True)]
    return rrb.Tabs(*followed, *others, active_tab=0)


def _image(index: int, name: str, estimate: EstimateEntities | None = None) -> rrb.Spatial2DView:
    """Return the view of a camera, with what an estimator follows in it."""
    tracks = [] if estimate is None else [f"+ /{estimate.tracks}"]
    return rrb.Spatial2DView(origin=at.image(index), name=name, contents=["$origin", *tracks])


def _side_by_side(views: list[rrb.Container | rrb.View]) -> rrb.Container | rrb.View:
    return views[0] if len(views) == 1 else rrb.Horizontal(*views)


def _in_short(shown: Shown) -> rrb.Container | rrb.View:
    """Return what is looked at first: the speed of one, the scores of several."""
    speed = _plot("Speed [m/s]", at.SPEED)
    if shown.alone:
        return speed
    return rrb.Tabs(rrb.TextDocumentView(origin=at.SUMMARY, name="Scores"), speed, active_tab=0)


def _in_detail(shown: Shown) -> rrb.Tabs:
    """Return the tabs of what can be looked up."""
    biases = [_plot("Gyroscope bias [rad/s]", at.GYRO_BIAS), _plot("Accelerometer bias [m/s²]", at.ACCEL_BIAS)]
    imu = rrb.Vertical(_plot("Gyroscope [rad/s]", at.GYRO), _plot("Accelerometer [m/s²]", at.ACCEL), name="IMU")
    if not shown.answers:
        return rrb.Tabs(imu, rrb.Vertical(*biases, name="Biases"), active_tab=0)
    costs = rrb.Vertical(_plot("CPU a frame [ms]", at.COST), _plot("Tracks a frame", at.TRACK_COUNT), name="Cost")
    said = rrb.Vertical(
        rrb.StateTimelineView(origin=at.HEALTH, name="Health"),
        rrb.TextLogView(origin=at.EVENTS, name="What happened"),
        row_shares=[1.0, 2.0],
        name="Events",
    )
    order = [imu, rrb.Vertical(*biases, name="Biases"), costs, said]
    return rrb.Tabs(*(order if shown.alone else [costs, said, *order[:2]]), active_tab=0)


def _plot(
    name: str, origin: str, legend: rrb.Corner2D = rrb.Corner2D.RightTop, curves: Iterable[str] | None = None
) -> rrb.TimeSeriesView:
    """Return a plot of all that lies below ``origin``, or of some of it."""
    contents = ["$origin/**"] if curves is None else [f"+ /{curve}" for curve in curves]
    return rrb.TimeSeriesView(origin=origin, name=name, plot_legend=rrb.PlotLegend(legend), contents=contents)


def _eye(points: Array) -> rrb.EyeControls3D:
    """Look at the scene from a corner above, from as near as lets all of it into the view."""
    if len(points) == 0:
        return rrb.EyeControls3D()
    position, target = look_at_all(points)
    return rrb.EyeControls3D(kind=rrb.Eye3DKind.Orbital, position=position, look_target=target, eye_up=[0.0, 0.0, 1.0])


def look_at_all(points: Array, azimuth_deg: float = 40.0, elevation_deg: float = 38.0) -> tuple[Array, Array]:
    """Return from where (3,) and whither (3,) to look, so that points (N, 3) fill the 3D view [m].

    Seen from a distance D, a point h above the middle of the picture and d nearer to the eye than the middle is in view
    if |h| ≤ (D − d) tan(fov / 2), and so for the width. The nearest eye is the least D that serves all points.
    """
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    back = np.array([-np.cos(elevation) * np.cos(azimuth), -np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    up = np.cross(back, right)
    target = 0.5 * (points.min(axis=0) + points.max(axis=0))
    tangent = np.tan(0.5 * VIEWER_FIELD_OF_VIEW_RAD) * np.array([VIEW_ASPECT, 1.0])
    axes = np.stack([right, up])

    def nearest_m(across: Array, depth: Array) -> float:
        return max(1.0, MARGIN * float(np.max(np.abs(across) / tangent + depth[:, None])))

    for _ in range(10):  # what is near looks larger: move the picture's middle to the middle, look again
        across, depth = (points - target) @ axes.T, (points - target) @ back
        distance_m = nearest_m(across, depth)
        seen = across / (distance_m - depth[:, None])
        target = target + 0.5 * (seen.min(axis=0) + seen.max(axis=0)) * distance_m @ axes
    return target + nearest_m((points - target) @ axes.T, (points - target) @ back) * back, target
