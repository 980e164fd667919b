"""Holes of a depth image: pixels of unknown depth that may hide a thing, and those that have the depth around them.

Matchers reject single pixels of smooth surfaces, and all pixels along thin things such as poles, and along edges. A
hole is feared to hide a thing if it is long, unless it is too thin to hide one at the distance of a cell.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import reduce

import cv2
import numpy as np
import numpy.typing as npt

from dronevio.estimator.mapping.nearest_depth import Values
from dronevio.models.arrays import Image, Mask

HOLE_PX = 13
"""Length of holes that may hide a thing; an odd number [px]."""
HIDDEN_M = 0.04
"""Width of the thinnest thing that a hole is feared to hide near the camera [m]."""
_DISCS_PX = (2, 3, 4, 5)
"""Radii of the discs by which the width of holes is told, less than half of `HOLE_PX` [px]."""


def _line(column: float, row: float) -> npt.NDArray[np.uint8]:
    """Return the pixels of a line of `HOLE_PX` through the middle of a square, with steps of at most a pixel."""
    half = HOLE_PX // 2
    steps = np.arange(-half, half + 1)
    line = np.zeros((HOLE_PX, HOLE_PX), np.uint8)
    line[half + np.rint(row * steps).astype(int), half + np.rint(column * steps).astype(int)] = 1
    return line


_LINES = [_line(*steps) for steps in ((1, 0), (1, 0.5), (1, 1), (0.5, 1), (0, 1), (-0.5, 1), (-1, 1), (-1, 0.5))]
"""Lines in eight directions, so that a stripe of a quarter of `HOLE_PX` is found at any angle."""
_SQUARE, _CROSS = np.ones((3, 3), np.uint8), np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)
_STEPS = (_SQUARE, _CROSS, _CROSS, _CROSS, _SQUARE)
"""Neighbourhoods by which a disc, an octagon, grows by a pixel each; a stripe of 2 r + 1 pixels has room for it at any
angle."""


@dataclass(frozen=True)
class Band:
    """A range of depths in which the same holes may hide a thing."""

    begin_m: float
    """Its near end [m]."""
    end_m: float
    """Its far end [m]."""
    disc_px: int
    """Radius of the disc that fits into such holes; 0 if all long holes are such [px]."""


def bands_between(near_m: float, far_m: float, focal_px: float) -> list[Band]:
    """Return the bands between two depths, from far to near.

    A thing as wide as `HIDDEN_M` covers discs of radius r up to the depth f `HIDDEN_M` / (2 r + 1).

    Args:
        near_m: Smaller depth [m].
        far_m: Larger depth [m].
        focal_px: Focal length f of the depth image [px].
    """
    ends_m = [far_m, *(HIDDEN_M * focal_px / (2 * disc_px + 1) for disc_px in _DISCS_PX), near_m]
    limits_m = np.clip(ends_m, near_m, far_m).tolist()
    bands = zip(limits_m[1:], limits_m[:-1], (0, *_DISCS_PX), strict=True)
    return [Band(begin_m, end_m, disc_px) for begin_m, end_m, disc_px in bands if begin_m < end_m]


def without_holes(values: Values, known: Mask, bands: Sequence[Band]) -> Iterator[Values]:
    """Yield an image (H, W) for each band whose holes that hide nothing have the least value around them.

    A pixel hides nothing if no line through it is unknown for `HOLE_PX`, or if no disc with the radius of the band that
    contains it is unknown. What lies outside the image is unknown.

    Args:
        values: (H, W) Values, 0 where they are unknown.
        known: (H, W) Where they are known.
        bands: Bands from far to near.

    Yields:
        Values (H, W), 0 where a thing may be hidden.
    """
    is_known = known.view(np.uint8)
    is_unknown = np.asarray(1 - is_known, np.uint8)
    closings = (cv2.morphologyEx(is_known, cv2.MORPH_CLOSE, line) for line in _LINES)
    is_small = np.asarray(reduce(np.bitwise_and, closings), np.uint8)
    around = cv2.erode(values - is_unknown, np.ones((HOLE_PX, HOLE_PX), np.uint8))  # 0 - 1 is the largest value
    filled = values + around * is_unknown
    middles, radius_px = is_unknown, 0  # of the discs of unknown pixels
    for band in bands:
        middles = reduce(_eroded, _STEPS[radius_px : band.disc_px], middles)
        radius_px = band.disc_px
        in_discs = reduce(_dilated, _STEPS[:radius_px], middles)
        yield np.asarray(filled * (is_small | (1 - in_discs)), np.uint16)


def _eroded(image: Image, neighbours: Image) -> Image:
    """Return where all neighbours are one in an image (H, W) of zeros and ones that is surrounded by ones."""
    return np.asarray(cv2.erode(image, neighbours, borderType=cv2.BORDER_CONSTANT, borderValue=1), np.uint8)


def _dilated(image: Image, neighbours: Image) -> Image:
    """Return where any neighbour is one in an image (H, W) of zeros and ones that is surrounded by ones."""
    return np.asarray(cv2.dilate(image, neighbours, borderType=cv2.BORDER_CONSTANT, borderValue=1), np.uint8)
