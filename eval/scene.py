"""Geometry of drawings in three dimensions: an upright frame, robust limits, camera frusta, and a view of all.

Images do not determine which direction is up. Photographs and most cameras of drones have no roll, so that the x axes
of the camera frames are horizontal: up is the direction to which they are orthogonal.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from dronevio.eval.metrics.reconstruction import valid_errors_px
from dronevio.models.arrays import Array
from dronevio.models.reconstruction import Reconstruction

VIEWER_FIELD_OF_VIEW_RAD = np.radians(55.0)
"""Vertical field of view of the rerun viewer's 3D view, and of perspective pictures."""
VIEW_ASPECT = 1.6
"""Width of a 3D view relative to its height, a little less than in a window of 16:10."""
MARGIN = 1.04
"""Factor on the smallest distance from which a 3D view contains the whole scene."""
INNER_PERCENT = (10.0, 90.0)
"""Percentiles of coordinates that determine the limits of a scene."""
OUTER_SHARE = 1.0
"""Distance of the limits of a scene from these percentiles, as a share of the distance between them."""
_FIT_ITERATIONS = 10
_MIN_DISTANCE_M = 1.0
_UP_PRIOR = 1e-3  # weight of the cameras' mean up direction if x axes are almost parallel; the variance of a roll of 2°
_FORWARD_SHARE = 0.5  # weight of −z beside −y in the sign of the up direction, for cameras that look down
_FRUSTUM_SHARES = (0.015, 0.04)  # limits of the depth of a drawn frustum, as shares of the scene's diagonal
_MAX_CORNER = 1.5  # largest normalized coordinate of a drawn corner, for fisheye lenses
_FRUSTUM_EDGES = np.array([(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)])  # vertex 0 is the camera
_FITTED_SIZE_M = 100.0  # to which a reconstruction of unknown scale is scaled for `fit_view`
_ELEVATION_DEG = 25.0
_LIMIT_PERCENT = 95.0  # percentile of the reprojection errors at the end of the colour scale
_RESIDUAL_SHARE = 0.02  # length of a drawn residual at the end of the colour scale, as a share of the image
_MIN_HORIZONTAL = 0.2  # length of the mean optical axis in the plane, below which the cameras look around or down


@dataclass(frozen=True)
class ResidualStyle:
    """How reprojection residuals are drawn in images."""

    limit_px: float
    """Reprojection error at the end of the colour scale [px]."""
    factor: float
    """Factor by which residuals are drawn longer than they are: 1, 2 or 5 times a power of ten."""

    @classmethod
    def of(cls, components: Sequence[Reconstruction]) -> Self:
        """Return the style in which the 95th percentile of the errors of all components is well visible."""
        errors = valid_errors_px(components)
        limit_px = float(np.percentile(errors, _LIMIT_PERCENT)) if len(errors) else 0.0
        side_px = max((max(c.width, c.height) for component in components for c in component.cameras), default=0)
        if limit_px <= 0.0:
            return cls(1.0, 1.0)
        return cls(limit_px, max(1.0, round_down(_RESIDUAL_SHARE * side_px / limit_px)))


def up_direction(Ts_world_cam: Array) -> Array:
    """Return the unit vector (3,) in the world frame to which the x axes of cameras are most orthogonal.

    Of the two such vectors, it is the one on the upper side of the images, or behind cameras that look down.

    Args:
        Ts_world_cam: (C, 4, 4) Poses of the cameras, C > 0; x right, y down, z forward.
    """
    x, y, z = (Ts_world_cam[:, :3, axis] for axis in range(3))
    up = -y.mean(axis=0)
    _, vectors = np.linalg.eigh(x.T @ x / len(x) - _UP_PRIOR * np.outer(up, up))
    smallest: Array = vectors[:, 0]
    return -smallest if smallest @ (up - _FORWARD_SHARE * z.mean(axis=0)) < 0.0 else smallest


def upright_rotation(reconstruction: Reconstruction, up: Array | None = None) -> Array:
    """Return the rotation (3, 3) from the world frame to a frame for drawings.

    Its z axis is up, its x axis is horizontal along the largest extent of the points, and the cameras look towards
    positive y rather than negative y.

    Args:
        reconstruction: The reconstruction.
        up: (3,) Up direction in the world frame; None to estimate it from the cameras.
    """
    cameras = reconstruction.Ts_world_cam
    if up is None:
        up = up_direction(cameras) if len(cameras) else np.array([0.0, 0.0, 1.0])
    z = up / np.linalg.norm(up)
    plane = np.linalg.svd(z[None])[2][1:]  # two horizontal unit vectors
    shown = scene_points(reconstruction) @ plane.T
    major = np.linalg.eigh(np.cov(shown.T))[1][:, -1] if len(shown) > 2 else np.array([1.0, 0.0])
    x = major @ plane
    y = np.cross(z, x)
    forward = cameras[:, :3, 2].mean(axis=0) if len(cameras) else y
    return np.stack([x, y, z]) if y @ forward >= 0.0 else np.stack([-x, -y, z])


def robust_limits(points: Array) -> tuple[Array, Array]:
    """Return limits (3,), (3,) of the coordinates of points (N, 3), N > 0, beyond which they are outliers.

    They are beyond the 10th and the 90th percentile by the distance between these. If coordinates have a uniform
    distribution, none is outside; if it is normal, one of 8000.
    """
    low, high = np.percentile(points, INNER_PERCENT, axis=0)
    margin = OUTER_SHARE * (high - low)
    return np.asarray(low - margin), np.asarray(high + margin)


def scene_points(reconstruction: Reconstruction) -> Array:
    """Return the points within their robust limits and the positions of all cameras (K, 3), in the world frame."""
    points = reconstruction.points[np.isfinite(reconstruction.points).all(axis=1)]
    if len(points):
        low, high = robust_limits(points)
        points = points[np.all((points >= low) & (points <= high), axis=1)]
    return np.concatenate([points, reconstruction.positions])


def frustum_depth(reconstruction: Reconstruction) -> float:
    """Return the depth at which a camera's frustum is cut off in drawings, in the unit of the world frame.

    It is the median distance of a camera from the nearest other one, within limits relative to the scene.
    """
    shown = scene_points(reconstruction)
    diagonal = float(np.linalg.norm(np.ptp(shown, axis=0))) if len(shown) else 0.0
    if diagonal == 0.0:
        return 1.0
    positions = reconstruction.positions
    nearest = np.array([np.partition(np.linalg.norm(positions - p, axis=1), 1)[1] for p in positions[:500]])
    spacing = float(np.median(nearest)) if len(positions) > 1 else diagonal
    low, high = _FRUSTUM_SHARES
    return float(np.clip(spacing, low * diagonal, high * diagonal))


def frusta(reconstruction: Reconstruction, depth: float) -> Array:
    """Return the edges of the cameras' frusta (8 C, 2, 3) as line segments in the world frame, without distortion.

    Args:
        reconstruction: The reconstruction.
        depth: Distance of the images from their cameras, in the unit of the world frame.
    """
    segments = [np.zeros((0, 2, 3))]
    for index, T in zip(reconstruction.image_camera, reconstruction.Ts_world_cam, strict=True):
        camera = reconstruction.cameras[index]
        right, bottom = camera.width - 0.5, camera.height - 0.5
        corners_px = np.array([(-0.5, -0.5), (right, -0.5), (right, bottom), (-0.5, bottom)])
        xy = np.clip((corners_px - [camera.cx, camera.cy]) / camera.central_focal_px, -_MAX_CORNER, _MAX_CORNER)
        vertices = depth * np.vstack([np.zeros(3), np.column_stack([xy, np.ones(4)])])
        segments.append((vertices @ T[:3, :3].T + T[:3, 3])[_FRUSTUM_EDGES])
    return np.concatenate(segments)


def view_azimuth_deg(Rs_scene_cam: Array, offset_deg: float = 35.0, otherwise_deg: float = 40.0) -> float:
    """Return the azimuth of a view from behind the cameras and beside them, as `fit_view` needs it [°].

    Args:
        Rs_scene_cam: (C, 3, 3) Orientations of the cameras in a frame with z up.
        offset_deg: Angle between the view and the mean optical axis [°].
        otherwise_deg: Azimuth if the cameras look in all directions, or down [°].
    """
    forward = Rs_scene_cam[:, :2, 2].mean(axis=0) if len(Rs_scene_cam) else np.zeros(2)
    if np.linalg.norm(forward) < _MIN_HORIZONTAL:
        return otherwise_deg
    return float(np.degrees(np.arctan2(forward[1], forward[0])) + offset_deg)


def reconstruction_view(reconstruction: Reconstruction, R_scene_world: Array) -> tuple[Array, Array]:
    """Return position (3,) and target (3,) of a viewpoint in the world frame behind the cameras of the scene.

    Args:
        reconstruction: The reconstruction, with at least one point or camera.
        R_scene_world: (3, 3) Rotation from the world frame to a frame with z up; see `upright_rotation`.
    """
    edges = frusta(reconstruction, frustum_depth(reconstruction))
    shown = np.concatenate([scene_points(reconstruction), edges[:, 1]])
    in_scene = shown @ R_scene_world.T
    scale = _FITTED_SIZE_M / max(float(np.ptp(in_scene, axis=0).max()), np.finfo(float).tiny)
    azimuth_deg = view_azimuth_deg(R_scene_world @ reconstruction.Ts_world_cam[:, :3, :3])
    position, target = fit_view(in_scene * scale, azimuth_deg, _ELEVATION_DEG)  # it expects metres
    return position / scale @ R_scene_world, target / scale @ R_scene_world


def fit_view(
    points: Array, azimuth_deg: float = 40.0, elevation_deg: float = 38.0, aspect: float = VIEW_ASPECT
) -> tuple[Array, Array]:
    """Return position (3,) and target (3,) of a viewpoint such that points fill the 3D view [m].

    From a distance D, a point at height h above the optical axis and depth d in front of the target is visible if
    |h| ≤ (D − d) tan(fov / 2), and likewise for the width. The distance is the smallest D for which all points are.

    Args:
        points: (N, 3) Points that the view contains, N > 0 [m].
        azimuth_deg: Direction of view in the horizontal plane, from the x axis [°].
        elevation_deg: Elevation of the viewpoint above the target [°].
        aspect: Width of the view relative to its height.
    """
    back, right, up = view_axes(azimuth_deg, elevation_deg)
    target = 0.5 * (points.min(axis=0) + points.max(axis=0))
    tangent = np.tan(0.5 * VIEWER_FIELD_OF_VIEW_RAD) * np.array([aspect, 1.0])
    axes = np.stack([right, up])

    def distance_for(offsets: Array, depth: Array) -> float:
        return max(_MIN_DISTANCE_M, MARGIN * float(np.max(np.abs(offsets) / tangent + depth[:, None])))

    for _ in range(_FIT_ITERATIONS):  # near points appear larger: centre the image of the points, and repeat
        offsets, depth = (points - target) @ axes.T, (points - target) @ back
        distance_m = distance_for(offsets, depth)
        projected = offsets / (distance_m - depth[:, None])
        target = target + 0.5 * (projected.min(axis=0) + projected.max(axis=0)) * distance_m @ axes
    return target + distance_for((points - target) @ axes.T, (points - target) @ back) * back, target


def view_axes(azimuth_deg: float, elevation_deg: float) -> tuple[Array, Array, Array]:
    """Return the unit vectors (3,) backward, right and up of a viewpoint; see `fit_view`."""
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    back = np.array([-np.cos(elevation) * np.cos(azimuth), -np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    return back, right, np.cross(back, right)


def round_down(value: float) -> float:
    """Return the largest of 1, 2 or 5 times a power of ten that does not exceed a value above zero, and else 0."""
    if value <= 0.0:
        return 0.0
    power = 10.0 ** math.floor(math.log10(value))
    return max(power * step for step in (1.0, 2.0, 5.0) if step == 1.0 or step * power <= value)
