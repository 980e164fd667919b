"""Triangulation of many landmarks at once, from known camera poses.

Starts from the point nearest to all rays and polishes it by a few Gauss-Newton steps on the reprojection error (Hartley
and Sturm, "Triangulation", CVIU 1997). ObservationTable come as flat arrays, those of one landmark side by side.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

GAUSS_NEWTON_STEPS = 3  # from the nearest point, the third changes less than a hundredth of a pixel
MIN_DEPTH_M = 0.05  # nearer to a camera than its lens


@dataclass(frozen=True, eq=False)
class Triangulation:
    """Landmarks, and how well they explain what was seen."""

    points: Array
    """(L, 3) Positions in the world [m]."""
    in_front: npt.NDArray[np.bool_]
    """(L,) Whether a landmark lies before all cameras that saw it."""
    rms: Array
    """(L,) Root mean square distance of its observations from where they should be, in normalized coordinates."""
    newest: Array
    """(L,) The same distance of its last sighting alone."""
    parallax_rad: Array
    """(L,) Largest angle between its first ray and the others [rad]."""
    baseline_m: Array
    """(L,) Largest distance between the first camera that saw it and the others [m]."""
    depth_m: Array
    """(L,) Its largest depth in the cameras that saw it [m]."""


def triangulate(starts: npt.NDArray[np.int64], Rs_world_cam: Array, p_world_cam: Array, xy: Array) -> Triangulation:
    """Triangulate L landmarks from N observations.

    Args:
        starts: (L,) Where each landmark's observations begin.
        Rs_world_cam: (N, 3, 3) Orientation of the camera of each sighting.
        p_world_cam: (N, 3) Its position [m].
        xy: (N, 2) Normalized coordinates of each sighting.
    """
    counts = np.diff(np.append(starts, len(xy)))
    rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    rays = np.einsum("nij,nj->ni", Rs_world_cam, rays)
    points = _nearest_to_rays(starts, p_world_cam, rays)
    for _ in range(GAUSS_NEWTON_STEPS):
        points = points + _step(starts, counts, Rs_world_cam, p_world_cam, xy, points)
    p_cam = _in_camera(Rs_world_cam, p_world_cam, np.repeat(points, counts, axis=0))
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
    """Return the points (L, 3) with the least sum of squared distances to rays."""
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    A = np.add.reduceat(across, starts)
    b = np.add.reduceat(np.einsum("nij,nj->ni", across, origins), starts)
    return np.asarray(np.linalg.solve(A + 1e-9 * np.eye(3), b[..., None])[..., 0])


def _step(
    starts: npt.NDArray[np.int64], counts: npt.NDArray[np.int64], R: Array, p: Array, xy: Array, points: Array
) -> Array:
    """Return the Gauss-Newton step (L, 3) of all landmarks."""
    p_cam = _in_camera(R, p, np.repeat(points, counts, axis=0))
    inverse_depth = 1.0 / np.maximum(p_cam[:, 2], MIN_DEPTH_M)
    projected = p_cam[:, :2] * inverse_depth[:, None]
    # ∂(x/z, y/z)/∂p_world: rows of Rᵀ less the projection times its third row, over the depth
    J = (np.swapaxes(R[:, :, :2], 1, 2) - projected[:, :, None] * R[:, None, :, 2]) * inverse_depth[:, None, None]
    H = np.add.reduceat(np.einsum("nki,nkj->nij", J, J), starts)
    g = np.add.reduceat(np.einsum("nki,nk->ni", J, xy - projected), starts)
    damping = 1e-6 * np.trace(H, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    return np.asarray(np.linalg.solve(H + damping + 1e-12 * np.eye(3), g[..., None])[..., 0])


def _in_camera(R_world_cam: Array, p_world_cam: Array, points: Array) -> Array:
    return np.asarray(np.einsum("nij,ni->nj", R_world_cam, points - p_world_cam))
