"""Pixels of sensor_msgs/Image messages as grey images.

The encodings are those of ROS (sensor_msgs/image_encodings.hpp): grey, colour and Bayer patterns with 8 or 16 bits per
channel, and YUV with two bytes per pixel, whose luminance is the grey image. A pattern such as ``rggb`` names the
colours of the first two rows; OpenCV names the same pattern by the second and third pixel of the second row, ``BG``.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.models.recordings.bit_depth import DeepImage


@dataclass(frozen=True)
class Encoding:
    """Encoding of the pixels of an image."""

    channels: int
    """Numbers per pixel."""
    depth_bytes: int
    """Bytes per number."""
    to_grey: str = ""
    """OpenCV's conversion to grey, empty if the image is grey."""
    luminance: int | None = None
    """Index of the number of each pixel that is its luminance, None if the conversion applies."""

    @property
    def pixel_bytes(self) -> int:
        """Bytes per pixel."""
        return self.channels * self.depth_bytes


_BAYER = {"rggb": "BG", "bggr": "RG", "gbrg": "GR", "grbg": "GB"}
_COLOURS = {"rgb": 3, "bgr": 3, "rgba": 4, "bgra": 4}

ENCODINGS: dict[str, Encoding] = {
    "mono8": Encoding(1, 1),
    "8UC1": Encoding(1, 1),
    "8UC3": Encoding(3, 1, "COLOR_BGR2GRAY"),
    "8UC4": Encoding(4, 1, "COLOR_BGRA2GRAY"),
    "mono16": Encoding(1, 2),
    **{
        f"{order}{8 * depth}": Encoding(channels, depth, f"COLOR_{order.upper()}2GRAY")
        for order, channels in _COLOURS.items()
        for depth in (1, 2)
    },
    **{
        f"bayer_{pattern}{8 * depth}": Encoding(1, depth, f"COLOR_Bayer{name}2GRAY")
        for pattern, name in _BAYER.items()
        for depth in (1, 2)
    },
    **{name: Encoding(2, 1, luminance=1) for name in ("yuv422", "uyvy")},
    **{name: Encoding(2, 1, luminance=0) for name in ("yuv422_yuy2", "yuyv")},
}
"""Encodings by their names in ROS, without those of depth images (``16UC1``, ``32FC1``)."""


def grey_pixels(
    encoding: Encoding, data: npt.NDArray[np.uint8], step: int, is_big_endian: bool, width: int
) -> DeepImage:
    """Return the grey image (H, W), with 8 or 16 bits as it is stored.

    Args:
        encoding: Encoding of the pixels.
        data: (H × step,) Bytes of all rows.
        step: Bytes per row, of which those after the pixels are ignored.
        is_big_endian: Whether the first byte of a number of 16 bits is the higher one.
        width: Number of columns W [px].
    """
    rows = np.ascontiguousarray(data.reshape(-1, step)[:, : width * encoding.pixel_bytes])
    if encoding.depth_bytes == 1:
        return np.asarray(_grey(encoding, rows, width), np.uint8)
    numbers = rows.view(">u2" if is_big_endian else "<u2").astype(np.uint16)
    return np.asarray(_grey(encoding, numbers, width), np.uint16)


def _grey(encoding: Encoding, numbers: DeepImage, width: int) -> npt.NDArray[np.generic]:
    """Return the grey image (H, W) of rows of numbers (H, W × channels)."""
    import cv2

    if encoding.luminance is not None:
        return np.ascontiguousarray(numbers[:, encoding.luminance :: encoding.channels])
    if not encoding.to_grey:
        return numbers
    pixels = numbers.reshape(len(numbers), width, encoding.channels)
    return np.asarray(cv2.cvtColor(pixels, getattr(cv2, encoding.to_grey)))
