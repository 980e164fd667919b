"""Images for pages and recordings: reduced in size and encoded as JPEG."""

import cv2
import numpy as np

from dronevio.models.arrays import Image


def downscaled(image: Image, longest_side: int) -> Image:
    """Return an image whose longer side has at most so many pixels; each pixel is a mean over its area."""
    height, width = image.shape[:2]
    factor = longest_side / max(height, width)
    if factor >= 1.0:
        return image
    size = max(1, round(width * factor)), max(1, round(height * factor))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def jpeg(image: Image, quality: int = 80) -> bytes:
    """Return an image as the bytes of a JPEG file, with a quality from 0 to 100."""
    in_order = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    _, data = cv2.imencode(".jpg", in_order, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return bytes(data.tobytes())
