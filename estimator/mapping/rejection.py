"""Which matched depths count, and how certain they are by what is around them.

A window at the edge of an object sees two surfaces, and a pixel without texture of its own takes the depth of the
texture beside it, which may be that of the other surface. Such depths are left out. The others are less certain where
surfaces are slanted, near edges, and where many depths were left out. All depths are disparities in pixels here, or
inverse depths in units in which the image moves by a pixel.
"""

import cv2
import numpy as np

from dronevio.estimator.mapping.refinement import WINDOW_PX
from dronevio.models.arrays import Floats, Mask

MAX_CHANGE_PX = 0.8
"""Change of the disparity within a band, beyond that of a slanted surface, above which there is an edge [px]."""
MAX_SLOPE = 0.6
"""Largest change of the disparity from pixel to pixel on a surface [px]."""
EDGE_PX = 3
"""Width of the bands on both sides of an edge in which disparities are left out [px]."""
OWN_PX = 0.6
"""Largest distance of a pixel from the centre of the information in its window, if the depth is its own [px]."""
BETWEEN_PX = 15
"""Largest distance on each side to a depth that supports a borrowed one [px]."""
BESIDE_PX = 24
"""Distance from an edge within which a disparity may be that of the other surface [px]."""
OTHER_SURFACE = 0.0035
"""Probability of that."""
HOLE_PX = 9
"""Side of the holes in the disparities that are no gaps, behind which there may be another surface [px]."""
SLANT_PX = 0.8
"""Standard deviation of the place in the window to which the disparity of a slanted surface belongs [px]."""
LEFT_OUT_PX = 0.25
"""Standard deviation of a disparity if all around it were left out [px]."""
AROUND_PX = 15
"""Side of the square in which they are counted [px]."""
SIMILAR_PX = 0.8
"""Difference of disparities up to which they support each other [px]."""
SMALLEST_PX = 40
"""Size of the smallest patch of disparities that nothing around it supports [px]."""
_FAR = 1e6  # more than any disparity
_FIXED = 16.0  # disparities are compared in sixteenths of a pixel


def slopes(matched: Floats) -> Floats:
    """Return the slope (H, W) of the surface at each pixel: medians of the differences along rows and columns [px]."""
    steps = np.float32(255.0 / MAX_SLOPE)  # of the median, which is fast for bytes
    is_matched = matched > 0.0
    total = np.zeros(matched.shape, np.float32)
    for before, after in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        difference = np.zeros(matched.shape, np.uint8)
        change = np.minimum(np.abs(matched[after] - matched[before]) * steps, np.float32(255.0))
        difference[before] = np.where(is_matched[before] & is_matched[after], change, np.float32(0.0))
        total += cv2.medianBlur(difference, 5)
    return np.asarray(np.minimum(total / steps, np.float32(MAX_SLOPE)))


def edges(disparity: Floats, matched: Floats, slope: Floats) -> Mask:
    """Return where (H, W) disparities are left out because the depth jumps.

    Windows at an edge see both surfaces, so that the nearer one seems wider than it is, and the farther one is hidden
    from one camera. What is narrower than the two bands, such as a pole, is kept: to lose it would be worse.

    Args:
        disparity: (H, W) Disparities that are known, 0 elsewhere [px].
        matched: (H, W) Disparities of the matcher, not more than 0 where there is none [px].
        slope: (H, W) Their `slopes` [px].
    """
    change = np.float32(MAX_CHANGE_PX) + np.float32(EDGE_PX) * slope
    low, high = _range_around(matched, EDGE_PX)
    farther, nearer = high > disparity + change, low < disparity - change
    square = np.ones((2 * EDGE_PX + 1, 2 * EDGE_PX + 1), np.uint8)
    kept = cv2.dilate(np.where(farther | nearer, np.float32(0.0), disparity), square)
    is_narrow = kept < disparity - change
    return np.asarray(farther | (nearer & ~is_narrow))


def borrowed(disparity: Floats, information: Floats) -> Mask:
    """Return where (H, W) disparities belong to the texture beside the pixel, and nothing supports them at the pixel.

    The information of a window is that of its gradients, g². Where its centre is not at the pixel, the disparity is
    borrowed from there, and counts only if there is a similar one, which is not borrowed, on the other side: a wall is
    known between two of its marks, but not the sky beside a gate.

    Args:
        disparity: (H, W) Disparities that are known, 0 elsewhere [px].
        information: (H, W) Squared derivative of the warped image with respect to the disparities.
    """
    (of_columns, along_columns), (of_rows, along_rows) = (
        (np.ones(size, np.float32), np.arange(size, dtype=np.float32) - np.float32(size // 2)) for size in WINDOW_PX
    )
    x, y, total = (
        cv2.sepFilter2D(information, cv2.CV_32F, columns, rows, borderType=cv2.BORDER_REPLICATE)
        for columns, rows in ((along_columns, of_rows), (of_columns, along_rows), (of_columns, of_rows))
    )
    reach = np.float32(OWN_PX) * total
    is_own = (np.abs(x) < reach) & (np.abs(y) < reach)
    own = np.where(is_own, disparity, np.float32(0.0))
    own_or_far = np.where(own > 0.0, own, np.float32(_FAR))
    unsupported = np.zeros(disparity.shape, bool)
    # Support from the side opposite to that from which a disparity is borrowed
    for borrows, (columns, rows), (column, row) in (
        (x >= reach, (BETWEEN_PX + 1, 3), (BETWEEN_PX, 1)),
        (x <= -reach, (BETWEEN_PX + 1, 3), (0, 1)),
        (y >= reach, (3, BETWEEN_PX + 1), (1, BETWEEN_PX)),
        (y <= -reach, (3, BETWEEN_PX + 1), (1, 0)),
    ):
        side = np.ones((rows, columns), np.uint8)
        high = cv2.dilate(own, side, anchor=(column, row))
        low = cv2.erode(own_or_far, side, anchor=(column, row))
        is_similar = (high >= disparity - np.float32(SIMILAR_PX)) & (low <= disparity + np.float32(SIMILAR_PX))
        unsupported |= borrows & ~is_similar
    return unsupported


def variance_around(disparity: Floats, matched: Floats, slope: Floats) -> Floats:
    """Return the variances (H, W) of disparities by what is around them [px²].

    A window on a slanted surface finds the disparity of a place that is only known to `SLANT_PX`. Beside an edge, a
    disparity is that of the other surface with a small probability p, which adds p J² for a jump by J that the slope
    does not explain; behind a gap, the other surface may be infinitely far. Where many disparities were left out, the
    others are less certain.

    Args:
        disparity: (H, W) Disparities that are known, 0 elsewhere [px].
        matched: (H, W) Disparities of the matcher, not more than 0 where there is none [px].
        slope: (H, W) Their `slopes` [px].
    """
    known = (disparity > 0.0).astype(np.uint8)
    is_gap = cv2.morphologyEx(known, cv2.MORPH_CLOSE, np.ones((HOLE_PX, HOLE_PX), np.uint8)) == 0
    low, high = _range_around(matched, BESIDE_PX, is_gap)
    jump = np.maximum(high - disparity, disparity - low) - np.float32(BESIDE_PX) * slope
    left_out = np.float32(1.0) - cv2.boxFilter(known, cv2.CV_32F, (AROUND_PX, AROUND_PX))
    return np.asarray(
        np.float32(SLANT_PX**2) * slope * slope
        + np.float32(OTHER_SURFACE) * np.square(np.maximum(jump, np.float32(0.0)))
        + np.float32(LEFT_OUT_PX**2) * left_out
    )


def _range_around(matched: Floats, reach_px: int, is_infinite: Mask | None = None) -> tuple[Floats, Floats]:
    """Return the smallest and the largest disparity (H, W) in the square around each pixel."""
    square = np.ones((2 * reach_px + 1, 2 * reach_px + 1), np.uint8)
    unknown = np.float32(_FAR) if is_infinite is None else np.where(is_infinite, np.float32(0.0), np.float32(_FAR))
    low = cv2.erode(np.where(matched > 0.0, matched, unknown), square)
    return np.asarray(low), np.asarray(cv2.dilate(matched, square))


def speckles(disparity: Floats) -> Mask:
    """Return where (H, W) disparities are 0, or belong to small patches that nothing around them supports."""
    fixed = np.rint(_FIXED * disparity).astype(np.int16)
    cv2.filterSpeckles(fixed, 0, SMALLEST_PX, _FIXED)
    return np.asarray(fixed == 0)
