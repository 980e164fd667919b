"""Jolts: intervals between keyframes over which the IMU has not felt how the cameras have moved.

A step of the mount, lost samples, or a rendered path that follows the steps of a measured one move all images at once.
With one camera, the window would explain that by another scale, and the covariance would not show it. What shows it are
the residuals of the images: their variance is suddenly many times as large, and it is not without the IMU.
"""

from collections.abc import Callable
from contextlib import suppress

import numpy as np

from dronevio.estimator.backend.window import Window
from dronevio.estimator.optimization.linalg import CholeskyFactor, SingularError

JOLT_RATIO = 5.0
"""Ratio of the variance of the image observations to that of the last keyframe beyond which the IMU is doubted."""
LEAST_VARIANCE = 0.03
"""Smallest variance of these, relative to the assumed one, that counts as typical; that of rendered images is 0.02."""
JOLT_WEIGHT = 1e-3
"""Weight of the IMU since the last keyframe after a jolt; its standard deviations are 30 times as large."""
JOLT_GAIN = 2.0
"""Ratio by which the variance must decrease without the IMU; otherwise a contradiction has another cause."""


def optimized(window: Window, optimize: Callable[[], CholeskyFactor], typical: float | None) -> CholeskyFactor:
    """Optimize a window after a keyframe, and once more without the IMU before it if that has missed a jolt.

    Args:
        window: The window, which changes.
        optimize: Optimizes the window and returns the factor of its last linear system.
        typical: Variance of the image observations at the keyframe before, as that of the window; None if unknown.

    Returns:
        The factor of the last linear system of the window as it is left.
    """
    start = window.estimate
    solver, found = optimize(), _variance(window)
    if typical is None or found is None or found <= JOLT_RATIO * max(typical, LEAST_VARIANCE):
        return solver
    estimate = window.estimate
    window.reweight_newest(JOLT_WEIGHT)
    window.estimate = start
    with suppress(SingularError, np.linalg.LinAlgError):
        without, variance = optimize(), _variance(window)
        if variance is not None and variance < found / JOLT_GAIN:
            return without
    window.reweight_newest(1.0)
    window.estimate = estimate
    return solver


def _variance(window: Window) -> float | None:
    """Return the variance of the image observations of a window at its estimates; None if unknown."""
    residual, _, observed = window.residuals()
    return window.image_variance(residual, observed)
