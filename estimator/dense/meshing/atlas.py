"""Packing of rectangles into one image."""

import numpy as np
import numpy.typing as npt

Indices = npt.NDArray[np.int64]


def pack(sizes: Indices, width: int) -> tuple[Indices, int]:
    """Return the upper left corners of rectangles in an image, in shelves of decreasing height, and its height.

    Args:
        sizes: (N, 2) Widths and heights of the rectangles, at most the width of the image [px].
        width: Width of the image [px].

    Returns:
        (N, 2) Columns and rows of the corners [px]; height of all shelves [px].
    """
    corners = np.zeros((len(sizes), 2), np.int64)
    x = y = shelf = 0
    for n in np.argsort(-sizes[:, 1], kind="stable").tolist():
        w, h = sizes[n].tolist()
        if x + w > width:
            x, y, shelf = 0, y + shelf, 0
        corners[n] = x, y
        x, shelf = x + w, max(shelf, h)
    return corners, y + shelf
