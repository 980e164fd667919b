"""Detection of new corners: the best of each grid cell without a feature, so that features cover the image evenly.

The corner score is the smaller eigenvalue of the gradient matrix (Shi and Tomasi, "Good features to track", CVPR 1994).
It is computed on the image at half resolution, which costs a quarter of the time, and each corner is then moved to the
best pixel nearby at full resolution. Whole pixels let a patch be extracted without interpolation; the position of
the corner within the pixel does not matter, because the tracker follows the patch around it.
"""

from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array, Image
from dronevio.models.ranges import Range, Settings

DOWNSAMPLING = 2  # pixels at full resolution per pixel of the image in which corners are detected
COARSE_BLOCK_PX, FINE_BLOCK_PX = 3, 5  # side of the block over which gradients are summed, at half and full resolution
REFINEMENT_RADIUS_PX = 3  # largest displacement of a corner in the refinement, in each direction
MIN_SCORE_OVER_NOISE = 2.5e-5
"""Smallest accepted ratio of the eigenvalue to the variance of the image noise [1 / grey levels²], which is twice the
ratio that noise alone produces."""


@dataclass(frozen=True)
class CornerConfig(Settings):
    """Settings of the corner detection."""

    cell_px: Annotated[int, Range(8, 500)] = 44
    """Side of the grid cells [px]. Each cell yields at most one new corner; an image of 752×480 has 187 cells."""
    min_score: Annotated[float, Range(above=0.0)] = 4e-4
    """Smallest accepted eigenvalue of the gradient matrix, for grey levels scaled to [0, 1]."""
    spacing_px: Annotated[int, Range(1, 500)] = 22
    """Smallest distance between a new corner and any existing feature [px]."""


def detect_corners(image: Image, noise: float, occupied: Array, border_px: int, config: CornerConfig) -> Array:
    """Return the best corners (N, 2) [px] of the grid cells without a feature.

    Args:
        image: (H, W) Image in which corners are detected.
        noise: Standard deviation of the image noise [grey levels].
        occupied: (M, 2) Positions of the existing features [px].
        border_px: Smallest distance of a corner from the image border [px].
        config: Settings of the detection.
    """
    # Shi-Tomasi score at half resolution, zero near the border and around features
    side = config.cell_px // DOWNSAMPLING
    coarse = cv2.resize(image, None, fx=1.0 / DOWNSAMPLING, fy=1.0 / DOWNSAMPLING, interpolation=cv2.INTER_AREA)
    score = np.asarray(cv2.cornerMinEigenVal(coarse, blockSize=COARSE_BLOCK_PX, ksize=3), np.float32)
    border = -(-(border_px + REFINEMENT_RADIUS_PX) // DOWNSAMPLING)
    score[:border] = score[-border:] = 0.0
    score[:, :border] = score[:, -border:] = 0.0
    _clear_around(score, occupied / DOWNSAMPLING, config.spacing_px / DOWNSAMPLING)
    # The grid is centred; strips narrower than a cell remain unused at the borders of the image.
    rows, columns = score.shape[0] // side, score.shape[1] // side
    top, left = (score.shape[0] - rows * side) // 2, (score.shape[1] - columns * side) // 2
    cells = score[top : top + rows * side, left : left + columns * side]
    cells = cells.reshape(rows, side, columns, side).transpose(0, 2, 1, 3).reshape(rows * columns, side * side)
    best = cells.argmax(axis=1)
    min_score = max(config.min_score, MIN_SCORE_OVER_NOISE * noise**2)
    is_strong = np.take_along_axis(cells, best[:, None], axis=1)[:, 0] > min_score
    # Cells without a feature
    is_free = np.ones((rows, columns), dtype=np.bool_)
    row, column = ((occupied[:, ::-1] / DOWNSAMPLING - [top, left]) // side).astype(int).T
    is_free[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)] = False
    chosen = is_strong & is_free.ravel()
    # Refinement at full resolution
    row, column = np.divmod(np.flatnonzero(chosen), columns)
    best = best[chosen]
    corners = np.stack([left + column * side + best % side, top + row * side + best // side], axis=1)
    low = DOWNSAMPLING * np.stack([left + column * side, top + row * side], axis=1)
    high = low + DOWNSAMPLING * side - 1
    return np.clip(_refined(image, DOWNSAMPLING * corners), low, high)  # a corner stays in its cell


def _refined(image: Image, corners: npt.NDArray[np.int64]) -> Array:
    """Return for each corner (N, 2) the pixel of the highest score in its neighbourhood, at full resolution."""
    reach = REFINEMENT_RADIUS_PX + FINE_BLOCK_PX // 2 + 1
    offsets = np.arange(-reach, reach + 1)
    rows = np.clip(corners[:, 1, None] + offsets, 0, image.shape[0] - 1)
    columns = np.clip(corners[:, 0, None] + offsets, 0, image.shape[1] - 1)
    windows = image[rows[:, :, None], columns[:, None, :]].astype(np.float32)
    gradient_x = windows[:, 1:-1, 2:] - windows[:, 1:-1, :-2]
    gradient_y = windows[:, 2:, 1:-1] - windows[:, :-2, 1:-1]
    products = np.stack([gradient_x * gradient_x, gradient_x * gradient_y, gradient_y * gradient_y])
    side = 2 * REFINEMENT_RADIUS_PX + 1
    # The sum over the block is separable: down the columns first, then along the rows.
    column_sums = np.sum([products[:, :, i : i + side] for i in range(FINE_BLOCK_PX)], axis=0)
    xx, xy, yy = np.sum([column_sums[..., i : i + side] for i in range(FINE_BLOCK_PX)], axis=0)
    score = 0.5 * (xx + yy) - np.hypot(0.5 * (xx - yy), xy)  # the smaller eigenvalue
    row, column = np.divmod(score.reshape(-1, side**2).argmax(axis=1), side)
    return np.asarray(corners + np.stack([column, row], axis=1) - REFINEMENT_RADIUS_PX, np.float64)


def _clear_around(score: npt.NDArray[np.float32], centres: Array, radius: float) -> None:
    """Set the scores within a radius of some points (M, 2) to zero, in place."""
    for centre in np.rint(centres).astype(int).tolist():
        cv2.circle(score, centre, int(radius), 0.0, cv2.FILLED)
