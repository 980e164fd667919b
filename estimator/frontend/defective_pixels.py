"""Correction of the defective pixels of a camera, which are found while it moves.

A pixel that is stuck at black, at white or at any other level looks like a corner of high contrast that does not move.
New features are detected there and lost in the next frame, and take the places of others: with one pixel in a
thousand, half of the features. A pixel that differs from its neighbourhood in one image may be texture. If it does so
again and again while the camera rotates, it is defective, and is replaced by the median of its neighbours from then on.
"""

import cv2
import numpy as np

from dronevio.models.arrays import Array, Image, Integers
from dronevio.models.rotation import log_so3

MIN_DEVIATION = 30
"""Smallest difference of a defective pixel from the median of its neighbourhood [grey levels]."""
MIN_IMAGES = 4
"""Number of successive examined images in which a defective pixel differs."""
MIN_ROTATION_RAD = 0.02
"""Smallest rotation of the camera between examined images [rad]; texture moves by 9 pixels of EuRoC's cameras."""
MIN_FRAMES = 10
"""Smallest number of frames between examined images; each takes about a millisecond."""
MAX_SHARE = 0.01
"""Largest share of differing pixels in an image that is examined; where there are more, other causes prevail."""
SIDE_PX = 3
"""Side of the neighbourhood of a pixel [px]."""
NEIGHBOURS = SIDE_PX**2 - 1
"""Number of neighbours of a pixel."""


class DefectivePixels:
    """The defective pixels of one camera that are known so far."""

    def __init__(self) -> None:
        """Begin without a known defect."""
        self._pixels: Integers = np.zeros(0, np.int64)  # known defects, as indices of the flattened image, sorted
        self._neighbours: Integers = np.zeros((0, NEIGHBOURS), np.int64)  # of each, likewise
        self._suspects: Integers = np.zeros(0, np.int64)  # sorted
        self._counts: Integers = np.zeros(0, np.int64)  # number of successive images in which each suspect differs
        self._R_cur_last, self._frames = np.eye(3), MIN_FRAMES  # since the last examined image

    @property
    def count(self) -> int:
        """Number of known defective pixels."""
        return len(self._pixels)

    def corrected(self, image: Image | None, R_cur_prev: Array) -> Image | None:
        """Return an image (H, W) with the known defective pixels replaced, or the image itself if there are none.

        Args:
            image: The next image of the camera; None if it has none in this frame.
            R_cur_prev: (3, 3) Rotation since the frame before, of this camera or of another one of the rig.
        """
        self._R_cur_last, self._frames = R_cur_prev @ self._R_cur_last, self._frames + 1
        if image is None or not len(self._pixels):
            return image
        repaired = image.copy()
        flat = repaired.reshape(-1)
        middle = np.sort(flat[self._neighbours], axis=1)[:, NEIGHBOURS // 2 - 1 : NEIGHBOURS // 2 + 1]
        flat[self._pixels] = middle.mean(axis=1)  # the median
        return repaired

    def examine(self, image: Image) -> None:
        """Search defective pixels in a corrected image, unless the camera has hardly rotated since the last search."""
        if self._frames < MIN_FRAMES or (
            len(self._suspects) and float(np.linalg.norm(log_so3(self._R_cur_last))) < MIN_ROTATION_RAD
        ):
            return
        self._R_cur_last, self._frames = np.eye(3), 0
        differs = cv2.absdiff(image, cv2.medianBlur(image, SIDE_PX)) >= MIN_DEVIATION
        deviating = np.flatnonzero(differs)
        if len(deviating) > MAX_SHARE * image.size:
            deviating = deviating[:0]
        counts = np.ones(len(deviating), np.int64)
        if len(self._suspects):
            row = np.minimum(np.searchsorted(self._suspects, deviating), len(self._suspects) - 1)
            counts += np.where(self._suspects[row] == deviating, self._counts[row], 0)
        defective = counts >= MIN_IMAGES
        self._suspects, self._counts = deviating[~defective], counts[~defective]
        if defective.any():
            self._pixels = np.union1d(self._pixels, deviating[defective])
            self._neighbours = _neighbours(self._pixels, image.shape)


def _neighbours(pixels: Integers, shape: tuple[int, ...]) -> Integers:
    """Return the neighbours (N, 8) of pixels (N,) in an image, all as indices of the flattened image."""
    (height, width), (rows, columns) = shape, np.divmod(pixels, shape[1])
    down, right = (np.delete(offsets.ravel(), NEIGHBOURS // 2) for offsets in np.mgrid[-1:2, -1:2])
    near_rows = np.clip(rows[:, None] + down, 0, height - 1)
    return np.asarray(near_rows * width + np.clip(columns[:, None] + right, 0, width - 1))
