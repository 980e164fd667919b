"""How a flight is laid out in rerun's viewer."""

import numpy as np
import numpy.typing as npt
import rerun.blueprint as rrb

from dronevio.models.state import Trajectory

Array = npt.NDArray[np.float64]

VIEWER_FIELD_OF_VIEW_RAD = np.radians(55.0)  # rerun's, from top to bottom
VIEW_ASPECT = 1.6  # the 3D view's width by its height, a little less than in a 16:10 window
MARGIN = 1.04


class Entities:
    """Where in the recording things are."""

    ROOM = "world/room"
    TRUE_PATH = "world/true_path"
    ESTIMATED_PATH = "world/estimated_path"
    ESTIMATED_BODY = "world/estimated_imu"
    MAP = "world/map/all"
    MAP_IN_SIGHT = "world/map/in_sight"
    CAMERA = "world/camera"
    IMAGE = "world/camera/image"
    TRACKS = "world/camera/image/tracks"
    EVENTS = "events"
    GYRO = "imu/gyroscope"
    ACCEL = "imu/accelerometer"
    GYRO_BIAS = "bias/gyroscope"
    ACCEL_BIAS = "bias/accelerometer"
    SPEED = "speed"
    POSITION_ERROR = "error/position"
    ORIENTATION_ERROR = "error/orientation"
    COST = "cost/cpu"
    TRACK_COUNT = "cost/tracks"


def flight_blueprint(outline: Array, estimate: Trajectory, truth: Trajectory | None) -> rrb.Blueprint:
    """Return the layout: the world on the left, what was seen and felt on the right."""
    beginning, end = rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.infinite()
    so_far = rrb.VisibleTimeRanges(timeline="time", start=beginning, end=rrb.TimeRangeBoundary.cursor_relative())
    always = rrb.VisibleTimeRanges(timeline="time", start=beginning, end=end)
    truth_is_known = truth is not None
    world = rrb.Spatial3DView(
        origin="world",
        name="World: estimate laid on the truth by yaw and position" if truth_is_known else "World of the estimator",
        eye_controls=_eye(outline, estimate, truth),
        line_grid=False,
        background=[18, 21, 26],
        contents=["$origin/**", f"- /{Entities.TRACKS}/**"],
        overrides={
            f"{Entities.TRUE_PATH}/flown": so_far,
            f"{Entities.ESTIMATED_PATH}/flown": so_far,
            Entities.MAP: always,
        },
    )
    errors = rrb.Horizontal(
        _plot("Position error [m]", Entities.POSITION_ERROR, rrb.Corner2D.LeftTop),  # it grows
        _plot("Orientation error [°]", Entities.ORIENTATION_ERROR),
    )
    speed = _plot("Speed [m/s]", Entities.SPEED)
    left = [world, errors] if truth_is_known else [world]
    felt = rrb.Tabs(
        rrb.Vertical(
            _plot("Gyroscope [rad/s]", Entities.GYRO), _plot("Accelerometer [m/s²]", Entities.ACCEL), name="IMU"
        ),
        rrb.Vertical(
            _plot("Gyroscope bias [rad/s]", Entities.GYRO_BIAS),
            _plot("Accelerometer bias [m/s²]", Entities.ACCEL_BIAS),
            name="Biases",
        ),
        rrb.Vertical(
            _plot("CPU a frame [ms]", Entities.COST), _plot("Tracks a frame", Entities.TRACK_COUNT), name="Cost"
        ),
        rrb.TextLogView(origin=Entities.EVENTS, name="Events"),
        active_tab=0,
    )
    image = rrb.Spatial2DView(origin=Entities.IMAGE, name="Camera, and tracks from new (blue) to old (yellow)")
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(*left, row_shares=[2.2, 1.0][: len(left)]),
            rrb.Vertical(image, speed, felt, row_shares=[1.7, 0.8, 1.5]),
            column_shares=[1.6, 1.0],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="time", loop_mode="all"),
        auto_views=False,
        auto_layout=False,
    )


def _plot(name: str, origin: str, legend: rrb.Corner2D = rrb.Corner2D.RightTop) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(origin=origin, name=name, plot_legend=rrb.PlotLegend(legend))


def _eye(outline: Array, estimate: Trajectory, truth: Trajectory | None) -> rrb.EyeControls3D:
    """Look at the scene from a corner above, from as near as lets all of it into the view."""
    points = [outline.reshape(-1, 3), estimate.p_world_imu, *([truth.p_world_imu] if truth is not None else [])]
    scene = np.concatenate(points)
    if len(scene) == 0:
        return rrb.EyeControls3D()
    position, target = look_at_all(scene)
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
