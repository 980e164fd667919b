"""Observations of a calibrated camera as those of a pinhole with unit focal length, with the noise they have there.

GTSAM has no factor for most lenses. A pixel u with noise σ has the normalized coordinates n(u) with the covariance
σ² J Jᵀ, J = dn/du: the weighted error is the reprojection error in pixels, to first order of that error.
"""

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel

_STEP_PX = 1e-3  # of the central differences, whose error is of second order


def normalized(camera: CameraModel, pixels: Array) -> tuple[Array, Array]:
    """Return normalized coordinates (N, 2) of pixels (N, 2), and their derivatives (N, 2, 2) by the pixel [1 / px].

    The result is NaN where `CameraModel.normalize` is, at 90° from the optical axis and beyond.
    """
    steps = _STEP_PX * np.eye(2)
    ahead, behind = (np.stack([camera.normalize(pixels + sign * step) for step in steps], -1) for sign in (1.0, -1.0))
    return camera.normalize(pixels), (ahead - behind) / (2.0 * _STEP_PX)
