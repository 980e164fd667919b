"""The nearest depth in square windows of an image, for windows of any size around any pixel.

Larger windows are kept at a lower resolution, so that each has a few blocks of pixels on either side.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Integers

_MOST_OF_IMAGE = 0.25
"""Largest half side of a window, as a share of the image's height."""
_LEAST_BLOCKS = 4
"""Least half side of a window in blocks of pixels; fewer would make it much wider than the footprint."""

Values = npt.NDArray[np.uint16]
Pixels = npt.NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class NearestDepths:
    """Least values of square windows around each block of pixels, for half sides that grow with the blocks."""

    reach_px: Integers
    """(L,) Distance from any pixel of the middle block to which each window reaches at least [px]."""
    least: Values
    """(N,) Least values of each window around each block; 0 where it leaves the image."""
    first: Pixels
    """(L,) Index of the first value of each window."""
    width: Pixels
    """(L,) Number of blocks in a row."""
    shift: Pixels
    """(L,) Binary logarithm of the side of the blocks [px]."""

    @staticmethod
    def of(values: Values, least_px: float) -> "NearestDepths":
        """Return the least values of the windows of an image.

        Args:
            values: (H, W) Values.
            least_px: Half side of the smallest footprint that will be asked for [px].
        """
        most, radius, shift = _MOST_OF_IMAGE * len(values), max(1, int(np.ceil(least_px))), 0
        levels: list[tuple[int, Values, int]] = []
        while not levels or radius <= most:
            while _LEAST_BLOCKS << (shift + 1) <= radius:
                values, shift = halved(values), shift + 1
            blocks = -(-radius >> shift)
            window = np.ones((2 * blocks + 1, 2 * blocks + 1), np.uint8)
            least = cv2.erode(values, window, borderType=cv2.BORDER_CONSTANT, borderValue=0)
            levels.append((blocks << shift, np.asarray(least, np.uint16), shift))
            radius = (blocks + 1) << shift
        reach, images, shifts = zip(*levels, strict=True)
        return NearestDepths(
            np.array(reach),
            np.concatenate([image.ravel() for image in images]),
            np.cumsum([0, *(image.size for image in images[:-1])]).astype(np.int32),
            np.array([image.shape[1] for image in images], np.int32),
            np.array(shifts, np.int32),
        )

    def at(self, column: Pixels, row: Pixels, radius_px: Pixels) -> Values:
        """Return the least values (N,) in windows around pixels.

        Args:
            column: (N,) Columns of the pixels.
            row: (N,) Rows of the pixels.
            radius_px: (N,) Half sides of the windows, at most the largest of ``reach_px`` [px].
        """
        level = np.searchsorted(self.reach_px, np.arange(self.reach_px[-1] + 1))  # of each radius
        first, width, shift = (np.take(of_level[level], radius_px) for of_level in (self.first, self.width, self.shift))
        return np.asarray(np.take(self.least, first + (row >> shift) * width + (column >> shift)))


def halved(values: Values) -> Values:
    """Return the least values of blocks of 2 × 2 pixels; 0 where a block leaves the image."""
    height, width = values.shape
    even = cv2.copyMakeBorder(values, 0, height % 2, 0, width % 2, cv2.BORDER_CONSTANT, value=0)
    rows = np.minimum(even[::2], even[1::2])
    return np.minimum(rows[:, ::2], rows[:, 1::2])
