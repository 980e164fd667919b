"""Figures of the experiments of the book."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib.image
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from dronevio.estimator.book.imu import ImuExperiment
from dronevio.estimator.book.sfm import SfmExperiment
from dronevio.eval.colours import AXES, ESTIMATE, SIGMA, SURROUNDINGS, TRUTH
from dronevio.models.imu import Times
from dronevio.models.rotation import inverse_pose

Array = npt.NDArray[np.float64]

_DPI = 120
_TRIAD_M = 0.4
_LABEL_OFFSET_M = 0.3
_BOX_SCALE = 1.15  # compensates the wide margins of Matplotlib around a 3D box
_OUTLIER_DEVIATIONS = 6.0  # points farther from the median than this many median deviations are not drawn
_FRUSTUM_DEPTH = 0.2
_T_VIEW_CAM = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def draw_imu_path(experiment: ImuExperiment, path: Path) -> None:
    """Draw the loop in 3D: the true path, the initial values, and the estimated states with their axes."""
    figure = Figure(figsize=(8.0, 7.0), layout="constrained")
    axes = _axes_3d(figure, 111)
    estimated = experiment.Ts_world_imu[:, :3, 3]
    initial = experiment.Ts_world_imu_initial[:, :3, 3]
    axes.plot(*experiment.path_m.T, color=TRUTH, label=f"true path, radius {experiment.flight.radius_m:.2f} m")
    axes.scatter(
        *initial.T, color=SURROUNDINGS, marker="x", s=40, label=f"initial values, error {experiment.initial_error:.3g}"
    )
    axes.scatter(*estimated.T, color=ESTIMATE, s=30, label=f"estimate, error {experiment.final_error:.1g}")
    for axis, colour in enumerate(AXES):
        tips = estimated + _TRIAD_M * experiment.Ts_world_imu[:, :3, axis]
        axes.add_collection3d(Line3DCollection(np.stack([estimated, tips], axis=1), colors=colour, linewidths=1.5))
    for i, p in enumerate(estimated):
        inwards = _LABEL_OFFSET_M * experiment.Ts_world_imu[i, :3, 2]
        axes.text(*(p - inwards), f"$x_{{{i}}}$", color=ESTIMATE, ha="center", va="center")
    _equal_box(axes, np.concatenate([experiment.path_m, estimated, initial]))
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]", title="Dead reckoning on a loop")
    axes.yaxis.set_major_locator(MaxNLocator(3))
    axes.view_init(elev=18.0, azim=-70.0)
    axes.legend(loc="upper left")
    figure.savefig(path, dpi=_DPI)


def draw_factor_graph(factors: Sequence[Sequence[str]], path: Path) -> None:
    """Draw a factor graph with poses x, velocities v and biases b in three rows.

    Args:
        factors: Names of the variables that each factor connects.
        path: PNG file to write.
    """
    names = sorted({name for factor in factors for name in factor})
    positions = {name: _variable_position(name, names) for name in names}
    states = max(int(name[1:]) for name in names) + 1
    figure = Figure(figsize=(1.2 * states + 1.0, 4.2), layout="constrained")
    axes: Axes = figure.add_subplot(111)
    for factor in factors:
        ends = {name: positions[name] for name in factor}
        centre = _prior_position(ends[factor[0]]) if len(factor) == 1 else _motion_position(ends)
        for name, end in ends.items():
            axes.plot(
                *np.transpose([centre, end]), color=SURROUNDINGS, linewidth=0.8 if name[0] == "b" else 1.3, zorder=1
            )
        axes.plot(*centre, "o" if len(factor) == 1 else "s", color="black", markersize=6, zorder=3)
    colours = {"x": ESTIMATE, "v": SIGMA, "b": TRUTH}
    for name, (x, y) in positions.items():
        axes.plot(x, y, "o", markersize=28, markerfacecolor="white", markeredgecolor=colours[name[0]], zorder=2)
        axes.text(x, y, f"${name[0]}_{{{name[1:]}}}$", ha="center", va="center", fontsize=13, zorder=4)
    axes.set(
        xlim=(-0.8, states - 0.5), ylim=(-0.5, 2.5), title="■ IMU factors   ● priors   x poses   v velocities   b bias"
    )
    axes.axis("off")
    figure.savefig(path, dpi=_DPI)


def draw_sfm_cloud(experiment: SfmExperiment, path: Path) -> None:
    """Draw the coloured points and the camera frusta in 3D, beside a photograph with its observations."""
    figure = Figure(figsize=(13.0, 5.2), layout="constrained")
    cloud, photograph = _axes_3d(figure, 121), figure.add_subplot(122)
    _draw_cloud(cloud, experiment)
    _draw_photograph(photograph, experiment, camera=len(experiment.photographs) // 2)
    figure.suptitle(
        f"Villa Balbianello: {len(experiment.photographs)} cameras, {len(experiment.points)} points, "
        f"error {experiment.initial_error:.1f} → {experiment.final_error:.1f}"
    )
    figure.savefig(path, dpi=_DPI)


def frustum(T_world_cam: Array, focal_px: float, width_px: int, height_px: int, depth: float) -> Array:
    """Return the eight edges (8, 2, 3) of a camera frustum in the world frame.

    Args:
        T_world_cam: (4, 4) Pose of the camera.
        focal_px: Focal length [px].
        width_px: Width of the image [px].
        height_px: Height of the image [px].
        depth: Depth of the image plane, in the unit of the pose.
    """
    half = 0.5 * np.array([width_px, height_px]) / focal_px * depth
    corners = np.column_stack([np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half, np.full(4, depth)])
    world = corners @ T_world_cam[:3, :3].T + T_world_cam[:3, 3]
    sides = np.stack([np.broadcast_to(T_world_cam[:3, 3], (4, 3)), world], axis=1)
    return np.concatenate([sides, np.stack([world, np.roll(world, -1, axis=0)], axis=1)])


def _draw_cloud(axes: Axes3D, experiment: SfmExperiment) -> None:
    """Draw points and frusta in the axes of the first camera: right, forward, up."""
    T_view_world = _T_VIEW_CAM @ inverse_pose(experiment.Ts_world_cam[0])
    points = experiment.points @ T_view_world[:3, :3].T + T_view_world[:3, 3]
    median = np.median(points, axis=0)
    deviation = np.median(np.abs(points - median), axis=0)
    kept = np.all(np.abs(points - median) < _OUTLIER_DEVIATIONS * deviation, axis=1)
    axes.scatter(*points[kept].T, c=experiment.colours[kept] / 255.0, s=9, depthshade=False)
    height, width = matplotlib.image.imread(experiment.photographs[0]).shape[:2]
    Ts_view_cam = T_view_world @ experiment.Ts_world_cam
    for T, focal_px in zip(Ts_view_cam, experiment.focal_px, strict=True):
        edges = frustum(T, focal_px, width, height, _FRUSTUM_DEPTH)
        axes.add_collection3d(Line3DCollection(edges, colors=ESTIMATE, linewidths=1.2))
    _equal_box(axes, np.concatenate([points[kept], Ts_view_cam[:, :3, 3]]))
    axes.set(xlabel="right", ylabel="forward", zlabel="up")
    axes.set_title(f"{kept.sum()} points and the camera frusta")
    axes.zaxis.set_major_locator(MaxNLocator(4))
    axes.view_init(elev=24.0, azim=-115.0)


def _draw_photograph(axes: Axes, experiment: SfmExperiment, camera: int) -> None:
    image = matplotlib.image.imread(experiment.photographs[camera])
    centre = 0.5 * np.array([image.shape[1], image.shape[0]])
    observed = experiment.observation_camera == camera
    axes.imshow(image)
    x, y = (experiment.observed_px[observed] + centre).T
    axes.scatter(x, y, s=28, facecolors="none", edgecolors=SIGMA, label="observed")
    x, y = (experiment.reprojected_px[observed] + centre).T
    axes.scatter(x, y, s=4, color=ESTIMATE, label="reprojected")
    axes.set_title(
        f"Photograph {camera + 1}; reprojection error of all observations {experiment.reprojection_rms_px:.2f} px RMS"
    )
    axes.axis("off")
    axes.legend(loc="lower right")


def _variable_position(name: str, names: Sequence[str]) -> Array:
    """Return the position (2,) of a variable: the column of its state, or the middle for a bias, and its kind's row."""
    row = {"x": 2.0, "v": 1.0, "b": 0.0}[name[0]]
    states = max(int(other[1:]) for other in names) + 1
    return np.array([0.5 * (states - 1) if name[0] == "b" else float(name[1:]), row])


def _prior_position(variable: Array) -> Array:
    """Return the position (2,) of a factor on one variable (2,): to its left."""
    return variable - [0.42, 0.0]


def _motion_position(ends: Mapping[str, Array]) -> Array:
    """Return the position (2,) of a factor on two states and the bias: the centre of the states."""
    return np.asarray(np.mean([end for name, end in ends.items() if name[0] != "b"], axis=0))


def _axes_3d(figure: Figure, position: int) -> Axes3D:
    axes = figure.add_subplot(position, projection="3d")
    assert isinstance(axes, Axes3D)
    return axes


def _equal_box(axes: Axes3D, points: Array) -> None:
    """Set limits around points (N, 3) with the same scale on all three axes."""
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.05 * (high - low).max()
    spans = np.maximum(high - low, 0.3 * (high - low).max()) + 2.0 * margin
    centre = 0.5 * (low + high)
    for axis, c, span in zip("xyz", centre, spans, strict=True):
        getattr(axes, f"set_{axis}lim")(c - 0.5 * span, c + 0.5 * span)
    axes.set_box_aspect(spans, zoom=_BOX_SCALE)


def draw_two_paths(t_ns: Times, smoother_m: Array, eqvio_m: Array, path: Path) -> None:
    """Draw two aligned paths from above and from the side, and the distance between them over time.

    Args:
        t_ns: (N,) Time stamps of both paths [ns].
        smoother_m: (N, 3) Positions of the smoother [m].
        eqvio_m: (N, 3) Positions of the filter at the same times, aligned to the smoother [m].
        path: PNG file to write.
    """
    figure = Figure(figsize=(12.0, 7.0), layout="constrained")
    above, side, distance = figure.subplot_mosaic([["above", "side"], ["above", "distance"]]).values()
    for axes, (i, j), title in ((above, (0, 1), "From above"), (side, (0, 2), "From the side")):
        axes.plot(eqvio_m[:, i], eqvio_m[:, j], color=TRUTH, label="EqVIO (GTSAM), a filter")
        axes.plot(smoother_m[:, i], smoother_m[:, j], color=ESTIMATE, label="dronevio, a fixed-lag smoother")
        start = smoother_m[0, [i, j]]
        axes.plot(*start, "o", color=SURROUNDINGS)
        axes.annotate("start", (start[0], start[1]), textcoords="offset points", xytext=(8, -4), color=SURROUNDINGS)
        axes.set(title=title, xlabel="x [m]", ylabel=f"{'xyz'[j]} [m]", aspect="equal")
        axes.grid(alpha=0.3)
    above.legend(loc="best")
    distance.plot((t_ns - t_ns[0]) * 1e-9, 100.0 * np.linalg.norm(smoother_m - eqvio_m, axis=1), color=ESTIMATE)
    distance.set(
        title="Distance between the two",
        xlabel="time since the initialization of the smoother [s]",
        ylabel="distance [cm]",
        ylim=(0, None),
    )
    distance.grid(alpha=0.3)
    figure.suptitle("Half a minute of EuRoC V1_01: real IMU samples, real image features")
    figure.savefig(path, dpi=_DPI)
