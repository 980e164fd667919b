"""Evidence of a depth image about the cells of a lattice: log-odds of being occupied.

A cell is free if all of it lies in front of the nearest depth that any pixel of its footprint in the image can have;
a pixel of unknown depth may have any, unless it lies in a hole that is too small or too thin to hide a thing at the
distance of the cell, which has the nearest of the depths around it. A cell is occupied if the point of a pixel lies in
it. Behind surfaces nothing is known.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from dronevio.estimator.mapping.holes import bands_between, without_holes
from dronevio.estimator.mapping.nearest_depth import NearestDepths, Pixels, Values
from dronevio.models.arrays import Array, Floats, Integers
from dronevio.models.depth import DepthImage, Pinhole

FREE_LOG_ODDS = -0.4
"""Log-odds of a cell in front of the depths of its footprint."""
OCCUPIED_LOG_ODDS = 1.5
"""Log-odds of a cell that contains a depth without error."""
FREE_SIGMAS = 1.5
"""Standard deviations in front of a depth of which nothing is said."""
FULL_BLOCKS = 3.0
"""Number of blocks of pixels whose points in a cell are full evidence that it is occupied."""
_MOST_OF_IMAGE = 0.25
"""Largest half side of a footprint, as a share of the image's height."""
_LARGEST = 65535
"""Largest quantized depth, that of the range."""


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
    R = depth.T_odom_cam[:3, :3]
    half_m = np.float32(0.5 * cell_m * float(np.abs(R[:, 2]).sum()))
    of_column, of_row = (_half_sides(depth.camera, R, axis, cell_m) for axis in (0, 1))
    least, most = max(of_column.min(), of_row.min()), max(of_column.max(), of_row.max())
    largest_px = int(_MOST_OF_IMAGE * depth.camera.height)
    near_m = float(half_m + most / (largest_px - 0.5))
    if near_m >= far_m - half_m:
        return
    cells, z, u, v = _cells_in_view(low, shape, depth, cell_m, near_m, float(far_m - half_m))
    # All pixels of which a part lies in the footprint
    radius = (np.maximum(np.take(of_column, u), np.take(of_row, v)) / (z - half_m) + np.float32(1.499)).astype(np.int32)
    # The nearest depth in them, by the holes that may hide a thing up to the far side of the cell
    bands = bands_between(near_m + float(half_m), far_m, float(depth.camera.K[0, 0]))
    free_to = _in_steps(depth.depth_m, depth.sigma_m, 1.0, -FREE_SIGMAS, far_m)
    known = depth.known
    if depth.least_m is not None:
        free_to += _in_steps(depth.least_m, depth.sigma_m, 1.0, 0.0, far_m)  # 0 where the depth is known
        known |= depth.least_m > 0.0
    sizes_px = (
        (int(np.ceil(least / band.end_m + 0.5)), min(largest_px, int(most / (band.begin_m - 2.0 * half_m) + 1.5)))
        for band in bands
    )
    windows = NearestDepths.of(
        (closed, *sizes) for closed, sizes in zip(without_holes(free_to, known, bands), sizes_px, strict=True)
    )
    begins_m = np.array([band.begin_m for band in bands[:-1]], np.float32)
    number = np.asarray((z + half_m <= begins_m[:, None]).sum(axis=0, dtype=np.int32))
    is_free = (z + half_m) * np.float32(_LARGEST / far_m) <= windows.at(u, v, radius, number)
    log_odds[cells] = np.where(is_free, np.float32(FREE_LOG_ODDS), np.float32(0.0))


def _half_sides(camera: Pinhole, R: Array, axis: int, cell_m: float) -> Floats:
    """Return half the sides of the footprints of cells by the column, or row, of their centres, times z − h [px m].

    Args:
        camera: Camera of the depth image.
        R: (3, 3) Its orientation in the lattice.
        axis: 0 for columns, 1 for rows.
        cell_m: Side of the cells [m].
    """
    f, size = camera.K[axis, axis], (camera.width, camera.height)[axis]
    slopes = (np.arange(size + 1) - 0.5 - camera.K[axis, 2]) / f  # at the edges of the pixels
    sides = 0.5 * cell_m * f * np.abs(R[:, axis] - slopes[:, None] * R[:, 2]).sum(axis=1)
    return np.asarray(np.maximum(sides[:-1], sides[1:]), np.float32)


def _cells_in_view(
    low: Integers, shape: tuple[int, int, int], depth: DepthImage, cell_m: float, near_m: float, far_m: float
) -> tuple[Integers, Floats, Pixels, Pixels]:
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
    cells = np.repeat(seen * shape[2] + begin_of, count) + within
    column, row = ((pixel + np.float32(0.5)).astype(np.int32) for pixel in (u, v))
    return np.asarray(cells), np.asarray(z), column, row


def _add_occupied(
    log_odds: Floats, low: Integers, shape: tuple[int, int, int], depth: DepthImage, cell_m: float, far_m: float
) -> None:
    """Write the log-odds of the cells that contain points of pixels into those of a box."""
    R, camera, step_m = depth.T_odom_cam[:3, :3], depth.camera, np.float32(far_m / _LARGEST)
    nearest, block = _nearest_of_blocks(depth, 0.5 * camera.K[0, 0] * cell_m / far_m, far_m)
    d, used = (nearest >> 16).astype(np.float32) * step_m, np.flatnonzero(nearest < _LARGEST << 16)
    # Cell of pixel (u, v) of the blocks: (A @ (u, v, 1)) d + b.
    to_pixel = np.array([[block, 0.0, 0.5 * (block - 1)], [0.0, block, 0.5 * (block - 1)], [0.0, 0.0, 1.0]])
    A = (R @ np.linalg.inv(camera.K) @ to_pixel / cell_m).astype(np.float32)
    origin = (depth.T_odom_cam[:3, 3] / cell_m - low).astype(np.float32)
    v, u = (np.arange(size, dtype=np.float32) for size in d.shape)
    i, j, k = (
        np.clip((a[0] * u + (a[1] * v + a[2])[:, None]) * d + b, 0.0, size - 1.0).astype(np.int32)
        for a, b, size in zip(A, origin, shape, strict=True)
    )
    cell = np.take((i * shape[1] + j) * shape[2] + k, used)
    share = np.minimum(np.bincount(cell)[cell] * np.float32(1.0 / FULL_BLOCKS), np.float32(1.0))
    # Squared probability that the error leaves the point in its cell, within a fifth.
    sigma = (np.take(nearest, used) & _LARGEST).astype(np.float32) * step_m
    weight = 1.0 / (1.0 + np.float32(2.0 * np.pi / cell_m**2) * sigma * sigma)
    log_odds[cell] = np.float32(OCCUPIED_LOG_ODDS) * weight * share


def _nearest_of_blocks(depth: DepthImage, least_px: float, far_m: float) -> tuple[npt.NDArray[np.uint32], int]:
    """Return the nearest depth of blocks of pixels with its standard deviation, and the side of the blocks [px].

    Blocks are as large as ``least_px`` allows. Thin things in front of others stay. Depths are in the upper 16 bits,
    standard deviations in the lower ones, both in steps of ``far_m`` / 65535; what is unknown or beyond is the largest.
    """
    values, sigma = (_in_steps(image, image, 1.0, 0.0, far_m) for image in (depth.depth_m, depth.sigma_m))
    nearest, block = (values - (values == 0)).astype(np.uint32) << 16 | sigma, 1  # 0 - 1 is the largest value
    while 2 * block <= least_px:
        height, width = (size // 2 * 2 for size in nearest.shape)
        rows = np.minimum(nearest[0:height:2, :width], nearest[1:height:2, :width])
        nearest, block = np.minimum(rows[:, ::2], rows[:, 1::2]), 2 * block
    return nearest, block


def _in_steps(a: Floats, b: Floats, of_a: float, of_b: float, far_m: float) -> Values:
    """Return a weighted sum of two images (H, W) in steps of ``far_m`` / 65535, limited to their range."""
    steps = _LARGEST / far_m
    return np.asarray(cv2.addWeighted(a, of_a * steps, b, of_b * steps, 0.0, dtype=cv2.CV_16U), np.uint16)
