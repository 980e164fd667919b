"""Triangulation of many landmarks at once from known camera poses.

The point nearest to all rays is refined by Gauss-Newton steps on the reprojection error (Hartley and Sturm,
"Triangulation", CVIU 1997). Observations are flat arrays in which those of one landmark are contiguous.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array

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
    # Components come first, so that the innermost loops of numpy go over the observations.
    R, p, xy = np.ascontiguousarray(Rs_world_cam.transpose(1, 2, 0)), p_world_cam.T, xy.T
    rays = np.concatenate([xy, np.ones((1, xy.shape[1]))])
    rays /= np.sqrt(np.einsum("in,in->n", rays, rays))
    rays = np.einsum("ijn,jn->in", R, rays)
    points = _nearest_to_rays(starts, p, rays)
    for _ in range(GAUSS_NEWTON_STEPS):
        points = points + _gauss_newton_step(starts, counts, R, p, xy, points)
    p_cam = _to_camera_frame(R, p, np.repeat(points.T, counts, axis=1))
    depth = p_cam[2]
    error2 = np.sum((p_cam[:2] / np.maximum(depth, MIN_DEPTH_M) - xy) ** 2, axis=0)
    cosines = np.einsum("in,in->n", rays, np.repeat(rays[:, starts], counts, axis=1))
    baselines = np.linalg.norm(p - np.repeat(p[:, starts], counts, axis=1), axis=0)
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
    """Return the points (L, 3) with the least sum of squared distances to their rays (3, N) from origins (3, N)."""
    projectors = np.eye(3)[..., None] - rays[:, None] * rays  # onto the plane perpendicular to each ray
    A = np.moveaxis(np.add.reduceat(projectors, starts, axis=2), 2, 0)
    b = np.add.reduceat(np.einsum("ijn,jn->in", projectors, origins), starts, axis=1).T
    return np.asarray(np.linalg.solve(A + 1e-9 * np.eye(3), b[..., None])[..., 0])


def _gauss_newton_step(
    starts: npt.NDArray[np.int64], counts: npt.NDArray[np.int64], R: Array, p: Array, xy: Array, points: Array
) -> Array:
    """Return the Gauss-Newton step (L, 3) of landmarks (L, 3) on their reprojection errors.

    The N cameras have orientations R (3, 3, N) and positions p (3, N), and observe xy (2, N).
    """
    p_cam = _to_camera_frame(R, p, np.repeat(points.T, counts, axis=1))
    inverse_depth = 1.0 / np.maximum(p_cam[2], MIN_DEPTH_M)
    projected = p_cam[:2] * inverse_depth
    # ∂(x/z, y/z)/∂p_world: the first two rows of Rᵀ minus the projection times the third, divided by the depth
    J_r = np.empty((2, 4, xy.shape[1]))  # the Jacobian, and the residual
    J_r[:, :3] = (R[:, :2].swapaxes(0, 1) - projected[:, None] * R[:, 2]) * inverse_depth
    J_r[:, 3] = xy - projected
    H_b = np.moveaxis(np.add.reduceat(np.einsum("kin,kjn->ijn", J_r[:, :3], J_r), starts, axis=2), 2, 0)
    H, b = H_b[..., :3], H_b[..., 3:]
    damping = 1e-6 * np.trace(H, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    return np.asarray(np.linalg.solve(H + damping + 1e-12 * np.eye(3), b)[..., 0])


def _to_camera_frame(R_world_cam: Array, p_world_cam: Array, points: Array) -> Array:
    """Return points (3, N) of the world frame in the frames of N cameras, components first."""
    return np.asarray(np.einsum("ijn,in->jn", R_world_cam, points - p_world_cam))
