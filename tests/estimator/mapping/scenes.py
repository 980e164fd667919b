"""Depth images of scenes by arithmetic, and what their evidence tells."""

import numpy as np

from dronevio.estimator.mapping.evidence import Evidence
from dronevio.models.arrays import Array, Floats, Mask
from dronevio.models.depth import DepthImage, Pinhole

CAMERA = Pinhole(188, 120, np.array([[115.0, 0.0, 93.5], [0.0, 115.0, 59.5], [0.0, 0.0, 1.0]]))
EUROC_HALF = Pinhole(376, 240, np.array([[229.0, 0.0, 187.5], [0.0, 229.0, 119.5], [0.0, 0.0, 1.0]]))

CELL_M = 0.1
"""Side of the cells [m]."""
FORWARDS = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Orientation of a camera that looks along x, z up."""


def pose(position: Array | tuple[float, float, float], R: Array = FORWARDS) -> Array:
    """Return a pose (4, 4)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, position
    return T


def image(depth_m: Floats, T_odom_cam: Array, sigma_m: float | Floats = 0.0, camera: Pinhole = CAMERA) -> DepthImage:
    """Return a depth image; a depth of 0 is unknown."""
    depth = np.asarray(depth_m, np.float32)
    sigma = np.where(depth > 0.0, sigma_m, 0.0).astype(np.float32)
    return DepthImage(0, camera, T_odom_cam, depth, sigma, np.zeros(depth.shape, np.uint8))


def wall(depth_m: float, camera: Pinhole = CAMERA) -> Floats:
    """Return the depth (H, W) of a wall across the optical axis."""
    return np.full((camera.height, camera.width), depth_m, np.float32)


def with_box(depth_m: Floats, low: Array, high: Array, camera: Pinhole = CAMERA) -> Floats:
    """Return a depth image with a box of the camera frame in front of what it shows, exact at the pixels' centres."""
    rays = camera.rays()
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = low / rays, high / rays
    near, far = np.minimum(a, b).max(axis=-1), np.maximum(a, b).min(axis=-1)
    hit = (near <= far) & (near > 0.0)
    return np.where(hit & (near < depth_m), near, depth_m).astype(np.float32)


def with_pole(
    depth_m: Floats, distance_m: float, diameter_m: float, camera: Pinhole = CAMERA, side_m: float = 0.0
) -> Floats:
    """Return a depth image with an upright round pole in front of what it shows."""
    x = camera.rays()[..., 0].astype(np.float64)
    # (x z − side)² + (z − distance)² = radius²
    a, b = 1.0 + x * x, x * side_m + distance_m
    c = side_m**2 + distance_m**2 - (0.5 * diameter_m) ** 2
    root = b * b - a * c
    z = (b - np.sqrt(np.maximum(root, 0.0))) / a
    return np.where((root >= 0.0) & (z < depth_m), z, depth_m).astype(np.float32)


def in_camera(found: Evidence, selected: Mask, T_odom_cam: Array, cell_m: float = CELL_M) -> Array:
    """Return all corners (N, 8, 3) of selected cells in the camera frame."""
    offsets = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    corners = ((np.argwhere(selected) + found.low)[:, None] + offsets) * cell_m
    return np.asarray((corners - T_odom_cam[:3, 3]) @ T_odom_cam[:3, :3])


def value_at(found: Evidence, point: tuple[float, float, float], cell_m: float = CELL_M) -> float:
    """Return the log-odds that are added to the cell of a point [m]."""
    return float(found.log_odds[tuple(np.floor(np.array(point) / cell_m).astype(int) - found.low)])


def found_free(found: Evidence) -> Mask:
    """Return which cells (X, Y, Z) of the box are seen to be free."""
    return np.asarray(found.log_odds < 0.0)
