"""The page of ``dronevio book sfm``: points and cameras in three dimensions, which the reader rotates."""

from collections.abc import Iterator

import matplotlib.image
import numpy as np
import numpy.typing as npt

from dronevio.book.sfm_plots import FRUSTUM_DEPTH, T_VIEW_CAM, frustum, inliers, transformed
from dronevio.estimator.book.sfm import SfmExperiment
from dronevio.eval.colours import ESTIMATE, SURROUNDINGS
from dronevio.eval.report.path3d import MARGIN, PathScene, SpatialMark, SpatialPath, scene_extent
from dronevio.eval.report.templating import Tile, render_page
from dronevio.models.arrays import Array
from dronevio.models.rotation import inverse_pose

_COLOUR_STEP = 32  # points whose colours are equal in these steps are one element of the page
_DOTS = "stroke-width: {}; stroke-linecap: round"  # segments without length, whose round caps are dots


def sfm_page(experiment: SfmExperiment) -> str:
    """Return the page as HTML: one file that refers to no other."""
    e = experiment
    return render_page(
        "book_sfm.html.j2",
        "Villa Balbianello",
        f"Bundle adjustment of {len(e.photographs)} cameras and {len(e.points)} points",
        script="path3d.js",
        tiles=[
            Tile("Error before", f"{e.initial_error:.1f}", "", "½ Σ (residual/1 px)²"),
            Tile("Error after", f"{e.final_error:.1f}", "", f"{e.iterations} iterations"),
            Tile("Reprojection error before", f"{e.initial_reprojection_rms_px:.2f}", "px", "RMS"),
            Tile("Reprojection error after", f"{e.reprojection_rms_px:.2f}", "px", "RMS"),
        ],
        scene=sfm_scene(e),
    )


def sfm_scene(experiment: SfmExperiment) -> PathScene:
    """Return the points and camera frusta before (grey) and after the adjustment, without distant points."""
    e = experiment
    T_view_world = T_VIEW_CAM @ inverse_pose(e.Ts_world_cam[0])
    points, before = transformed(T_view_world, e.points), transformed(T_view_world, e.points_initial)
    kept = inliers(points)
    cameras, cameras_before = (_frusta(e, T_view_world @ Ts) for Ts in (e.Ts_world_cam, e.Ts_world_cam_initial))
    centre, half_width, half_height = scene_extent(np.concatenate([points[kept], cameras]))
    grey = f"stroke: {SURROUNDINGS}; opacity: .6; "
    return PathScene(
        (
            SpatialPath("", grey + _DOTS.format(2), _dots(before[kept] - centre), True),
            SpatialPath("before the adjustment", grey + "stroke-width: 1", cameras_before - centre, True),
            *_coloured_dots(points[kept] - centre, e.colours[kept]),
            SpatialPath("cameras", f"stroke: {ESTIMATE}; stroke-width: 1.5", cameras - centre, True),
        ),
        tuple(SpatialMark(f"{i + 1}", cameras[16 * i] - centre) for i in range(len(e.photographs))),
        MARGIN * half_width,
        MARGIN * half_height,
        0.0,
    )


def _coloured_dots(points: Array, colours: npt.NDArray[np.uint8]) -> Iterator[SpatialPath]:
    """Yield the dots of points (N, 3) whose colours (N, 3) are similar."""
    middles, group = np.unique(colours // _COLOUR_STEP, axis=0, return_inverse=True)
    for i, colour in enumerate((middles * _COLOUR_STEP + _COLOUR_STEP // 2).tolist()):
        stroke = "stroke: #{:02x}{:02x}{:02x}; ".format(*colour)
        yield SpatialPath("", stroke + _DOTS.format(5), _dots(points[group.ravel() == i]), True)


def _dots(points: Array) -> Array:
    """Return segments (2N, 3) without length at points (N, 3)."""
    return np.repeat(points, 2, axis=0)


def _frusta(experiment: SfmExperiment, Ts_view_cam: Array) -> Array:
    """Return the ends of the segments (16C, 3) of the frusta of C cameras; the first of each is its centre."""
    height, width = matplotlib.image.imread(experiment.photographs[0]).shape[:2]
    edges = [
        frustum(T, focal_px, width, height, FRUSTUM_DEPTH)
        for T, focal_px in zip(Ts_view_cam, experiment.focal_px.tolist(), strict=True)
    ]
    return np.concatenate(edges).reshape(-1, 3)
