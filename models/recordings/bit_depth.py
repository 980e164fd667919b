"""Images with more than eight bits: their significant bits, and their grey levels in eight.

Cameras with 10, 12 or 14 bits write values from 0 to 2¹⁰ − 1 and so on into files of 16 bits, which do not state the
number of bits. It is the same for all images of a camera, and is found once, from the largest values of several images:
a scale of each image's own would let the brightness of a sequence flicker.
"""

from collections.abc import Iterable, Sequence
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Image

DeepImage = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]
"""Image with 8 or 16 bits per channel, as it is stored."""
Item = TypeVar("Item")

MAX_BITS = 16
MAX_OUTLIERS = 1e-4
"""Share of the pixels of an image, such as hot ones, that may exceed the range [1]."""
SAMPLES = 9
"""Number of images that the significant bits are found from."""


def significant_bits(images: Iterable[DeepImage]) -> int:
    """Return the number of bits, 8 to 16, of the largest values that occur in images of one camera.

    Args:
        images: Images of any shape, such as `spread` of all. A share of `MAX_OUTLIERS` of each is not considered.
    """
    return max((_bits(image) for image in images), default=8)


def to_8bit(image: DeepImage, bits: int) -> Image:
    """Return an image in eight bits, of which 255 is the largest value of the given range.

    Args:
        image: Image of any shape with 8 or 16 bits per channel; one of 8 bits is returned as it is.
        bits: Significant bits of the images of the camera, 8 to 16; larger values become 255.
    """
    if image.dtype == np.uint8:
        return np.asarray(image, np.uint8)
    return np.asarray(np.minimum(image >> (bits - 8), 255), np.uint8)


def spread(items: Sequence[Item], count: int = SAMPLES) -> list[Item]:
    """Return some items of a sequence at equal distances, the first and the last among them."""
    return [
        items[row] for row in np.unique(np.linspace(0, max(len(items) - 1, 0), count).round().astype(int))[: len(items)]
    ]


def _bits(image: DeepImage) -> int:
    """Return the significant bits of an image, 8 to 16, without a few outliers."""
    if image.dtype == np.uint8 or not image.size:
        return 8
    position = image.size - 1 - int(MAX_OUTLIERS * image.size)
    largest = int(np.partition(image, position, axis=None)[position])
    return min(max(largest.bit_length(), 8), MAX_BITS)
