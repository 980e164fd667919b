"""How a flight is laid out in rerun's viewer."""

import numpy as np
import numpy.typing as npt
import rerun.blueprint as rrb

from dronevio.models.state import Trajectory

Array = npt.NDArray[np.float64]


class Entities:
    """Where in the recording things are."""

    ROOM = "world/room"
    TRUE_PATH = "world/true_path"
    ESTIMATED_PATH = "world/estimated_path"
    ESTIMATED_BODY = "world/estimated_imu"
    MAP = "world/map"
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
    so_far = rrb.VisibleTimeRanges(
        timeline="time", start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.cursor_relative()
    )
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
            Entities.MAP: so_far,
        },
    )
    errors = rrb.Horizontal(
        _plot("Position error, tied at the first pose [m]", Entities.POSITION_ERROR),
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


def _plot(name: str, origin: str) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(origin=origin, name=name, plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop))


def _eye(outline: Array, estimate: Trajectory, truth: Trajectory | None) -> rrb.EyeControls3D:
    """Look at the middle of the scene from a corner above, from so far that all of it is in view."""
    points = [outline.reshape(-1, 3), estimate.p_world_imu, *([truth.p_world_imu] if truth is not None else [])]
    scene = np.concatenate(points)
    if len(scene) == 0:
        return rrb.EyeControls3D()
    low, high = scene.min(axis=0), scene.max(axis=0)
    target = 0.5 * (low + high)
    distance_m = 0.95 * max(float(np.linalg.norm(high - low)), 1.0)
    direction = np.array([-0.55, -0.62, 0.56])
    return rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=target + distance_m * direction,
        look_target=target,
        eye_up=[0.0, 0.0, 1.0],
    )
