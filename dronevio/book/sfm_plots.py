"""Figures of the experiment ``dronevio book sfm``."""

import matplotlib.image
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from dronevio.estimator.book.sfm import SfmExperiment
from dronevio.eval.colours import ESTIMATE, SIGMA
from dronevio.models.arrays import Array
from dronevio.models.rotation import inverse_pose

_BOX_SCALE = 1.15  # compensates the wide margins of Matplotlib around a 3D box
_OUTLIER_DEVIATIONS = 6.0  # points farther from the median than this many median deviations are not drawn
FRUSTUM_DEPTH = 0.2
"""Distance of a drawn image plane from its camera, in units of the reconstruction."""
T_VIEW_CAM = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""(4, 4) Pose of the first camera in the frame of the drawings: x right, y forward, z up."""


def draw_sfm_cloud(experiment: SfmExperiment) -> Figure:
    """Draw points and cameras in 3D, and a photograph with its observations, before and after the adjustment."""
    figure = Figure(figsize=(13.0, 9.6), layout="constrained")
    camera = len(experiment.photographs) // 2
    before, after = (_axes_3d(figure, position) for position in (221, 223))
    T_view_world = T_VIEW_CAM @ inverse_pose(experiment.Ts_world_cam[0])
    kept = inliers(transformed(T_view_world, experiment.points))
    shown = np.concatenate([experiment.points[kept], experiment.Ts_world_cam[:, :3, 3]])
    for axes, points, Ts_world_cam, title in (
        (before, experiment.points_initial, experiment.Ts_world_cam_initial, "Before"),
        (after, experiment.points, experiment.Ts_world_cam, "After"),
    ):
        axes.scatter(
            *transformed(T_view_world, points[kept]).T, c=experiment.colours[kept] / 255.0, s=9, depthshade=False
        )
        _draw_frusta(axes, experiment, T_view_world @ Ts_world_cam)
        _equal_box(axes, transformed(T_view_world, shown))
        axes.set(xlabel="right", ylabel="forward", zlabel="up", title=f"{title}: {kept.sum()} points, camera frusta")
        axes.zaxis.set_major_locator(MaxNLocator(4))
        axes.view_init(elev=24.0, azim=-115.0)
    for position, pixels, rms_px, error, title in (
        (
            222,
            experiment.initially_reprojected_px,
            experiment.initial_reprojection_rms_px,
            experiment.initial_error,
            "Before",
        ),
        (224, experiment.reprojected_px, experiment.reprojection_rms_px, experiment.final_error, "After"),
    ):
        axes = figure.add_subplot(position)
        _draw_photograph(axes, experiment, camera, pixels)
        axes.set_title(f"{title}: error {error:.1f}, reprojection error {rms_px:.2f} px RMS")
    figure.suptitle(
        f"Villa Balbianello: bundle adjustment of {len(experiment.photographs)} cameras and {len(experiment.points)} "
        f"points; photograph {camera + 1}"
    )
    return figure


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


def transformed(T: Array, points: Array) -> Array:
    """Return the points (N, 3) in another frame."""
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


def inliers(points: Array) -> npt.NDArray[np.bool_]:
    """Return which of the points (N, 3) are not far from all others."""
    median = np.median(points, axis=0)
    deviation = np.median(np.abs(points - median), axis=0)
    return np.asarray(np.all(np.abs(points - median) < _OUTLIER_DEVIATIONS * deviation, axis=1))


def _draw_frusta(axes: Axes3D, experiment: SfmExperiment, Ts_view_cam: Array) -> None:
    height, width = matplotlib.image.imread(experiment.photographs[0]).shape[:2]
    for T, focal_px in zip(Ts_view_cam, experiment.focal_px, strict=True):
        edges = frustum(T, focal_px, width, height, FRUSTUM_DEPTH)
        axes.add_collection3d(Line3DCollection(edges, colors=ESTIMATE, linewidths=1.2))


def _draw_photograph(axes: Axes, experiment: SfmExperiment, camera: int, reprojected_px: Array) -> None:
    """Draw a photograph with its observations, and lines from them to the reprojections (M, 2)."""
    image = matplotlib.image.imread(experiment.photographs[camera])
    height, width = image.shape[:2]
    rows = experiment.observation_camera == camera
    observed, reprojected = (
        pixels[rows] + 0.5 * np.array([width, height]) for pixels in (experiment.observed_px, reprojected_px)
    )
    axes.imshow(image)
    axes.add_collection(
        LineCollection(list(np.stack([observed, reprojected], axis=1)), colors=ESTIMATE, linewidths=0.8, alpha=0.7)
    )
    axes.scatter(observed[:, 0], observed[:, 1], s=28, facecolors="none", edgecolors=SIGMA, label="observed")
    axes.scatter(reprojected[:, 0], reprojected[:, 1], s=6, color=ESTIMATE, label="reprojected")
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    axes.axis("off")
    axes.legend(loc="lower right")


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
