"""The nearest depth in square windows of images, for windows of any size around any pixel.

Larger windows are kept at a lower resolution, so that each has a few blocks of pixels on either side.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

_LEAST_BLOCKS = 4
"""Least half side of a window in blocks of pixels; fewer would make it much wider than the footprint."""
_NOWHERE = 15
"""Binary logarithm of the side of a block that is larger than any image."""

Values = npt.NDArray[np.uint16]
Pixels = npt.NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class NearestDepths:
    """Least values of square windows around each block of pixels, for half sides that grow with the blocks."""

    least: Values
    """(N, W) Least value of each window around each block, one window below the other; 0 where it leaves the image."""
    place: Pixels
    """(I, R) By image and half side [px], the index of the first value of the smallest window that reaches as far,
    times 16, plus the binary logarithm of the side of its blocks; the last value, which is 0, if no window does."""

    @staticmethod
    def of(images: Iterable[tuple[Values, int, int]]) -> "NearestDepths":
        """Return the least values of the windows of images of one size.

        Args:
            images: Values (H, W) of each image, with the half sides of the smallest and of the largest window that
                will be asked for [px].
        """
        windows, reaches, first, width = list[Values](), list[list[tuple[int, int]]](), 0, 0
        for values, least_px, most_px in images:
            width, reach = values.shape[1], list[tuple[int, int]]()
            for window, reach_px, shift in _windows(values, least_px, most_px):
                windows.append(window)
                reach.append((reach_px, first << 4 | shift))
                first += len(window) * width
            reaches.append(reach)
        least = np.zeros((first // width + 1, width), np.uint16)
        row = 0
        for window in windows:
            least[row : row + len(window), : window.shape[1]] = window
            row += len(window)
        radii = np.arange(2 + max(each[-1][0] for each in reaches))
        place = np.array([_place(radii, reach, first << 4 | _NOWHERE) for reach in reaches], np.int32)
        return NearestDepths(least, place)

    def at(self, column: Pixels, row: Pixels, radius_px: Pixels, image: Pixels) -> Values:
        """Return the least values (N,) in windows around pixels; 0 for windows that are larger than any that is kept.

        Args:
            column: (N,) Columns of the pixels.
            row: (N,) Rows of the pixels.
            radius_px: (N,) Half sides of the windows [px].
            image: (N,) Numbers of the images.
        """
        sizes = self.place.shape[1]
        place = np.take(self.place, image * sizes + np.minimum(radius_px, sizes - 1))
        shift = place & 15
        return np.asarray(np.take(self.least, (place >> 4) + (row >> shift) * self.least.shape[1] + (column >> shift)))


def _windows(values: Values, least_px: int, most_px: int) -> Iterable[tuple[Values, int, int]]:
    """Yield windows: least values, reach from any pixel of the middle block [px], log2 of the side of the blocks."""
    radius, reach_px, shift = max(1, least_px), 0, 0
    while not reach_px or reach_px < most_px:
        while _LEAST_BLOCKS << (shift + 1) <= radius:
            values, shift = _halved(values), shift + 1
        blocks = -(-radius >> shift)
        window = np.ones((2 * blocks + 1, 2 * blocks + 1), np.uint8)
        least = cv2.erode(values, window, borderType=cv2.BORDER_CONSTANT, borderValue=0)
        reach_px, radius = blocks << shift, (blocks + 1) << shift
        yield np.asarray(least, np.uint16), reach_px, shift


def _place(radii: npt.NDArray[np.integer], reach: list[tuple[int, int]], nowhere: int) -> npt.NDArray[np.integer]:
    """Return the place of the smallest window that reaches as far as each half side (R,)."""
    reach_px, place = zip(*reach, strict=True)
    return np.asarray(np.array([*place, nowhere])[np.searchsorted(reach_px, radii)])


def _halved(values: Values) -> Values:
    """Return the least values of blocks of 2 × 2 pixels; 0 where a block leaves the image."""
    height, width = values.shape
    even = cv2.copyMakeBorder(values, 0, height % 2, 0, width % 2, cv2.BORDER_CONSTANT, value=0)
    rows = np.minimum(even[::2], even[1::2])
    return np.minimum(rows[:, ::2], rows[:, 1::2])
