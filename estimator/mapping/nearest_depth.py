"""The nearest depth in square windows of an image, for windows of any size around any pixel."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Integers

_GROWTH = 1.3
"""Ratio of the sides of successive windows; a smaller one costs time, a larger one completeness."""
_MOST_OF_IMAGE = 0.25
"""Largest half side of a window, as a share of the image's height."""
_LEAST_BLOCKS = 4
"""Least half side of a window in blocks of pixels; fewer would make it much wider than the footprint."""

Values = npt.NDArray[np.uint16]
Pixels = npt.NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class NearestDepths:
    """Least values of square windows around each block of pixels, for half sides that grow geometrically."""

    block_px: int
    """Side of the blocks, a power of two [px]."""
    reach_px: Integers
    """(L,) Distance from any pixel of the middle block to which each window reaches at least [px]."""
    least: Values
    """(L, H, W) Least value of the window around each block; 0 where the window leaves the image."""

    @staticmethod
    def of(values: Values, least_px: float) -> "NearestDepths":
        """Return the least values of the windows of an image.

        Args:
            values: (H, W) Values.
            least_px: Half side of the smallest footprint that will be asked for [px].
        """
        most = _MOST_OF_IMAGE * len(values)
        block = 1
        while 2 * block * _LEAST_BLOCKS <= least_px:
            values, block = _halved(values), 2 * block
        radii = [max(1, int(np.ceil(least_px / block)))]
        while (wider := max(radii[-1] + 1, int(_GROWTH * radii[-1]))) * block <= most:
            radii.append(wider)
        least = np.empty((len(radii), *values.shape), np.uint16)
        source: npt.NDArray[Any] = values
        for level, step in enumerate(np.diff(radii, prepend=0)):
            window = np.ones((2 * int(step) + 1, 2 * int(step) + 1), np.uint8)
            source = cv2.erode(source, window, dst=least[level], borderType=cv2.BORDER_CONSTANT, borderValue=0)
        return NearestDepths(block, np.array(radii) * block, least)

    def at(self, column: Pixels, row: Pixels, radius_px: Pixels) -> Values:
        """Return the least values (N,) in windows around pixels.

        Args:
            column: (N,) Columns of the pixels.
            row: (N,) Rows of the pixels.
            radius_px: (N,) Half sides of the windows, at most the largest of ``reach_px`` [px].
        """
        _, height, width = self.least.shape
        level = np.searchsorted(self.reach_px, np.arange(self.reach_px[-1] + 1)).astype(np.int32)[radius_px]
        shift = self.block_px.bit_length() - 1
        return np.asarray(np.take(self.least, (level * height + (row >> shift)) * width + (column >> shift)))


def _halved(values: Values) -> Values:
    """Return the least values of blocks of 2 × 2 pixels; 0 where a block leaves the image."""
    height, width = values.shape
    even = cv2.copyMakeBorder(values, 0, height % 2, 0, width % 2, cv2.BORDER_CONSTANT, value=0)
    rows = np.minimum(even[::2], even[1::2])
    return np.minimum(rows[:, ::2], rows[:, 1::2])
