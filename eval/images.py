"""Images for pages and recordings: reduced in size and encoded as JPEG."""

import cv2
import numpy as np

from dronevio.models.arrays import Floats, Image

DEPTH_PERCENT = (2.0, 98.0)
"""Percentiles of the inverse depths at the ends of the colour scale."""


def downscaled(image: Image, longest_side: int) -> Image:
    """Return an image whose longer side has at most so many pixels; each pixel is a mean over its area."""
    height, width = image.shape[:2]
    factor = longest_side / max(height, width)
    if factor >= 1.0:
        return image
    size = max(1, round(width * factor)), max(1, round(height * factor))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def depth_colours(inverse_depth: Floats) -> Image:
    """Return a picture (H, W, 3) of inverse depths (H, W): red is near, blue far, black unknown."""
    known = inverse_depth > 0.0
    if not known.any():
        return np.zeros((*inverse_depth.shape, 3), np.uint8)
    low, high = np.percentile(inverse_depth[known], DEPTH_PERCENT)
    level = np.clip((inverse_depth - low) / max(high - low, np.finfo(np.float32).tiny), 0.0, 1.0)
    coloured = cv2.applyColorMap(np.round(255.0 * level).astype(np.uint8), cv2.COLORMAP_TURBO)
    return np.where(known[..., None], cv2.cvtColor(coloured, cv2.COLOR_BGR2RGB), 0).astype(np.uint8)
