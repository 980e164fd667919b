"""Properties of single images: brightness, clipped pixels, contrast and blur."""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Image

STRIDE = 2
"""Every second pixel in each direction suffices for brightness and contrast."""
BLACK, WHITE = 0, 255
"""Grey values of clipped pixels."""
PREFILTER_PX, REBLUR_PX = 0.7, 2.0
"""Standard deviations of the Gaussian filters by which the width of edges is measured [px]."""
EDGE_SHARE = 0.01
"""Share of the pixels with the steepest gradients, which are taken for edges."""
MIN_EDGE = 2.0
"""Gradient of an edge in an image that is not blank [grey levels / px]."""


@dataclass(frozen=True)
class Appearance:
    """Properties of one image."""

    mean: float
    """Mean grey level, 0 to 255."""
    spread: float
    """Difference of the 99th and the 1st percentile of the grey levels."""
    black: float
    """Share of the pixels that are 0."""
    white: float
    """Share of the pixels that are 255."""
    blur_px: float
    """Width of the edges, as the standard deviation of a Gaussian [px]; NaN for a blank image."""


def appearance_of(image: Image) -> Appearance:
    """Return the properties of an image (H, W)."""
    pixels = image[::STRIDE, ::STRIDE]
    histogram = np.bincount(pixels.ravel(), minlength=256)
    cumulative = np.cumsum(histogram) / max(pixels.size, 1)
    low, high = np.searchsorted(cumulative, [0.01, 0.99])
    share = histogram / max(pixels.size, 1)
    return Appearance(
        float(share @ np.arange(256)), float(high - low), float(share[BLACK]), float(share[WHITE]), edge_blur_px(image)
    )


def edge_blur_px(image: Image) -> float:
    """Return the blur of the edges of an image (H, W), as the standard deviation of a Gaussian [px].

    A step that is blurred by σ has a gradient of 1/σ at its middle, and of 1/√(σ² + σ₁²) after another blur by σ₁. The
    ratio of both determines σ, whatever the height of the step (Zhuo and Sim, "Defocus map estimation from a single
    image", Pattern Recognition 2011, eq. 6). The median over the steepest pixels is returned, NaN without edges.
    """
    smooth = np.asarray(cv2.GaussianBlur(image, (0, 0), PREFILTER_PX), np.float32)
    steep = _gradient(smooth)
    limit = max(float(np.quantile(steep[::STRIDE, ::STRIDE], 1.0 - EDGE_SHARE)), MIN_EDGE)
    edges = steep >= limit
    if not edges.any():
        return float("nan")
    ratio = float(
        np.median(
            steep[edges]
            / np.maximum(_gradient(np.asarray(cv2.GaussianBlur(smooth, (0, 0), REBLUR_PX), np.float32))[edges], 1e-6)
        )
    )
    total = REBLUR_PX**2 / max(ratio**2 - 1.0, 1e-3)
    return float(np.sqrt(max(total - PREFILTER_PX**2, 0.0)))


def _gradient(image: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return the magnitude of the gradient of an image (H, W) [grey levels / px]."""
    along_x, along_y = (cv2.Sobel(image, cv2.CV_32F, dx, 1 - dx, ksize=3, scale=0.125) for dx in (1, 0))
    return np.asarray(cv2.magnitude(along_x, along_y), np.float32)
