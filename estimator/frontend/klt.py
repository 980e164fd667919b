"""Pyramidal Lucas-Kanade as OpenCV has it, between two images whose brightness may differ.

J.-Y. Bouguet, "Pyramidal implementation of the affine Lucas Kanade feature tracker", Intel, 2001.
"""

import cv2
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

STEPS, STEP_PX = 15, 0.03  # at most, and the last [px]: who wants it more precise refines it afterwards
SPARSE = 8  # every eighth pixel each way tells an image's brightness
BLANK = 2.0  # contrast below which an image shows nothing [grey levels, standard deviation]
SAME_CONTRAST, SAME_LEVEL = 0.1, 8.0  # what differs by less is as bright: relative, and [grey levels]


def follow(
    source: Image, target: Image, pixels: Array, start: Array, window_px: int, levels: int
) -> tuple[Array, Mask]:
    """Find in one image what another has at some pixels.

    Args:
        source: Where it is known.
        target: Where it is looked for.
        pixels: (N, 2) Where it is in the source [px].
        start: (N, 2) Where to begin in the target [px]; finite.
        window_px: Side of the square that is compared [px].
        levels: Pyramid levels above the image: the start may be off by about window/2 · 2^levels pixels.

    Returns:
        Where it is (N, 2) [px], and whether it was found (N,).
    """
    if not len(pixels):
        return np.zeros((0, 2)), np.zeros(0, np.bool_)
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        source,
        target,
        np.ascontiguousarray(pixels, np.float32),
        np.ascontiguousarray(start, np.float32),
        winSize=(window_px, window_px),
        maxLevel=levels,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, STEPS, STEP_PX),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return found.reshape(-1, 2).astype(np.float64), status[:, 0] == 1


def as_bright_as(target: Image, source: Image) -> Image:
    """Return the source with the brightness and contrast of the target, where they differ: Lucas-Kanade minds it.

    Exposure may jump from one image to the next, and differ between cameras.
    """
    (level, contrast), (target_level, target_contrast) = (
        (float(few.mean()), float(few.std())) for few in (image[::SPARSE, ::SPARSE] for image in (source, target))
    )
    if min(contrast, target_contrast) < BLANK:
        return source
    gain = target_contrast / contrast
    if abs(gain - 1.0) < SAME_CONTRAST and abs(target_level - level) < SAME_LEVEL:
        return source
    return np.asarray(cv2.addWeighted(source, gain, source, 0.0, target_level - gain * level), np.uint8)
