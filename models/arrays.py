"""Types of arrays, and a fast median. Shapes and units are in the docstrings of what has them."""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
"""Real numbers."""
Floats = npt.NDArray[np.float32]
"""Real numbers of single precision, such as images of depth."""
Integers = npt.NDArray[np.int64]
"""Whole numbers: identities, indices, and times [ns]."""
Mask = npt.NDArray[np.bool_]
"""Whether something holds, for each element."""
Image = npt.NDArray[np.uint8]
"""(H, W) Grey or (H, W, 3) colour image."""


def median(values: Array) -> Array:
    """Return the median (…) of some hundred finite values (N, …), N > 0, several times as fast as `numpy.median`."""
    half, ordered = len(values) // 2, np.sort(values, axis=0)
    return np.asarray(ordered[half] if len(values) % 2 else 0.5 * (ordered[half - 1] + ordered[half]))
