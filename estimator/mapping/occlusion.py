"""Holes of a disparity image that an occlusion explains.

Beside an edge of a near surface, one camera sees a part of the farther one that the surface hides from the other
camera. It is as wide as the jump of the disparity [px], and has no match; at both edges, windows that see both
surfaces are left out. Such a hole hides nothing nearer than the near surface: whatever did would hide a wider part.
"""

import numpy as np

from dronevio.estimator.mapping.rejection import EDGE_PX
from dronevio.models.arrays import Floats

SLACK_PX = 2 * EDGE_PX + 1
"""Width of a hole beyond the jump of the disparity that windows at both edges explain [px]."""
LEAST_JUMP_PX = 2.0
"""Least jump of the disparity that is an edge [px]."""


def occluded(disparity: Floats) -> Floats:
    """Return the largest disparities (H, W) that pixels in explained holes can have; 0 elsewhere [px].

    Args:
        disparity: (H, W) Disparities of the left image, 0 where they are unknown [px].
    """
    known, columns = disparity > 0.0, np.arange(disparity.shape[1], dtype=np.int16)
    # The known pixels on both sides in the row
    left = np.maximum.accumulate(np.where(known, columns, np.int16(-1)), axis=1)
    right = np.minimum.accumulate(np.where(known, columns, np.int16(len(columns)))[:, ::-1], axis=1)[:, ::-1]
    is_between = ~known & (left >= 0) & (right < len(columns))
    rows, places = np.nonzero(is_between)
    a, b = left[rows, places], right[rows, places]
    on_left, on_right = disparity[rows, a], disparity[rows, b]
    jump = np.abs(on_left - on_right)
    is_explained = (b - a - 1 <= jump + SLACK_PX) & (jump >= LEAST_JUMP_PX)
    found = np.zeros_like(disparity)
    found[rows[is_explained], places[is_explained]] = np.maximum(on_left, on_right)[is_explained]
    return found
