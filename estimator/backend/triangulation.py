"""Triangulation of many landmarks at once from known camera poses.

The point nearest to all rays is refined by Gauss-Newton steps on the reprojection error (Hartley and Sturm,
"Triangulation", CVIU 1997). Observations are flat arrays in which those of one landmark are contiguous.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

GAUSS_NEWTON_STEPS = 3
"""Number of refinement steps; the third changes projections by less than 0.01 px."""
MIN_DEPTH_M = 0.05
"""Smallest depth at which a point is projected [m], about the length of a lens."""


@dataclass(frozen=True, eq=False)
class Triangulation:
    """Triangulated landmarks, and the quantities by which they are accepted or rejected."""

    points: Array
    """(L, 3) Positions in the world frame [m]."""
    in_front: npt.NDArray[np.bool_]
    """(L,) Whether a landmark is in front of all cameras that observe it."""
    rms: Array
    """(L,) Root mean square reprojection error over all observations, in normalized coordinates."""
    newest: Array
    """(L,) Reprojection error of the last observation, in normalized coordinates."""
    parallax_rad: Array
    """(L,) Largest angle between the first ray and another [rad]."""
    baseline_m: Array
    """(L,) Largest distance between the first camera position and another [m]."""
    depth_m: Array
    """(L,) Largest depth in the cameras that observe the landmark [m]."""


def triangulate(starts: npt.NDArray[np.int64], Rs_world_cam: Array, p_world_cam: Array, xy: Array) -> Triangulation:
    """Triangulate L landmarks from N observations.

    Args:
        starts: (L,) Index of the first observation of each landmark, in increasing order.
        Rs_world_cam: (N, 3, 3) Orientation of the camera of each observation.
        p_world_cam: (N, 3) Position of the camera of each observation [m].
        xy: (N, 2) Normalized image coordinates of each observation.
    """
    counts = np.diff(np.append(starts, len(xy)))
    rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    rays = np.einsum("nij,nj->ni", Rs_world_cam, rays)
    points = _nearest_to_rays(starts, p_world_cam, rays)
    for _ in range(GAUSS_NEWTON_STEPS):
        points = points + _gauss_newton_step(starts, counts, Rs_world_cam, p_world_cam, xy, points)
    p_cam = _to_camera_frame(Rs_world_cam, p_world_cam, np.repeat(points, counts, axis=0))
    depth = p_cam[:, 2]
    error2 = np.sum((p_cam[:, :2] / np.maximum(depth, MIN_DEPTH_M)[:, None] - xy) ** 2, axis=1)
    cosines = np.sum(rays * np.repeat(rays[starts], counts, axis=0), axis=1)
    baselines = np.linalg.norm(p_world_cam - np.repeat(p_world_cam[starts], counts, axis=0), axis=1)
    return Triangulation(
        points,
        np.minimum.reduceat(depth, starts) > MIN_DEPTH_M,
        np.sqrt(np.add.reduceat(error2, starts) / counts),
        np.sqrt(error2[starts + counts - 1]),
        np.arccos(np.clip(np.minimum.reduceat(cosines, starts), -1.0, 1.0)),
        np.maximum.reduceat(baselines, starts),
        np.maximum.reduceat(depth, starts),
    )


def _nearest_to_rays(starts: npt.NDArray[np.int64], origins: Array, rays: Array) -> Array:
    """Return the points (L, 3) with the least sum of squared distances to their rays."""
    projectors = np.eye(3) - rays[:, :, None] * rays[:, None, :]  # onto the plane perpendicular to each ray
    A = np.add.reduceat(projectors, starts)
    b = np.add.reduceat(np.einsum("nij,nj->ni", projectors, origins), starts)
    return np.asarray(np.linalg.solve(A + 1e-9 * np.eye(3), b[..., None])[..., 0])


def _gauss_newton_step(
    starts: npt.NDArray[np.int64], counts: npt.NDArray[np.int64], R: Array, p: Array, xy: Array, points: Array
) -> Array:
    """Return the Gauss-Newton step (L, 3) of all landmarks on their reprojection errors."""
    p_cam = _to_camera_frame(R, p, np.repeat(points, counts, axis=0))
    inverse_depth = 1.0 / np.maximum(p_cam[:, 2], MIN_DEPTH_M)
    projected = p_cam[:, :2] * inverse_depth[:, None]
    # ∂(x/z, y/z)/∂p_world: the first two rows of Rᵀ minus the projection times the third, divided by the depth
    J = (np.swapaxes(R[:, :, :2], 1, 2) - projected[:, :, None] * R[:, None, :, 2]) * inverse_depth[:, None, None]
    H = np.add.reduceat(np.einsum("nki,nkj->nij", J, J), starts)
    b = np.add.reduceat(np.einsum("nki,nk->ni", J, xy - projected), starts)
    damping = 1e-6 * np.trace(H, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    return np.asarray(np.linalg.solve(H + damping + 1e-12 * np.eye(3), b[..., None])[..., 0])


def _to_camera_frame(R_world_cam: Array, p_world_cam: Array, points: Array) -> Array:
    """Return points (N, 3) of the world frame in the frames of N cameras."""
    return np.asarray(np.einsum("nij,ni->nj", R_world_cam, points - p_world_cam))
