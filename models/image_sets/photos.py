"""Image files: their size, EXIF data and pixels.

Pixels are returned as they are stored in the file; the orientation for display in EXIF data is ignored, as COLMAP
does, so that pixel coordinates and camera models refer to the sensor. Images of 16 bits per channel are scaled to 8 by
the range that occurs in those of their camera (`dronevio.models.recordings.bit_depth`). An alpha channel is dropped.
"""

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from dronevio.models.arrays import Image
from dronevio.models.errors import InputError
from dronevio.models.extras import install_command
from dronevio.models.image_sets.geotags import GeoTag, read_geotag
from dronevio.models.image_sets.intrinsics import ExifCamera, exif_camera
from dronevio.models.recordings.bit_depth import MAX_BITS, DeepImage, significant_bits, spread, to_8bit
from dronevio.models.recordings.files import check_regular_file
from dronevio.models.recordings.image_header import check_decoded_size, read_image_header

if TYPE_CHECKING:
    from PIL import Image as PillowImage
    from PIL.ImageFile import ImageFile

PHOTO_SUFFIXES = (
    ".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".avif", ".heic", ".heif", ".pgm", ".ppm"
)  # fmt: skip
"""Suffixes of image files, in lower case."""
OTHER_SUFFIXES = (
    ".gif", ".jp2", ".jxl", ".psd", ".exr", ".hdr", ".tga", ".dng", ".raw", ".cr2", ".cr3", ".nef", ".arw", ".orf",
    ".rw2", ".raf", ".pef", ".srw", ".insp"
)  # fmt: skip
"""Suffixes of images that are not read, in lower case."""
HEIF = ("HEIC, which needs the package pillow-heif", f"{install_command('heif')}, or JPEG files")
"""What is found, and what is expected instead, where images of iPhones cannot be read."""

Result = TypeVar("Result")

_EXPECTED = "an image (JPEG, PNG, TIFF, BMP, WebP, AVIF, HEIC or PNM)"
_FORMATS = ("JPEG", "PNG", "TIFF", "BMP", "WEBP", "AVIF", "PPM")
_HEIF_SUFFIXES = (".heic", ".heif")
_ORIENTATION, _EXIF_IFD, _GPS_IFD = 0x0112, 0x8769, 0x8825
_XMP_TAG = 700  # of TIFF
_SIDEWAYS = (5, 6, 7, 8)  # orientations that exchange rows and columns


@dataclass(frozen=True)
class PhotoHeader:
    """Properties of an image file that are known before its pixels are decoded."""

    width: int
    """Number of columns of the stored image [px]."""
    height: int
    """Number of rows of the stored image [px]."""
    exif: ExifCamera
    """Properties of camera and lens in the EXIF data."""
    is_deep: bool = False
    """Whether the image has 16 bits per channel."""
    geotag: GeoTag | str | None = field(default=None, compare=False)
    """Position in the metadata, None without one, or a text that says why it cannot be used. Headers are equal whatever
    the position: images of one camera are."""


def read_photo_header(path: Path) -> PhotoHeader:
    """Return the size and the EXIF data of an image file. Invalid EXIF data are ignored.

    Raises:
        InputError: The file is missing or not a supported image.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of invalid EXIF data
        return _decoded(path, _header)


def read_photo(path: Path, width: int | None = None, height: int | None = None, bits: int = MAX_BITS) -> Image:
    """Return the pixels of an image file: grey (H, W), or red, green and blue (H, W, 3).

    Args:
        path: The file.
        width: Expected number of columns [px], None for any.
        height: Expected number of rows [px], None for any.
        bits: Significant bits of the camera's images of 16 bits per channel.

    Raises:
        InputError: The file is missing, damaged, not a supported image, or has another size.
    """
    return to_8bit(_read_deep(path, width, height), bits)


def significant_bits_of_photos(files: Sequence[Path]) -> int:
    """Return the significant bits, 8 to 16, of the channels of images of one camera, from some that can be read."""
    return significant_bits(_readable(spread(files)))


def _readable(files: Sequence[Path]) -> Iterator[DeepImage]:
    """Yield the pixels of the files that can be read."""
    for file in files:
        with suppress(InputError):
            yield _read_deep(file)


def _read_deep(path: Path, width: int | None = None, height: int | None = None) -> DeepImage:
    """Return the pixels of an image file with 8 or 16 bits per channel, as `read_photo` does."""
    image = _decoded(path, _pixels)
    if image is None:
        raise InputError(path, "an image with 32 bits per channel", "8 or 16 bits per channel")
    rows, columns = image.shape[:2]
    if (width is not None and columns != width) or (height is not None and rows != height):
        raise InputError(path, f"an image of {columns} × {rows} px", f"an image of {width} × {height} px")
    return image


def _decoded(path: Path, function: "Callable[[ImageFile], Result]") -> Result:
    """Return the result of a function of an opened image file, or raise InputError."""
    from PIL import Image as PillowImage
    from PIL import UnidentifiedImageError

    _check_size(path)
    is_heif = path.suffix.lower() in _HEIF_SUFFIXES
    if is_heif and not _can_read_heif():
        raise InputError(path, *HEIF)
    try:
        formats = ("HEIF", *_FORMATS) if is_heif else _FORMATS
        opened: AbstractContextManager[ImageFile] = PillowImage.open(path, formats=formats)
        with opened as image:
            return function(image)
    except FileNotFoundError:
        raise InputError(path, "no such file", _EXPECTED) from None
    except UnidentifiedImageError:
        raise InputError(path, "a file that is not a supported image", _EXPECTED) from None
    except Exception as error:  # decoders raise many kinds for damaged files
        raise InputError(path, f"an image that cannot be decoded ({error})", _EXPECTED) from None


@cache
def _can_read_heif() -> bool:
    """Let Pillow read HEIC, if the package for it is installed, and return whether it is."""
    try:
        from pillow_heif import register_heif_opener
    except ImportError:
        return False
    register_heif_opener()
    return True


def _check_size(path: Path) -> None:
    """Raise InputError for a pipe or a device, and for an image that needs too much memory."""
    check_regular_file(path, _EXPECTED)
    try:
        with path.open("rb") as stream:
            header, size = read_image_header(stream), path.stat().st_size
    except (OSError, ValueError):  # which Pillow finds as well
        return
    if header is not None:
        check_decoded_size(path, header, size)


def _header(image: "ImageFile") -> PhotoHeader:
    """Return size and EXIF data of an opened image."""
    (width, height), is_deep = image.size, _is_deep(image)  # before the EXIF data, for which Pillow loads a PNG
    if _tiff_orientation(image) in _SIDEWAYS:
        width, height = height, width
    return PhotoHeader(width, height, exif_camera(_exif_tags(image)), is_deep, _geotag(image))


def _is_deep(image: "ImageFile") -> bool:
    """Return whether an opened image, not yet loaded, has 16 bits per channel in its file."""
    return image.mode == "I" or any("16" in str(tile[3]) for tile in image.tile)


def _exif_tags(image: "PillowImage.Image") -> dict[int, object]:
    """Return the values of EXIF tags by number; none if the data are damaged."""
    try:
        exif = image.getexif()
        return {**exif, **exif.get_ifd(_EXIF_IFD)}
    except Exception:  # the parser raises many kinds for damaged data
        return {}


def _geotag(image: "ImageFile") -> GeoTag | str | None:
    """Return the position in the metadata of an opened image; see `read_geotag`."""
    try:
        gps = dict(image.getexif().get_ifd(_GPS_IFD))
    except Exception:  # the parser raises many kinds for damaged data
        gps = {}
    xmp = image.info.get("xmp") or image.info.get("XML:com.adobe.xmp") or getattr(image, "tag_v2", {}).get(_XMP_TAG)
    if isinstance(xmp, str):
        xmp = xmp.encode("utf-8", "replace")
    return read_geotag(gps, xmp if isinstance(xmp, bytes) else b"")


def _tiff_orientation(image: "PillowImage.Image") -> int:
    """Return the orientation that Pillow applies when it decodes an image, which it does for TIFF only; 1 if none."""
    return int(image.getexif().get(_ORIENTATION, 1)) if image.format == "TIFF" else 1


def _pixels(image: "ImageFile") -> DeepImage | None:
    """Return the pixels (H, W) or (H, W, 3) of an opened image as stored, None for 32 bits per channel."""
    from PIL.Image import Transpose

    inverse = {
        2: Transpose.FLIP_LEFT_RIGHT,
        3: Transpose.ROTATE_180,
        4: Transpose.FLIP_TOP_BOTTOM,
        5: Transpose.TRANSPOSE,
        6: Transpose.ROTATE_90,
        7: Transpose.TRANSVERSE,
        8: Transpose.ROTATE_270,
    }.get(_tiff_orientation(image))
    if image.mode in ("RGB", "RGBA") and inverse is None and _is_deep(image):  # of which Pillow keeps the upper 8 bits
        import cv2

        deep = cv2.imdecode(np.fromfile(image.filename, np.uint8), cv2.IMREAD_UNCHANGED)  # ignores the orientation
        if deep is not None and deep.dtype == np.uint16:
            return np.ascontiguousarray(deep[..., 2::-1], np.uint16)  # blue, green, red and alpha
    image.load()
    stored: PillowImage.Image = image if inverse is None else image.transpose(inverse)
    if stored.mode == "I" and image.format == "PPM":  # a PGM of 16 bits
        return np.asarray(stored).astype(np.uint16)
    if stored.mode in ("I", "F"):
        return None
    if stored.mode.startswith("I;16"):
        return np.asarray(stored).astype(np.uint16)
    if stored.mode in ("La", "RGBa"):  # colours multiplied by alpha
        stored = stored.convert(stored.mode.upper())
    mode = "L" if stored.mode in ("1", "L", "LA") else "RGB"
    return np.array(stored if stored.mode == mode else stored.convert(mode), dtype=np.uint8)
