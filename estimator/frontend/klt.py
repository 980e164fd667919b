"""Pyramidal Lucas-Kanade tracking of points between two images, by OpenCV, and normalization of their brightness.

J.-Y. Bouguet, "Pyramidal implementation of the affine Lucas Kanade feature tracker", Intel, 2001.
"""

import cv2
import numpy as np

from dronevio.models.arrays import Array, Image, Mask

MAX_ITERATIONS, MIN_STEP_PX = 15, 0.03  # a coarse tolerance suffices, because patch alignment refines the result
STRIDE = 8  # every eighth pixel in each direction suffices to measure brightness
MIN_CONTRAST = 2.0  # standard deviation of the grey levels below which an image is regarded as blank
CONTRAST_TOLERANCE, BRIGHTNESS_TOLERANCE = 0.1, 8.0  # differences that need no compensation: ratio, [grey levels]


def track(source: Image, target: Image, pixels: Array, start: Array, window_px: int, levels: int) -> tuple[Array, Mask]:
    """Track points from one image to another.

    Args:
        source: Image in which the points are known.
        target: Image in which the points are searched.
        pixels: (N, 2) Positions of the points in the source [px].
        start: (N, 2) Initial positions in the target [px], finite.
        window_px: Side of the square window that is compared [px].
        levels: Number of pyramid levels above the image. The initial position may be off by about
            window / 2 · 2^levels pixels.

    Returns:
        Positions (N, 2) in the target [px], and whether each point was found (N,).
    """
    if not len(pixels):
        return np.zeros((0, 2)), np.zeros(0, np.bool_)
    tracked, status, _ = cv2.calcOpticalFlowPyrLK(
        source,
        target,
        np.ascontiguousarray(pixels, np.float32),
        np.ascontiguousarray(start, np.float32),
        winSize=(window_px, window_px),
        maxLevel=levels,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, MAX_ITERATIONS, MIN_STEP_PX),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW | cv2.OPTFLOW_LK_GET_MIN_EIGENVALS,  # errors, which cost time, otherwise
    )
    return tracked.reshape(-1, 2).astype(np.float64), status[:, 0] == 1


def match_brightness(source: Image, target: Image) -> Image:
    """Return the source with the mean and the contrast of the target, or the source itself if they hardly differ.

    Lucas-Kanade assumes constant brightness, but exposure may change from one image to the next and differ between
    cameras. An image without contrast is left as it is.
    """
    (mean, contrast), (target_mean, target_contrast) = _brightness(source), _brightness(target)
    if min(contrast, target_contrast) < MIN_CONTRAST:
        return source
    gain = target_contrast / contrast
    if abs(gain - 1.0) < CONTRAST_TOLERANCE and abs(target_mean - mean) < BRIGHTNESS_TOLERANCE:
        return source
    return np.asarray(cv2.addWeighted(source, gain, source, 0.0, target_mean - gain * mean), np.uint8)


def _brightness(image: Image) -> tuple[float, float]:
    """Return the mean and the standard deviation of an image [grey levels]."""
    mean, deviation = cv2.meanStdDev(np.ascontiguousarray(image[::STRIDE, ::STRIDE]))
    return float(mean[0, 0]), float(deviation[0, 0])
