"""Evidence of a depth image about the cells of a lattice: log-odds of being occupied."""

from dataclasses import dataclass

import numpy as np

from dronevio.models.arrays import Floats, Integers
from dronevio.models.depth import DepthImage

FREE_LOG_ODDS, OCCUPIED_LOG_ODDS = -0.4, 0.85


@dataclass(frozen=True, eq=False)
class Evidence:
    """Log-odds that a depth image adds to the cells of a box of the lattice, whose cell (0, 0, 0) begins at 0."""

    low: Integers
    """(3,) Index of the first cell of the box in the lattice."""
    log_odds: Floats
    """(X, Y, Z) Log-odds to add; 0 where nothing was measured."""


def evidence(depth: DepthImage, cell_m: float, range_m: float) -> Evidence:
    """Return the evidence of a depth image, up to a range [m]; cells behind surfaces receive none."""
    T, camera = depth.T_odom_cam, depth.camera
    corners = np.array([[0, 0], [camera.width, 0], [0, camera.height], [camera.width, camera.height]]) - 0.5
    rays = np.concatenate([(corners - camera.K[:2, 2]) / np.diag(camera.K)[:2], np.ones((4, 1))], axis=1)
    frustum = np.concatenate([T[None, :3, 3], range_m * rays @ T[:3, :3].T + T[:3, 3]])
    low, high = (
        np.floor(frustum.min(axis=0) / cell_m).astype(np.int64),
        np.ceil(frustum.max(axis=0) / cell_m).astype(np.int64),
    )
    axes = [(np.arange(a, b) + 0.5) * cell_m for a, b in zip(low, high, strict=True)]
    centres = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).astype(np.float32)
    points = (centres - T[:3, 3].astype(np.float32)) @ T[:3, :3].astype(np.float32)
    z = points[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.rint(camera.K[0, 0] * points[..., 0] / z + camera.K[0, 2])
        v = np.rint(camera.K[1, 1] * points[..., 1] / z + camera.K[1, 2])
    inside = (z > 0.0) & (z < range_m) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    at = np.where(inside, v, 0).astype(np.int32), np.where(inside, u, 0).astype(np.int32)
    d, sigma = depth.depth_m[at], depth.sigma_m[at]
    seen = inside & (d > 0.0)
    margin = cell_m + 2.0 * sigma
    log_odds = np.where(seen & (z < d - margin), FREE_LOG_ODDS, 0.0)
    log_odds = np.where(seen & (np.abs(z - d) <= 0.5 * cell_m + sigma), OCCUPIED_LOG_ODDS, log_odds)
    return Evidence(low, log_odds.astype(np.float32))
