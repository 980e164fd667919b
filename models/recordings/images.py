"""Reading and writing of grey images; damaged files are refused."""

import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from dronevio.models.arrays import Image
from dronevio.models.defects import Defect, DefectKind
from dronevio.models.errors import InputError
from dronevio.models.imu import Times
from dronevio.models.recordings.bit_depth import MAX_BITS, DeepImage, significant_bits, spread, to_8bit
from dronevio.models.recordings.files import check_regular_file
from dronevio.models.recordings.frame_groups import delays_of_frame
from dronevio.models.recordings.image_header import check_decoded_size, header_of
from dronevio.models.state import NO_IMAGE, CameraFrame


class DamagedImageError(InputError):
    """An image is missing or cannot be decoded, while other images of the same camera may be valid."""


_PNG = b"\x89PNG\r\n\x1a\n"


def read_grey(path: Path, width: int, height: int, bits: int = MAX_BITS) -> Image:
    """Return the grey image (height, width) in a file.

    Args:
        path: The file.
        width: Expected number of columns [px].
        height: Expected number of rows [px].
        bits: Significant bits of the camera's images of 16 bits; see `significant_bits_of_files`.

    Raises:
        DamagedImageError: The file is missing, damaged or not an image.
        InputError: The image has another size.
    """
    return decode_grey(path, _read_bytes(path, width, height), width, height, bits=bits)


def assembled_frame(
    t_ns: int, reads: Iterable[Callable[[], Image] | None], repair: bool, delays_ns: Times
) -> CameraFrame:
    """Return a frame of images, each of which a function reads; None is no image.

    Args:
        t_ns: Time stamp [ns].
        reads: Functions for the images of all cameras.
        repair: Whether a damaged image becomes none and a defect.
        delays_ns: (C,) Delays of the exposures of the cameras [ns].

    Raises:
        InputError: An image has a wrong size, or is damaged without ``repair``.
    """
    images: list[Image] = []
    defects: list[Defect] = []
    for read in reads:
        image = NO_IMAGE
        try:
            image = NO_IMAGE if read is None else read()
        except DamagedImageError as error:
            if not repair:
                raise
            defects.append(Defect(DefectKind.DAMAGED_IMAGE, t_ns, error.found))
        images.append(image)
    return CameraFrame(t_ns, tuple(images), defects=tuple(defects), image_delays_ns=delays_of_frame(delays_ns))


def significant_bits_of_files(files: Sequence[Path], width: int, height: int) -> int:
    """Return the significant bits, 8 to 16, of the images of one camera, from some of its files.

    Args:
        files: The files, of which those that cannot be read are not considered.
        width: Expected number of columns [px].
        height: Expected number of rows [px].
    """
    return significant_bits(_deep_images(spread(files), width, height))


def _deep_images(files: Sequence[Path], width: int, height: int) -> Iterator[DeepImage]:
    """Yield the images of files that can be read, up to the first of 8 bits."""
    for file in files:
        try:
            image = decode_deep_grey(file, _read_bytes(file, width, height), width, height)
        except InputError:
            continue
        if image.dtype == np.uint8:
            return
        yield image


def _read_bytes(path: Path, width: int, height: int) -> bytes:
    """Return the content of a file, or raise DamagedImageError."""
    check_regular_file(path, _expected(width, height))
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise DamagedImageError(path, "no such file", _expected(width, height)) from None
    except OSError as error:
        raise DamagedImageError(path, f"cannot be read ({error.strerror})", _expected(width, height)) from None


def decode_grey(path: Path, data: bytes, width: int, height: int, where: str = "", bits: int = MAX_BITS) -> Image:
    """Return the grey image (height, width) of encoded data, such as PNG or JPEG.

    Args:
        path: The file that contains the data, for error messages.
        data: The encoded image.
        width: Expected number of columns [px].
        height: Expected number of rows [px].
        where: Place of the image in the file, for error messages, with a colon and a space at its end.
        bits: Significant bits of the camera's images of 16 bits; see `dronevio.models.recordings.bit_depth`.

    Raises:
        DamagedImageError: The data are damaged or not an image.
        InputError: The image has another size.
    """
    return to_8bit(decode_deep_grey(path, data, width, height, where), bits)


def decode_deep_grey(path: Path, data: bytes, width: int, height: int, where: str = "") -> DeepImage:
    """Return the grey image (height, width) of encoded data with 8 or 16 bits, as it is stored.

    Args:
        path: The file that contains the data, for error messages.
        data: The encoded image.
        width: Expected number of columns [px].
        height: Expected number of rows [px].
        where: Place of the image in the file, for error messages, with a colon and a space at its end.

    Raises:
        DamagedImageError: The data are damaged or not an image.
        InputError: The image has another size.
    """
    import cv2  # slow to import, and needed only where images are decoded

    expected = _expected(width, height)
    damage = _damage(data)
    if damage:
        raise DamagedImageError(path, f"{where}{damage}", expected)
    header = header_of(data)  # before memory for the pixels is allocated
    if header is None:
        raise DamagedImageError(path, f"{where}data that cannot be decoded", expected)
    size = header.width, header.height
    if size not in ((width, height), (height, width)):  # EXIF data may state a rotation
        raise InputError(path, f"{where}an image of {size[0]} × {size[1]} px", expected)
    check_decoded_size(path, header, len(data), where)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    except cv2.error as error:  # more pixels than OpenCV allows, for example
        reason = str(error.err or "").strip() or "of a kind that OpenCV refuses"
        raise DamagedImageError(path, f"{where}an image that cannot be decoded ({reason})", expected) from None
    if image is None:
        raise DamagedImageError(path, f"{where}data that cannot be decoded", expected)
    if image.shape != (height, width):
        raise InputError(path, f"{where}an image of {image.shape[1]} × {image.shape[0]} px", expected)
    if image.dtype == np.uint8:
        return np.asarray(image, np.uint8)
    if image.dtype != np.uint16:
        raise InputError(path, f"{where}an image of type {image.dtype}", "8 or 16 bits without a sign")
    return np.asarray(image, np.uint16)


def encode_png(image: Image) -> bytes:
    """Return a grey image (H, W), or red, green and blue (H, W, 3), as PNG, with fast compression.

    Sensor noise hardly compresses.
    """
    import cv2

    if image.ndim == 3:
        image = image[..., ::-1]
    return bytes(cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1])


def encode_jpeg(image: Image, quality: int = 80) -> bytes:
    """Return a grey image (H, W), or red, green and blue (H, W, 3), as JPEG, with a quality from 0 to 100."""
    import cv2

    if image.ndim == 3:
        image = image[..., ::-1]
    return bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1])


def png_name(name: str) -> str:
    """Return the name of an image as that of a PNG file."""
    return name if name.lower().endswith(".png") else f"{name}.png"


def _expected(width: int, height: int) -> str:
    """Return the description of an image for error messages."""
    return f"an image of {width} × {height} px"


def _damage(data: bytes) -> str | None:
    """Return a description of damage for which OpenCV prints a warning or raises an exception, None if there is
    none.
    """
    if not data:
        return "an empty file"
    return _png_damage(data) if data.startswith(_PNG) else None


def _png_damage(data: bytes) -> str | None:
    """Return a description of damage to the chunks of a PNG (length, type, content, CRC), None if there is none."""
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
    return "a truncated PNG"
