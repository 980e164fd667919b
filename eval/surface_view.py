"""A viewpoint from which dense surfaces fill a picture."""

import numpy as np

from dronevio.eval.scene import (
    VIEWER_FIELD_OF_VIEW_RAD,
    fit_view,
    upright_rotation,
    view_axes,
    view_azimuth_deg,
)
from dronevio.models.arrays import Array
from dronevio.models.reconstruction import Reconstruction

_MAX_FITTED = 50_000  # points from which the viewpoint is chosen
_INNER_PERCENT = (3.0, 97.0)  # percentiles of the coordinates of the points that fill a picture
_FITTED_SIZE_M = 100.0  # to which the points are scaled for `fit_view`
_MIN_COMMON = 0.6  # length of the mean optical axis in the plane, above which the cameras look in one direction
_OFFSET_DEG = 15.0  # between the view and this direction
_LOW_ELEVATION_DEG = 8.0  # of a viewpoint beside the cameras
_ELEVATION_DEG = 40.0  # of a viewpoint outside the scene
_FILLED_PERCENT = 90.0  # share of the points within the picture
_FIT_ITERATIONS = 3


def surface_view(reconstruction: Reconstruction, points: Array, aspect: float) -> tuple[Array, Array]:
    """Return position (3,) and target (3,) of a viewpoint from which the inner points of a scene fill a picture.

    It is beside the cameras if they look in one direction, and otherwise outside and above the scene.

    Args:
        reconstruction: Cameras of the scene.
        points: (N, 3) Points of its surfaces in the world frame, N > 0.
        aspect: Width of the picture relative to its height.
    """
    R_scene_world = upright_rotation(reconstruction)
    Rs_scene_cam = R_scene_world @ reconstruction.Ts_world_cam[:, :3, :3]
    points = points[:: max(1, len(points) // _MAX_FITTED)] @ R_scene_world.T
    target = np.median(points, axis=0)
    if np.linalg.norm(Rs_scene_cam[:, :2, 2].mean(axis=0)) > _MIN_COMMON:
        away = (reconstruction.positions @ R_scene_world.T).mean(axis=0) - target
        azimuth = np.arctan2(-away[1], -away[0]) + np.radians(_OFFSET_DEG)
        position = _fitted(points, target, float(np.linalg.norm(away)), np.degrees(azimuth), aspect)
    else:
        low, high = np.percentile(points, _INNER_PERCENT, axis=0)
        inner = points[np.all((points >= low) & (points <= high), axis=1)]
        scale = _FITTED_SIZE_M / max(float(np.ptp(inner, axis=0).max()), np.finfo(float).tiny)  # it expects metres
        fitted = fit_view(inner * scale, view_azimuth_deg(Rs_scene_cam), _ELEVATION_DEG, aspect)
        position, target = (p / scale for p in fitted)
    return position @ R_scene_world, target @ R_scene_world


def _fitted(points: Array, target: Array, distance: float, azimuth_deg: float, aspect: float) -> Array:
    """Return the position of a viewpoint at a distance from its target at which most points fill the picture."""
    back, right, up = view_axes(azimuth_deg, _LOW_ELEVATION_DEG)
    tangent = np.tan(0.5 * VIEWER_FIELD_OF_VIEW_RAD)
    for _ in range(_FIT_ITERATIONS):
        relative = points - target
        depth = distance - relative @ back
        ahead = depth > 0.1 * distance
        sizes = (np.abs(relative[ahead] @ axis) / depth[ahead] / limit for axis, limit in ((right, aspect), (up, 1.0)))
        distance *= max(float(np.percentile(size, _FILLED_PERCENT)) for size in sizes) / tangent
    return target + distance * back
