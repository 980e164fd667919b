"""Types of arrays. Shapes and units are in the docstrings of what has them."""

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
