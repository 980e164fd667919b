"""New corners: the best of each cell of a grid that holds no feature yet (Shi and Tomasi, "Good features to track",
CVPR 1994), so that features are spread over the image.

They are looked for in the image at half its size, which costs a quarter, and moved to the best place nearby in the
whole image. That is a whole pixel, where a patch can be cut out without interpolation; where between pixels the
corner is does not matter, since it is the patch around it that is followed.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]

HALF = 2  # full pixels for one that is looked at
BLOCK_AT_HALF, BLOCK = 3, 5  # side of the square over which gradients are summed [px], at half and at full size
REACH = 3  # how far a corner may be from where it is at half the size [px]


@dataclass(frozen=True)
class CornerConfig:
    """Which corners are taken."""

    cell_px: int = 44
    """Side of the grid's cells [px]; each holds at most one new corner: 187 cells at 752×480."""
    min_score: float = 4e-4
    """Smallest eigenvalue of the gradient matrix that makes a corner (image scaled to 0…1)."""
    min_over_noise: float = 2.5e-5
    """The same over the square of the image's noise [1 / grey levels²]: twice what noise alone scores in an image."""
    spacing_px: int = 22
    """Distance of a new corner from all features [px]."""


def new_corners(image: Image, noise: float, taken: Array, border_px: int, config: CornerConfig) -> Array:
    """Return the best corners (N, 2) of the cells without a feature [px].

    Args:
        image: Where to look.
        noise: Standard deviation of its noise [grey levels].
        taken: (M, 2) Where features are already [px].
        border_px: No corner is nearer to the image's border [px].
        config: Which are taken.
    """
    side = config.cell_px // HALF
    half = cv2.resize(image, None, fx=1.0 / HALF, fy=1.0 / HALF, interpolation=cv2.INTER_AREA)
    score = np.asarray(cv2.cornerMinEigenVal(half, blockSize=BLOCK_AT_HALF, ksize=3), np.float32)
    edge = -(-(border_px + REACH) // HALF)
    score[:edge] = score[-edge:] = 0.0
    score[:, :edge] = score[:, -edge:] = 0.0
    _clear_around(score, taken / HALF, config.spacing_px / HALF)
    # The grid is centred; strips narrower than a cell are left at the image's borders.
    rows, columns = score.shape[0] // side, score.shape[1] // side
    top, left = (score.shape[0] - rows * side) // 2, (score.shape[1] - columns * side) // 2
    cells = score[top : top + rows * side, left : left + columns * side]
    cells = cells.reshape(rows, side, columns, side).transpose(0, 2, 1, 3).reshape(rows * columns, side * side)
    best = cells.argmax(axis=1)
    strong = np.take_along_axis(cells, best[:, None], axis=1)[:, 0] > max(
        config.min_score, config.min_over_noise * noise**2
    )
    free = np.ones((rows, columns), dtype=np.bool_)
    row, column = ((taken[:, ::-1] / HALF - [top, left]) // side).astype(int).T
    free[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)] = False
    row, column = np.divmod(np.flatnonzero(strong & free.ravel()), columns)
    best = best[strong & free.ravel()]
    at_half = np.stack([left + column * side + best % side, top + row * side + best // side], axis=1)
    low = HALF * np.stack([left + column * side, top + row * side], axis=1)
    return np.clip(_best_nearby(image, HALF * at_half), low, low + HALF * side - 1)  # each stays in its cell


def _best_nearby(image: Image, corners: npt.NDArray[np.int64]) -> Array:
    """Return the best places (N, 2) near to some corners (N, 2) of an image [px]."""
    span = np.arange(-REACH - BLOCK // 2 - 1, REACH + BLOCK // 2 + 2)
    rows = np.clip(corners[:, 1, None] + span, 0, image.shape[0] - 1)
    columns = np.clip(corners[:, 0, None] + span, 0, image.shape[1] - 1)
    around = image[rows[:, :, None], columns[:, None, :]].astype(np.float32)
    x = around[:, 1:-1, 2:] - around[:, 1:-1, :-2]
    y = around[:, 2:, 1:-1] - around[:, :-2, 1:-1]
    products, side = np.stack([x * x, x * y, y * y]), 2 * REACH + 1
    # Sums over the block, one axis after the other
    down = np.sum([products[:, :, i : i + side] for i in range(BLOCK)], axis=0)
    xx, xy, yy = np.sum([down[..., i : i + side] for i in range(BLOCK)], axis=0)
    score = 0.5 * (xx + yy) - np.hypot(0.5 * (xx - yy), xy)  # the smaller eigenvalue
    row, column = np.divmod(score.reshape(-1, side**2).argmax(axis=1), side)
    return np.asarray(corners + np.stack([column, row], axis=1) - REACH, np.float64)


def _clear_around(score: npt.NDArray[np.float32], places: Array, radius: float) -> None:
    """Set what is near to some places (M, 2) to zero."""
    reach = int(radius)
    across, down = (d.ravel() for d in np.meshgrid(*[np.arange(-reach, reach + 1)] * 2))
    disc = across**2 + down**2 <= radius**2
    centres = np.rint(places).astype(int)
    columns = np.clip(centres[:, 0, None] + across[disc], 0, score.shape[1] - 1)
    rows = np.clip(centres[:, 1, None] + down[disc], 0, score.shape[0] - 1)
    score[rows, columns] = 0.0
