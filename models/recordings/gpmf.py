"""Telemetry of GoPro cameras: payloads in the General Purpose Metadata Format (GPMF).

A payload is a sequence of entries of key, length and value, aligned to four bytes, big end first; entries of type 0
contain others. A device (``DEVC``) has streams (``STRM``), each with properties, such as the divisor ``SCAL``, in front
of its samples. Format: https://github.com/gopro/gpmf-parser.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array

SENSORS = ("GYRO", "ACCL")
"""Keys of the samples of gyroscope [rad/s] and accelerometer [m/s²]."""

_NESTED = 0
_MAX_DEPTH = 8
_TYPES = {"b": "i1", "B": "u1", "s": ">i2", "S": ">u2", "l": ">i4", "L": ">u4", "f": ">f4", "d": ">f8", "J": ">u8"}
_TYPES |= {"j": ">i8", "c": "S1", "F": "S4"}


@dataclass(frozen=True, eq=False)
class SensorPayload:
    """Samples of a sensor in one payload."""

    values: Array
    """(N, 3) Samples in SI units, in the axes of the camera that `axes_matrix` describes, or those of the file."""
    stamp_us: int | None
    """Time of the first sample on the clock of the camera [µs], None if the payload has none."""


def read_payload(data: bytes) -> dict[str, SensorPayload]:
    """Return the samples of gyroscope and accelerometer in a payload, by their keys.

    Raises:
        ValueError: The payload is damaged.
    """
    payload: dict[str, SensorPayload] = {}
    for stream in _streams(data, 0):
        properties: dict[str, npt.NDArray[np.generic]] = {}
        for key, kind, size, content in _entries(stream):
            if kind == _NESTED:
                continue
            if key in SENSORS:
                payload[key] = _samples(_numbers(kind, size, content), properties)
            elif chr(kind) in _TYPES:
                properties[key] = _numbers(kind, size, content)
    return payload


def axes_matrix(ordered_in: str, ordered_out: str) -> Array:
    """Return the matrix (3, 3) from channels in one order of axes to another one.

    Args:
        ordered_in: Axis of each channel, such as ``YxZ``, where a small letter is the opposite direction (``ORIN``).
        ordered_out: Axis of each channel of the result (``ORIO``).

    Raises:
        ValueError: A name is not that of three different axes.
    """
    for name in (ordered_in, ordered_out):
        if sorted(name.upper()) != ["X", "Y", "Z"]:
            raise ValueError(f"axes {name!r}; expected three such as YxZ")
    matrix = np.zeros((3, 3))
    for row, axis in enumerate(ordered_out):
        column = ordered_in.upper().index(axis.upper())
        matrix[row, column] = 1.0 if ordered_in[column] == axis else -1.0
    return matrix


def _samples(numbers: npt.NDArray[np.generic], properties: dict[str, npt.NDArray[np.generic]]) -> SensorPayload:
    """Return the samples of a stream with its properties, or raise ValueError."""
    values = numbers.astype(np.float64)
    if values.ndim != 2 or values.shape[1] != 3:
        raise ValueError("samples with other than three numbers")
    divisor = properties.get("SCAL", np.ones(1)).astype(np.float64).ravel()
    if not np.all(divisor != 0.0) or len(divisor) not in (1, 3):
        raise ValueError("a divisor of 0, or of other than one or three numbers")
    values = values / divisor
    if "ORIN" in properties and "ORIO" in properties:
        values = values @ axes_matrix(_text(properties["ORIN"]), _text(properties["ORIO"])).T
    elif "MTRX" in properties and properties["MTRX"].size == 9:
        values = values @ properties["MTRX"].astype(np.float64).reshape(3, 3).T
    stamps = properties.get("STMP")
    return SensorPayload(values, None if stamps is None or not stamps.size else int(stamps.ravel()[0]))


def _streams(data: bytes, depth: int) -> Iterator[bytes]:
    """Yield the contents of all streams, or raise ValueError."""
    if depth > _MAX_DEPTH:
        raise ValueError("entries that are nested too deep")
    for key, kind, _, content in _entries(data):
        if key == "STRM" and kind == _NESTED:
            yield content
        elif kind == _NESTED:
            yield from _streams(content, depth + 1)


def _entries(data: bytes) -> Iterator[tuple[str, int, int, bytes]]:
    """Yield key, type, size of a sample and content of each entry, or raise ValueError."""
    at = 0
    while at + 8 <= len(data):
        name, kind, size, repeat = struct.unpack_from(">4sBBH", data, at)
        at += 8
        if name == b"\0\0\0\0":  # padding
            continue
        if size * repeat > len(data) - at:
            raise ValueError(f"an entry {name!r} of {size * repeat} bytes, of which {len(data) - at} exist")
        yield name.decode("latin-1"), kind, size, data[at : at + size * repeat]
        at += -(-size * repeat // 4) * 4


def _numbers(kind: int, size: int, content: bytes) -> npt.NDArray[np.generic]:
    """Return the numbers (N, C) of an entry, or raise ValueError."""
    form = np.dtype(_TYPES[chr(kind)]) if chr(kind) in _TYPES else None
    if form is None or not size or size % form.itemsize:
        raise ValueError(f"samples of {size} bytes of type {kind}")
    return np.frombuffer(content, form).reshape(-1, size // form.itemsize)


def _text(characters: npt.NDArray[np.generic]) -> str:
    """Return the text of an array of characters."""
    return characters.tobytes().decode("latin-1").strip("\0 ")
