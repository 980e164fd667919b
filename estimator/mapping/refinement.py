"""Refinement of matched depths: one step of least squares with its standard deviation, and rejection at edges.

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

from dronevio.models.arrays import Floats, Mask

WINDOW_PX = (5, 5)
"""Width and height of the window of the step [px]."""
NOISE_GREY = 2.0
"""Standard deviation of the difference of two images at a pixel [grey values]."""
MIN_CORRELATION = 0.75
"""Smallest correlation of the windows of the two images."""
MAX_CHANGE_PX = 0.8
"""Change of the disparity within a band, beyond that of a slanted surface, above which there is an edge [px]."""
MAX_SLOPE = 0.6
"""Largest change of the disparity from pixel to pixel on a surface [px]."""
EDGE_PX = 3
"""Width of the bands on both sides of an edge in which disparities are left out [px]."""
BESIDE_PX = 12
"""Distance from an edge within which a disparity may be that of the other surface [px]."""
OTHER_SURFACE = 0.005
"""Probability of that."""
SMALLEST_PX = 40
"""Size of the smallest patch of disparities that nothing around it supports [px]."""
_FIXED = 16.0  # disparities are compared in sixteenths of a pixel


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


def edges(disparity: Floats, matched: Floats) -> tuple[Mask, Floats]:
    """Return where (H, W) disparities are left out because the depth jumps, and standard deviations (H, W) beside it.

    Windows at an edge see both surfaces, so that the nearer one seems wider than it is, and the farther one is hidden
    from one camera. What is narrower than the two bands, such as a pole, is kept: to lose it would be worse. Farther
    from the edge, a disparity is that of the other surface with a small probability p, which adds p J² to the variance
    for a jump by J. The jump is what the slope of the surface does not explain.

    Args:
        disparity: (H, W) Disparities that are known, 0 elsewhere [px].
        matched: (H, W) Disparities of the matcher, not more than 0 where there is none [px].
    """
    slope = _slope(matched)
    change = np.float32(MAX_CHANGE_PX) + np.float32(EDGE_PX) * slope
    high, low = _range_around(matched, EDGE_PX)
    farther, nearer = high > disparity + change, low < disparity - change
    square = np.ones((2 * EDGE_PX + 1, 2 * EDGE_PX + 1), np.uint8)
    kept = cv2.dilate(np.where(farther | nearer, np.float32(0.0), disparity), square)
    is_narrow = kept < disparity - change
    high, low = _range_around(matched, BESIDE_PX)
    jump = np.maximum(high - disparity, disparity - low) - np.float32(BESIDE_PX) * slope
    sigma = np.float32(math.sqrt(OTHER_SURFACE)) * np.maximum(jump, np.float32(0.0))
    return np.asarray(farther | (nearer & ~is_narrow)), np.asarray(sigma)


def _range_around(matched: Floats, reach_px: int) -> tuple[Floats, Floats]:
    """Return the largest and smallest disparities (H, W) in the square around each pixel."""
    square = np.ones((2 * reach_px + 1, 2 * reach_px + 1), np.uint8)
    low = cv2.erode(np.where(matched > 0.0, matched, np.float32(1e6)), square)
    return np.asarray(cv2.dilate(matched, square)), np.asarray(low)


def _slope(matched: Floats) -> Floats:
    """Return the slope (H, W) of the surface at each pixel: medians of the differences along rows and columns."""
    slope = np.zeros_like(matched)
    for before, after in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        difference = np.zeros_like(matched)
        both = (matched[before] > 0.0) & (matched[after] > 0.0)
        difference[before] = np.where(both, np.abs(matched[after] - matched[before]), np.float32(0.0))
        slope += cv2.medianBlur(difference, 5)
    return np.minimum(slope, np.float32(MAX_SLOPE))


def speckles(disparity: Floats) -> Mask:
    """Return where (H, W) disparities are 0, or belong to small patches that nothing around them supports."""
    fixed = np.rint(_FIXED * disparity).astype(np.int16)
    cv2.filterSpeckles(fixed, 0, SMALLEST_PX, _FIXED)
    return np.asarray(fixed == 0)


def _covariance(a: Floats, b: Floats) -> Floats:
    """Return the covariances (H, W) of two images in the windows."""
    return np.asarray(_box(a * b) - _box(a) * _box(b))


def _box(image: Floats) -> Floats:
    return np.asarray(cv2.boxFilter(image, cv2.CV_32F, WINDOW_PX, borderType=cv2.BORDER_REPLICATE))
