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
    """(N, W) Least value of each window around each block, one window below the other; 0 where it leaves the image."""
    place: Integers
    """(L,) Index of the first value of each window, times 16, plus the binary logarithm of the side of its blocks."""

    @staticmethod
    def of(values: Values, least_px: float) -> "NearestDepths":
        """Return the least values of the windows of an image.

        Args:
            values: (H, W) Values.
            least_px: Half side of the smallest footprint that will be asked for [px].
        """
        most, width, shift = _MOST_OF_IMAGE * len(values), values.shape[1], 0
        radius, first = max(1, int(np.ceil(least_px))), 0
        reach, place, images = list[int](), list[int](), list[npt.NDArray[np.generic]]()
        while not images or radius <= most:
            while _LEAST_BLOCKS << (shift + 1) <= radius:
                values, shift = halved(values), shift + 1
            blocks = -(-radius >> shift)
            window = np.ones((2 * blocks + 1, 2 * blocks + 1), np.uint8)
            images.append(cv2.erode(values, window, borderType=cv2.BORDER_CONSTANT, borderValue=0))
            reach.append(blocks << shift)
            place.append(first << 4 | shift)
            first += len(values) * width
            radius = (blocks + 1) << shift
        least = np.zeros((first // width, width), np.uint16)
        for at, image in zip(place, images, strict=True):
            row = (at >> 4) // width
            least[row : row + image.shape[0], : image.shape[1]] = image
        return NearestDepths(np.array(reach), least, np.array(place))

    def at(self, column: Pixels, row: Pixels, radius_px: Pixels) -> Values:
        """Return the least values (N,) in windows around pixels.

        Args:
            column: (N,) Columns of the pixels.
            row: (N,) Rows of the pixels.
            radius_px: (N,) Half sides of the windows, at most the largest of ``reach_px`` [px].
        """
        level = np.searchsorted(self.reach_px, np.arange(self.reach_px[-1] + 1))  # of each radius
        place = np.take(self.place[level].astype(np.int32), radius_px)
        shift = place & 15
        return np.asarray(np.take(self.least, (place >> 4) + (row >> shift) * self.least.shape[1] + (column >> shift)))


def halved(values: Values) -> Values:
    """Return the least values of blocks of 2 × 2 pixels; 0 where a block leaves the image."""
    height, width = values.shape
    even = cv2.copyMakeBorder(values, 0, height % 2, 0, width % 2, cv2.BORDER_CONSTANT, value=0)
    rows = np.minimum(even[::2], even[1::2])
    return np.minimum(rows[:, ::2], rows[:, 1::2])
