"""Grey images from files, refused when they are damaged."""

import zlib
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dronevio.models.errors import InputError

Image = npt.NDArray[np.uint8]

_PNG = b"\x89PNG\r\n\x1a\n"


def read_grey(path: Path, width: int, height: int) -> Image:
    """Return a grey (height, width) image.

    Raises:
        InputError: The file is missing, damaged, no image, or of another size.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise InputError(path, "no such file", _expected(width, height)) from None
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})", _expected(width, height)) from None
    return decode_grey(path, data, width, height)


def decode_grey(path: Path, data: bytes, width: int, height: int, where: str = "") -> Image:
    """Return the grey (height, width) image that a PNG, a JPEG or the like holds.

    Args:
        path: The file that it comes from, for messages.
        data: The encoded image.
        width: Columns that it should have [px].
        height: Rows that it should have [px].
        where: Where in the file it stands, for messages; with a colon and a space behind it.

    Raises:
        InputError: It is damaged, no image, or of another size.
    """
    import cv2  # only those who look at images pay for it

    expected = _expected(width, height)
    fault = _fault(data)
    if fault:
        raise InputError(path, f"{where}{fault}", expected)
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise InputError(path, f"{where}no image that can be decoded", expected)
    if image.shape != (height, width):
        raise InputError(path, f"{where}an image of {image.shape[1]} × {image.shape[0]} px", expected)
    return np.asarray(image, dtype=np.uint8)


def encode_png(image: Image) -> bytes:
    """Return a grey image as a PNG, quickly: the noise of a sensor hardly compresses however long one tries."""
    import cv2

    return bytes(cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1])


def _expected(width: int, height: int) -> str:
    """Return what an image should be, for messages."""
    return f"an image of {width} × {height} px"


def _fault(data: bytes) -> str | None:
    """Return what is wrong with a file that OpenCV would complain of on the terminal, or raise for."""
    if not data:
        return "an empty file"
    return _png_fault(data) if data.startswith(_PNG) else None


def _png_fault(data: bytes) -> str | None:
    """Return what is wrong with the chunks of a PNG: length, type, content, CRC of type and content."""
    start = len(_PNG)
    while start + 12 <= len(data):
        end = start + 12 + int.from_bytes(data[start : start + 4], "big")
        if end > len(data):
            break
        if zlib.crc32(data[start + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            return "a damaged PNG"
        if data[start + 4 : start + 8] == b"IEND":
            return None
        start = end
    return "a PNG that is cut off"
