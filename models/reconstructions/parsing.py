"""Parsing of untrusted files of reconstructions: numbers, names of images, and bounded reading of binary data."""

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.errors import InputError
from dronevio.models.rotation import nearest_rotations

Indices = npt.NDArray[np.int64]

LARGEST_NUMBER = 1e100
"""Upper limit of the magnitude of a number, so that squares and products do not overflow."""
LARGEST_IMAGE_PX = 1_000_000
"""Upper limit of the width and height of an image [px]."""

_UNIT_TOLERANCE = 0.05  # above rounding to two decimals
_COMPLETE = "a complete file, not a truncated one"
_NAME = "the path of an image below the folder of the images"


def truncated(path: Path, found: str, line: int | None = None) -> InputError:
    """Return the error about a file that ends too early.

    Args:
        path: The file.
        found: Description of what the file ends with.
        line: Line number, counted from 1, of a text file.
    """
    return InputError(path, found, _COMPLETE, line)


def parse_numbers(path: Path, fields: Iterable[str], line: int | None = None, finite: bool = True) -> Array:
    """Return the numbers of text fields.

    Args:
        path: The file, for the error message.
        fields: The texts of the numbers.
        line: Line number of the fields, for the error message.
        finite: Whether the numbers have to be finite and of limited magnitude.

    Raises:
        InputError: A field is not such a number.
    """
    try:
        values = np.array(list(map(float, fields)), dtype=np.float64)
    except ValueError as error:
        raise InputError(path, _short(str(error)), "numbers between spaces", line) from None
    return check_numbers(path, values, line=line) if finite else values


def parse_integers(path: Path, fields: Iterable[str], line: int | None = None) -> Indices:
    """Return the integers of text fields.

    Args:
        path: The file, for the error message.
        fields: The texts of the integers.
        line: Line number of the fields, for the error message.

    Raises:
        InputError: A field is not an integer of 64 bits.
    """
    try:
        return np.array(list(map(int, fields)), dtype=np.int64)
    except (ValueError, OverflowError) as error:
        raise InputError(path, _short(str(error)), "integers of 64 bits between spaces", line) from None


def check_numbers(path: Path, values: npt.NDArray[Any], where: str = "", line: int | None = None) -> Array:
    """Return an array of numbers after a check that all are finite and of limited magnitude.

    Args:
        path: The file that contains the numbers.
        values: (…) The numbers.
        where: Place of the numbers in the file, with a colon and a space at its end.
        line: Line number of the numbers.

    Raises:
        InputError: A number is not finite, or its magnitude exceeds `LARGEST_NUMBER`.
    """
    wrong = values[~(np.abs(values) <= LARGEST_NUMBER)]
    if wrong.size:
        raise InputError(path, f"{where}the number {wrong[0]:g}", f"numbers up to {LARGEST_NUMBER:g}", line)
    return values


def check_image_size(path: Path, width: int, height: int, where: str = "", line: int | None = None) -> None:
    """Check that an image has a size between 1 px and `LARGEST_IMAGE_PX`.

    Raises:
        InputError: The size is outside these limits.
    """
    if not 1 <= min(width, height) <= max(width, height) <= LARGEST_IMAGE_PX:
        found = f"{where}an image of {width} × {height} px"
        raise InputError(path, found, f"1 to {LARGEST_IMAGE_PX} px along each side", line)


def check_image_name(path: Path, name: str, line: int | None = None) -> str:
    """Return the name of an image after a check that it is a path below the folder of the images.

    Args:
        path: The file that contains the name.
        name: The name.
        line: Line number of the name.

    Raises:
        InputError: The name is empty, absolute, leads out of the folder, begins or ends with a space, or has a control
            character.
    """
    parts = re.split(r"[/\\]", name)
    if name != name.strip() or not parts[0] or ".." in parts or re.match(r"[A-Za-z]:", name) or not _printable(name):
        raise InputError(path, f"the image name {_short(repr(name))}", _NAME, line)
    return name


def nearest_valid_rotations(path: Path, R: Array, tolerance: float = 0.01) -> Array:
    """Return the rotations (C, 3, 3) nearest to matrices that were read with few digits.

    Raises:
        InputError: A matrix deviates from a rotation by more than the tolerance.
    """
    deviation = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2), initial=0.0)
    wrong = np.flatnonzero(~((deviation < tolerance) & (np.linalg.det(R) > 0.0)))
    if wrong.size:
        raise InputError(path, f"camera {wrong[0]}: a matrix that is not a rotation", "rotation matrices")
    return nearest_rotations(R)


def check_unit_quaternion(path: Path, quat_wxyz: Array, where: str = "", line: int | None = None) -> None:
    """Check that a quaternion (4,) of limited magnitude has unit length, except for rounding.

    Raises:
        InputError: The length of the quaternion differs from 1.
    """
    length = float(np.sqrt(quat_wxyz @ quat_wxyz))
    if not abs(length - 1.0) < _UNIT_TOLERANCE:
        raise InputError(path, f"{where}a quaternion of length {length:.3g}", "a unit quaternion", line)


def colours_from_numbers(path: Path, values: Array, lines: Sequence[int] | None = None) -> npt.NDArray[np.uint8]:
    """Return colours (N, 3) that were read as numbers (N, 3).

    Args:
        path: The file, for the error message.
        values: (N, 3) Red, green and blue.
        lines: Line numbers (N,) of the colours, for the error message.

    Raises:
        InputError: A value is not an integer from 0 to 255.
    """
    wrong = np.flatnonzero(~((values >= 0) & (values <= 255) & (values == np.floor(values))).all(axis=1))
    if wrong.size:
        i = int(wrong[0])
        found = f"the colour {' '.join(f'{value:g}' for value in values[i])}"
        raise InputError(path, found, "three integers from 0 to 255", lines[i] if lines else None)
    return values.astype(np.uint8)


class ByteReader:
    """Sequential reading of binary data. Counts are compared with the length of the data before memory is allocated."""

    def __init__(self, path: Path, data: bytes) -> None:
        """Begin at the first byte.

        Args:
            path: The file that contains the data, for error messages.
            data: The data.
        """
        self.path = path
        self._data = data
        self._offset = 0

    def array(self, dtype: np.dtype[Any] | type, count: int, what: str) -> npt.NDArray[Any]:
        """Return the next values as an array (count,), a view of the data.

        Args:
            dtype: Type of the values.
            count: Number of values.
            what: Description of the values for the error message.

        Raises:
            InputError: The data end before the last value.
        """
        size = np.dtype(dtype).itemsize
        left = len(self._data) - self._offset
        if count * size > left:
            raise truncated(self.path, f"{left} bytes where {what} need {count * size}")
        values = np.frombuffer(self._data, dtype, count, self._offset)
        self._offset += count * size
        return values

    def count(self, what: str, smallest: int) -> int:
        """Return the next number of records, 64 bits.

        Args:
            what: Description of the records for the error message.
            smallest: Number of bytes of the smallest record.

        Raises:
            InputError: The rest of the data is too short for this number of records.
        """
        number = int(self.array(np.dtype("<u8"), 1, f"the number of {what}")[0])
        left = len(self._data) - self._offset
        if number * smallest > left:
            raise truncated(self.path, f"a count of {number} {what} in {left} bytes")
        return number

    def text(self, what: str) -> str:
        """Return the next text, in UTF-8 and terminated by a zero byte.

        Raises:
            InputError: The terminating byte is missing, or the text is not UTF-8.
        """
        end = self._data.find(b"\0", self._offset)
        if end < 0:
            raise truncated(self.path, f"{what} without a terminating zero byte")
        encoded = self._data[self._offset : end]
        self._offset = end + 1
        try:
            return encoded.decode("utf-8")
        except UnicodeDecodeError:
            raise InputError(self.path, f"{what} {_short(repr(encoded))}", "text in UTF-8") from None

    def end(self) -> None:
        """Check that all data have been read.

        Raises:
            InputError: Bytes are left.
        """
        left = len(self._data) - self._offset
        if left:
            raise InputError(self.path, f"{left} bytes after the last record", "the end of the file")


def _printable(name: str) -> bool:
    """Return whether a name has neither control characters nor characters that UTF-8 cannot represent."""
    return not re.search(r"[\x00-\x1f\x7f\u2028\u2029\x85\ud800-\udfff]", name)


def _short(text: str) -> str:
    """Return a text of limited length for an error message."""
    return text if len(text) <= 80 else text[:80] + "…"
