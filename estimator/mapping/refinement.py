"""Refinement of matched depths by one step of least squares, with its standard deviation.

A matcher knows the parameter q₀ of a pixel, a disparity or an inverse depth, to about a pixel. With the residual
e(x) = L(x) − W(x; q₀) between an image and the other one warped into it, and the derivative g = ∂W/∂q, both less their
means in a window around the pixel, the parameter of least squares and its variance are

    q = q₀ + Σ g e / Σ g²,    σ² = σ_e² / Σ g²

(Lucas and Kanade, "An iterative image registration technique with an application to stereo vision", IJCAI 1981), where
σ_e is the noise of the images, or what the step leaves of the residual if this is more.
"""

import math

import cv2
import numpy as np

from dronevio.models.arrays import Floats

WINDOW_PX = (5, 5)
"""Width and height of the window of the step [px]."""
NOISE_GREY = 1.0
"""Standard deviation of the difference of two images at a pixel [grey values]."""
MIN_CORRELATION = 0.75
"""Smallest correlation of the windows of the two images."""


def least_squares_step(image: Floats, warped: Floats, gradient: Floats) -> tuple[Floats, Floats]:
    """Return the steps (H, W) to the parameters of least squares, and their standard deviations (H, W).

    The standard deviation is infinite where the windows of the images do not correlate.

    Args:
        image: (H, W) Image.
        warped: (H, W) Other image, warped into it by the parameters.
        gradient: (H, W) Derivative of the warped image with respect to the parameters.
    """
    n = np.float32(WINDOW_PX[0] * WINDOW_PX[1])
    e = image - warped
    gg = np.maximum(_covariance(gradient, gradient), np.float32(1e-9))
    ge = _covariance(gradient, e)
    step = ge / gg
    left = np.maximum(_covariance(e, e) - ge * step, np.float32(0.0))
    unlike = left > np.float32(1.0 - MIN_CORRELATION**2) * _covariance(image, image)
    variance = np.maximum(left * (n / (n - np.float32(2.0))), np.float32(NOISE_GREY**2)) / (n * gg)
    sigma = np.where(unlike, np.float32(math.inf), np.sqrt(variance)).astype(np.float32)
    return step.astype(np.float32), sigma


def _covariance(a: Floats, b: Floats) -> Floats:
    """Return the covariances (H, W) of two images in the windows."""
    return np.asarray(_box(a * b) - _box(a) * _box(b))


def _box(image: Floats) -> Floats:
    return np.asarray(cv2.boxFilter(image, cv2.CV_32F, WINDOW_PX, borderType=cv2.BORDER_REPLICATE))
