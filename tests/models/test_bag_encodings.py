"""Encodings of raw images in bags, each with pixels by hand."""

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from dronevio.models.recordings.bag.encodings import ENCODINGS, grey_pixels

RED, GREEN, BLUE = 200, 100, 40
GREY = round(0.299 * RED + 0.587 * GREEN + 0.114 * BLUE)
"""By the weights of ITU-R BT.601."""


def grey_of(encoding: str, numbers: npt.ArrayLike, padding: int = 0, big: bool = False) -> npt.NDArray[Any]:
    """Return the grey image of rows of numbers, with bytes after each row."""
    form = ENCODINGS[encoding]
    array = np.asarray(numbers)
    kind = np.dtype("u1" if form.depth_bytes == 1 else ">u2" if big else "<u2")
    rows = array.astype(kind).reshape(len(array), -1).view(np.uint8)
    padded = np.pad(rows, ((0, 0), (0, padding)), constant_values=255)
    width = array.size // len(array) // form.channels
    return grey_pixels(form, padded.ravel(), padded.shape[1], big, width)


@pytest.mark.parametrize("padding", [0, 3])
def test_colours_are_weighted(padding: int) -> None:
    pixel = {"r": RED, "g": GREEN, "b": BLUE, "a": 9}
    for order in ("rgb", "bgr", "rgba", "bgra"):
        pixels = np.tile([pixel[channel] for channel in order], (2, 3, 1))
        grey = grey_of(f"{order}8", pixels, padding)
        assert grey.dtype == np.uint8 and grey.shape == (2, 3)
        np.testing.assert_array_equal(grey, GREY)
        deep = grey_of(f"{order}16", 256 * pixels, padding)
        assert deep.dtype == np.uint16
        np.testing.assert_allclose(deep, 256 * (0.299 * RED + 0.587 * GREEN + 0.114 * BLUE), atol=1.0)


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("padding", [0, 2])
def test_grey_of_16_bits_keeps_its_numbers(big: bool, padding: int) -> None:
    numbers = np.array([[1, 256, 4095], [65535, 0, 513]])
    np.testing.assert_array_equal(grey_of("mono16", numbers, padding, big), numbers)


@pytest.mark.parametrize("depth", [8, 16])
@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_mosaics_of_one_colour_are_that_colour(pattern: str, depth: int) -> None:
    """A scene of one colour, behind the filters of the pattern: first row, then second row."""
    scale = 1 if depth == 8 else 256
    values = {"r": RED * scale, "g": GREEN * scale, "b": BLUE * scale}
    tile = np.array([values[name] for name in pattern]).reshape(2, 2)
    grey = grey_of(f"bayer_{pattern}{depth}", np.tile(tile, (4, 5)))
    assert grey.shape == (8, 10)
    np.testing.assert_allclose(grey / scale, GREY, atol=1.0)


@pytest.mark.parametrize("name", ["yuv422", "uyvy", "yuv422_yuy2", "yuyv"])
def test_luminance_is_every_second_byte(name: str) -> None:
    luminance, chroma = np.arange(12).reshape(2, 6), np.full((2, 6), 128)
    pair = (chroma, luminance) if name in ("yuv422", "uyvy") else (luminance, chroma)
    np.testing.assert_array_equal(grey_of(name, np.stack(pair, axis=2), padding=5), luminance)
