"""Size of an encoded image by its header, so that unreasonable ones are refused before memory is allocated.

A file of some kilobytes may decode to gigabytes. The formats are those that the readers of images decode: PNG, JPEG,
TIFF, BMP, WebP and PNM.

Sources: PNG (W3C, 11.2.2); ITU-T T.81, annex B, where the frame header of a JPEG follows a marker SOF; TIFF 6.0 and
BigTIFF; the BITMAPINFOHEADER of BMP; RFC 9649 for WebP; the pages pgm(5) and ppm(5) of Netpbm.
"""

import io
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from dronevio.models.errors import InputError

MAX_DECODED_BYTES = 2**30
"""Largest memory for the pixels of an image: more than 150 Mpx in colour, as the largest cameras have."""
UNPROVEN_BYTES = 2**28
"""Memory up to which an image may be compressed at any ratio: a mask of a few kilobytes may have 60 Mpx."""
MAX_RATIO = 200.0
"""Largest ratio of the memory for the pixels and of the file beyond that; photographs have 10 to 50."""
MAX_FRAME_PIXELS = 100_000_000
"""Largest number of pixels of a frame of a video; 12K has 80 Mpx."""

_MAX_SEGMENTS = 10_000  # before the frame header of a JPEG
_MAX_ENTRIES = 4096  # of a directory of a TIFF, which has some twenty
_NO_LENGTH = {0x01, *range(0xD0, 0xD9)}  # markers of a JPEG without a segment
_FRAME_HEADERS = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # SOF0 to SOF15 without tables and extensions
_PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}
_TIFF_TYPES = {1: "B", 3: "H", 4: "I", 16: "Q"}  # of the tags that are read
_WIDTH, _HEIGHT, _BITS, _SAMPLES, _TILE_WIDTH, _TILE_HEIGHT = 256, 257, 258, 277, 322, 323
_PNM = re.compile(rb"P([1-6])(?:\s|#[^\n]*\n)+(\d+)(?:\s|#[^\n]*\n)+(\d+)(?:(?:\s|#[^\n]*\n)+(\d+))?\s")


@dataclass(frozen=True)
class ImageHeader:
    """Size of an encoded image."""

    width: int
    """Number of columns [px]."""
    height: int
    """Number of rows [px]."""
    channels: int
    """Number of channels."""
    depth_bytes: int
    """Bytes of a channel of a pixel."""

    @property
    def decoded_bytes(self) -> int:
        """Memory for the pixels; decoders store three channels as four."""
        return self.width * self.height * self.depth_bytes * (4 if self.channels == 3 else self.channels)


def check_decoded_size(path: Path, header: ImageHeader, encoded_bytes: int, where: str = "") -> None:
    """Check that the pixels of an image need a reasonable memory.

    Args:
        path: The file, for error messages.
        header: Size of the image.
        encoded_bytes: Size of the encoded image.
        where: Place of the image in the file, for error messages, with a colon and a space at its end.

    Raises:
        InputError: The memory is above `MAX_DECODED_BYTES`, or above `UNPROVEN_BYTES` and more than `MAX_RATIO` times
            that of the encoded image.
    """
    needed = header.decoded_bytes
    found = f"{where}an image of {header.width} × {header.height} px, which needs {needed / 2**20:.0f} MiB"
    if needed > MAX_DECODED_BYTES:
        raise InputError(path, found, f"an image that needs at most {MAX_DECODED_BYTES // 2**20} MiB")
    if needed > UNPROVEN_BYTES and needed > MAX_RATIO * encoded_bytes:
        found = f"{found} and is stored in {encoded_bytes / 2**20:.1f} MiB"
        raise InputError(path, found, f"a photograph, of which one part in {MAX_RATIO:g} or more is stored")


def encoded_size(data: bytes) -> tuple[int, int] | None:
    """Return width and height [px] in the header of an encoded image, None as for `header_of`."""
    header = header_of(data)
    return None if header is None else (header.width, header.height)


def header_of(data: bytes) -> ImageHeader | None:
    """Return the size of an encoded image, None for data of other formats and damaged headers."""
    return read_image_header(io.BytesIO(data))


def read_image_header(stream: BinaryIO) -> ImageHeader | None:
    """Return the size of an encoded image in a stream, None for data of other formats and damaged headers."""
    start = stream.read(32)
    for magic, read in _READERS.items():
        if start.startswith(magic):
            try:
                stream.seek(0)
                header = read(stream)
            except (struct.error, OSError, ValueError, KeyError, OverflowError):
                return None
            return header if header is not None and min(header.width, header.height) > 0 else None
    return None


def _png(stream: BinaryIO) -> ImageHeader:
    """Return the size in the first chunk of a PNG."""
    width, height, bits, colour = struct.unpack(">IIBB", stream.read(26)[16:])
    return ImageHeader(width, height, _PNG_CHANNELS[colour], (bits + 7) // 8)


def _jpeg(stream: BinaryIO) -> ImageHeader | None:
    """Return the size in the frame header of a JPEG, which other segments precede."""
    stream.seek(2)
    for _ in range(_MAX_SEGMENTS):
        marker, code = struct.unpack("BB", stream.read(2))
        if marker != 0xFF:
            return None
        if code == 0xFF:  # a fill byte
            stream.seek(-1, io.SEEK_CUR)
        elif code in _FRAME_HEADERS:
            _, bits, height, width, channels = struct.unpack(">HBHHB", stream.read(8))
            return ImageHeader(width, height, channels, (bits + 7) // 8)
        elif code not in _NO_LENGTH:
            stream.seek(max(2, struct.unpack(">H", stream.read(2))[0]) - 2, io.SEEK_CUR)
    return None


def _tiff(stream: BinaryIO) -> ImageHeader:
    """Return the size in the first directory of a TIFF or BigTIFF; that of a tile where it is larger."""
    start = stream.read(16)
    order = "<" if start[:2] == b"II" else ">"
    is_big = struct.unpack_from(f"{order}H", start, 2)[0] == 43
    (at,) = struct.unpack_from(f"{order}Q", start, 8) if is_big else struct.unpack_from(f"{order}I", start, 4)
    stream.seek(at)
    form, inline = (f"{order}HHQ", 8) if is_big else (f"{order}HHI", 4)
    (count,) = struct.unpack(f"{order}{'Q' if is_big else 'H'}", stream.read(8 if is_big else 2))
    if count > _MAX_ENTRIES:
        raise ValueError("a directory that is too long")
    size = struct.calcsize(form)
    tags: dict[int, int] = {}
    for entry in [stream.read(size + inline) for _ in range(count)]:
        tag, kind, values = struct.unpack_from(form, entry)
        if tag not in (_WIDTH, _HEIGHT, _BITS, _SAMPLES, _TILE_WIDTH, _TILE_HEIGHT):
            continue
        value = f"{order}{_TIFF_TYPES[kind]}"
        if values * struct.calcsize(value) > inline:  # the depths of several channels, which are elsewhere
            stream.seek(struct.unpack_from(f"{order}{'Q' if is_big else 'I'}", entry, size)[0])
            (tags[tag],) = struct.unpack(value, stream.read(struct.calcsize(value)))
        else:
            (tags[tag],) = struct.unpack_from(value, entry, size)
    width, height = tags[_WIDTH], tags[_HEIGHT]
    channels, depth = tags.get(_SAMPLES, 1), (tags.get(_BITS, 1) + 7) // 8
    tile = max(tags.get(_TILE_WIDTH, 0), 1) * max(tags.get(_TILE_HEIGHT, 0), 1)
    if tile > max(4 * width * height, 2**20):
        raise ValueError("a tile that is larger than the image")
    return ImageHeader(width, height, channels, depth)


def _bmp(stream: BinaryIO) -> ImageHeader:
    """Return the size in the header of a BMP, whose rows may be stored from the top, with a negative height."""
    data = stream.read(30)
    if int.from_bytes(data[14:18], "little") == 12:
        width, height, _, bits = struct.unpack_from("<HHHH", data, 18)
    else:
        width, height, _, bits = struct.unpack_from("<iiHH", data, 18)
    return ImageHeader(width, abs(height), 4 if bits == 32 else 3, 1)


def _webp(stream: BinaryIO) -> ImageHeader | None:
    """Return the size in the first chunk of a WebP, of one of three kinds."""
    data = stream.read(30)
    kind = data[12:16]
    if data[8:12] != b"WEBP":
        return None
    if kind == b"VP8X":
        width, height = (int.from_bytes(data[at : at + 3], "little") + 1 for at in (24, 27))
    elif kind == b"VP8L":
        packed = int.from_bytes(data[21:25], "little")
        width, height = (packed & 0x3FFF) + 1, (packed >> 14 & 0x3FFF) + 1
    elif kind == b"VP8 ":
        width, height = (size & 0x3FFF for size in struct.unpack_from("<HH", data, 26))
    else:
        return None
    return ImageHeader(width, height, 4, 1)


def _pnm(stream: BinaryIO) -> ImageHeader | None:
    """Return the size in the text at the start of a PBM, PGM or PPM."""
    header = _PNM.match(stream.read(512))
    if header is None:
        return None
    kind, width, height = (int(header[group]) for group in (1, 2, 3))
    depth = 1 if kind in (1, 4) or int(header[4] or 255) < 256 else 2
    return ImageHeader(width, height, 3 if kind in (3, 6) else 1, depth)


_READERS: dict[bytes, Callable[[BinaryIO], ImageHeader | None]] = {
    b"\x89PNG\r\n\x1a\n": _png,
    b"\xff\xd8": _jpeg,
    b"II*\0": _tiff,
    b"MM\0*": _tiff,
    b"II+\0": _tiff,
    b"MM\0+": _tiff,
    b"BM": _bmp,
    b"RIFF": _webp,
    **{f"P{kind}".encode(): _pnm for kind in range(1, 7)},
}
