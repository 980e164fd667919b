"""Evidence of a depth image about the cells of a lattice: log-odds of being occupied.

A cell is free if all of it lies in front of the nearest depth that any pixel of its footprint in the image can have;
a pixel of unknown depth may have any, unless it lies in a small hole, which has the nearest of the depths around it. A
cell is occupied if the point of a pixel lies in it. Behind surfaces nothing is known.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from dronevio.estimator.mapping.nearest_depth import NearestDepths, Pixels, Values
from dronevio.models.arrays import Array, Floats, Integers
from dronevio.models.depth import DepthImage, Pinhole

FREE_LOG_ODDS = -0.4
"""Log-odds of a cell in front of the depths of its footprint."""
OCCUPIED_LOG_ODDS = 1.5
"""Log-odds of a cell that contains a depth without error."""
FREE_SIGMAS = 2.0
"""Standard deviations in front of a depth of which nothing is said."""
FULL_BLOCKS = 3.0
"""Number of blocks of pixels whose points in a cell are full evidence that it is occupied."""
HOLE_PX = 15
"""Length of holes in the depth that may hide a thing; an odd number [px]."""
_STEPS = 65535.0
"""Steps of the quantized depths."""


def _line(column: float, row: float) -> npt.NDArray[np.uint8]:
    """Return the pixels of a line of `HOLE_PX` through the middle of a square, with steps of at most a pixel."""
    half = HOLE_PX // 2
    steps = np.arange(-half, half + 1)
    line = np.zeros((HOLE_PX, HOLE_PX), np.uint8)
    line[half + np.rint(row * steps).astype(int), half + np.rint(column * steps).astype(int)] = 1
    return line


_LINES = [_line(*steps) for steps in ((1, 0), (1, 0.5), (1, 1), (0.5, 1), (0, 1), (-0.5, 1), (-1, 1), (-1, 0.5))]
"""Lines in eight directions, so that a stripe of a quarter of `HOLE_PX` is found at any angle."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """Log-odds that a depth image adds to the cells of a box of the lattice, whose cell (0, 0, 0) begins at 0."""

    low: Integers
    """(3,) Index of the first cell of the box in the lattice."""
    log_odds: Floats
    """(X, Y, Z) Log-odds to add; 0 where nothing was measured."""


def evidence(depth: DepthImage, cell_m: float, range_m: float) -> Evidence:
    """Return the evidence of a depth image.

    Args:
        depth: Depth image with standard deviations.
        cell_m: Side of the cells of the lattice [m].
        range_m: Largest depth about which something is said [m].
    """
    known = depth.known
    if not known.any():
        return Evidence(np.zeros(3, np.int64), np.zeros((0, 0, 0), np.float32))
    far_m = min(range_m, float(depth.depth_m.max()) + 0.5 * cell_m)
    low, shape = _box(depth, cell_m, far_m)
    log_odds = np.zeros(int(np.prod(shape)), np.float32)
    _add_free(log_odds, low, shape, depth, cell_m, far_m)
    _add_occupied(log_odds, low, shape, depth, cell_m, far_m)
    return Evidence(low, log_odds.reshape(shape))


def _box(depth: DepthImage, cell_m: float, far_m: float) -> tuple[Integers, tuple[int, int, int]]:
    """Return the first cell and the shape of the smallest box of cells around the frustum up to a depth."""
    T, camera = depth.T_odom_cam, depth.camera
    x, y = _slopes(camera)
    corners = far_m * np.array([[a, b, 1.0] for a in x for b in y]) @ T[:3, :3].T + T[:3, 3]
    corners = np.concatenate([corners, T[None, :3, 3]])
    low = np.floor(corners.min(axis=0) / cell_m).astype(np.int64)
    a, b, c = (np.floor(corners.max(axis=0) / cell_m).astype(np.int64) - low + 1).tolist()
    return low, (a, b, c)


def _slopes(camera: Pinhole) -> Array:
    """Return x / z and y / z (2, 2) at the first and last edges of the image."""
    size = np.array([camera.width, camera.height])
    edges = np.stack([np.full(2, -0.5), size - 0.5], axis=1)
    return np.asarray((edges - camera.K[:2, 2, None]) / np.diag(camera.K)[:2, None])


def _add_free(
    log_odds: Floats, low: Integers, shape: tuple[int, int, int], depth: DepthImage, cell_m: float, far_m: float
) -> None:
    """Write the log-odds of the cells that are free into those of a box."""
    camera, R = depth.camera, depth.T_odom_cam[:3, :3]
    # All of a cell projects into a square around its centre, with half side radius_m / (z − half_m) at depth 1.
    half_m = 0.5 * cell_m * float(np.abs(R[:, 2]).sum())
    radius_m = max(
        0.5 * cell_m * float(np.abs(R[:, axis] - slope * R[:, 2]).sum()) * camera.K[axis, axis]
        for axis in (0, 1)
        for slope in _slopes(camera)[axis]
    )
    windows = NearestDepths.of(_free_to(depth, far_m), radius_m / far_m + 0.5)
    near_m = half_m + radius_m / (windows.reach_px[-1] - 0.5)
    if near_m >= far_m - half_m:
        return
    cells, z, u, v = _cells_in_view(low, shape, depth, cell_m, near_m, far_m - half_m)
    radius = np.ceil(np.float32(radius_m) / (z - np.float32(half_m)) + np.float32(0.499)).astype(np.int32)
    free_to = windows.at(u, v, radius)
    is_free = (z + np.float32(half_m)) * np.float32(_STEPS / far_m) <= free_to
    log_odds[cells[is_free]] = FREE_LOG_ODDS


def _free_to(depth: DepthImage, far_m: float) -> Values:
    """Return up to which depth each pixel is free (H, W), in steps of ``far_m`` / 65535; 0 where it is unknown.

    Matchers reject single pixels of smooth surfaces, and all pixels along thin things such as poles. A pixel of unknown
    depth is therefore as near as its surroundings if no line through it is unknown for `HOLE_PX`, otherwise unknown.
    """
    steps = _STEPS / far_m
    free_to = cv2.addWeighted(depth.depth_m, steps, depth.sigma_m, -FREE_SIGMAS * steps, 0.0, dtype=cv2.CV_16U)
    is_known = depth.known.view(np.uint8)
    around = cv2.erode(free_to - (is_known == 0), np.ones((HOLE_PX, HOLE_PX), np.uint8))  # 0 - 1 is the largest value
    in_small = np.bitwise_and.reduce([cv2.morphologyEx(is_known, cv2.MORPH_CLOSE, line) for line in _LINES])
    return np.asarray(np.where(depth.known, free_to, around * in_small), np.uint16)


def _cells_in_view(
    low: Integers, shape: tuple[int, int, int], depth: DepthImage, cell_m: float, near_m: float, far_m: float
) -> tuple[Pixels, Floats, Pixels, Pixels]:
    """Return the cells of a box whose centres are in view between two depths.

    Each column of cells along the third axis leaves the half-spaces of the frustum at a cell that follows from a
    division, so that no cell outside the frustum is looked at.

    Returns:
        Flat indices (N,) in the box, depths (N,) [m], columns (N,) and rows (N,) of the nearest pixels.
    """
    camera, R = depth.camera, depth.T_odom_cam[:3, :3]
    # Homogeneous pixel of cell (i, j, k): A @ (i, j, k) + b.
    A = cell_m * camera.K @ R.T
    b = camera.K @ R.T @ ((low + 0.5) * cell_m - depth.T_odom_cam[:3, 3])
    i, j = np.arange(shape[0], dtype=np.float64), np.arange(shape[1], dtype=np.float64)
    first = (A[:, 0, None, None] * i[:, None] + A[:, 1, None, None] * j + b[:, None, None]).reshape(3, -1)
    step = A[:, 2]
    last_u, last_v = camera.width - 0.5, camera.height - 0.5
    edge = 0.499  # less than half a pixel, so that rounding stays in the image
    planes = np.array(
        [
            [1.0, 0.0, edge],
            [-1.0, 0.0, last_u - 0.5 + edge],
            [0.0, 1.0, edge],
            [0.0, -1.0, last_v - 0.5 + edge],
            [0.0, 0.0, 1.0],
            [0.0, 0.0, -1.0],
        ]
    )
    inside = planes @ first
    inside[4] -= near_m
    inside[5] += far_m
    begin, end = np.zeros(first.shape[1]), np.full(first.shape[1], float(shape[2]))
    for plane, value in zip(planes @ step, inside, strict=True):  # value + k plane >= 0
        if abs(plane) < 1e-9:
            end = np.where(value < 0.0, 0.0, end)
        elif plane > 0.0:
            begin = np.maximum(begin, np.ceil(-value / plane))
        else:
            end = np.minimum(end, np.floor(-value / plane) + 1.0)
    seen = np.flatnonzero(end > begin)
    begin_of, count = begin[seen].astype(np.int32), (end[seen] - begin[seen]).astype(np.int32)
    within = np.arange(int(count.sum()), dtype=np.int32) - np.repeat(np.cumsum(count, dtype=np.int32) - count, count)
    start = (first[:, seen] + step[:, None] * begin_of).astype(np.float32)
    k = within.astype(np.float32)
    z = np.repeat(start[2], count) + np.float32(step[2]) * k
    inverse = np.float32(1.0) / z
    u = (np.repeat(start[0], count) + np.float32(step[0]) * k) * inverse
    v = (np.repeat(start[1], count) + np.float32(step[1]) * k) * inverse
    cells = np.repeat((seen * shape[2]).astype(np.int32) + begin_of, count) + within
    column, row = ((pixel + np.float32(0.5)).astype(np.int32) for pixel in (u, v))
    return np.asarray(cells), np.asarray(z), column, row


def _add_occupied(
    log_odds: Floats, low: Integers, shape: tuple[int, int, int], depth: DepthImage, cell_m: float, far_m: float
) -> None:
    """Write the log-odds of the cells that contain points of pixels into those of a box."""
    R, camera = depth.T_odom_cam[:3, :3], depth.camera
    values, sigma, block = _nearest_of_blocks(depth, 0.5 * camera.K[0, 0] * cell_m / far_m)
    used = (values > 0.0) & (values < far_m)
    d, sigma = values[used], sigma[used]
    v, u = (axis.astype(np.float32) for axis in np.nonzero(used))
    # Cell of pixel (u, v) of the blocks: (A @ (u, v, 1)) d + b.
    to_pixel = np.array([[block, 0.0, 0.5 * (block - 1)], [0.0, block, 0.5 * (block - 1)], [0.0, 0.0, 1.0]])
    A = (R @ np.linalg.inv(camera.K) @ to_pixel / cell_m).astype(np.float32)
    origin = (depth.T_odom_cam[:3, 3] / cell_m - low).astype(np.float32)
    i, j, k = (
        np.clip((a[0] * u + a[1] * v + a[2]) * d + b, 0.0, size - 1.0).astype(np.int32)
        for a, b, size in zip(A, origin, shape, strict=True)
    )
    cell = (i * shape[1] + j) * shape[2] + k
    share = np.minimum(np.bincount(cell)[cell] * np.float32(1.0 / FULL_BLOCKS), np.float32(1.0))
    # Squared probability that the error leaves the point in its cell, within a fifth.
    weight = 1.0 / (1.0 + np.float32(2.0 * np.pi / cell_m**2) * sigma * sigma)
    log_odds[cell] = np.float32(OCCUPIED_LOG_ODDS) * weight * share


def _nearest_of_blocks(depth: DepthImage, least_px: float) -> tuple[Floats, Floats, int]:
    """Return the nearest known depth of blocks of pixels, its standard deviation, and the side of the blocks [px].

    Blocks are as large as ``least_px`` allows. Thin things in front of others stay.
    """
    values, sigma, block = np.where(depth.known, depth.depth_m, np.float32(np.inf)), depth.sigma_m, 1
    while 2 * block <= least_px:
        for _ in range(2):  # along the rows, then along the columns
            even = values.shape[0] // 2 * 2
            nearer = values[0:even:2] <= values[1:even:2]
            values, sigma = (np.where(nearer, a[0:even:2], a[1:even:2]).T for a in (values, sigma))
        block *= 2
    return values, sigma, block
