"""The file of a map: a zip archive of one JSON document and one npy file for each array of `SavedMap`.

A file from elsewhere is not trusted. Members have fixed names and limited sizes, and they are decompressed in pieces,
never beyond the declared size. The headers of the arrays are matched literally and nothing is unpickled. All checks of
the values follow in `saved_arrays`.
"""

import io
import json
import re
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from dronevio.estimator.slam.files.saved_arrays import LAYOUT
from dronevio.estimator.slam.files.saved_map import SavedMap
from dronevio.models.camera import CameraModel
from dronevio.models.errors import InputError
from dronevio.models.recordings.files import as_input_error, check_regular_file, write_bytes
from dronevio.models.rig import RigCamera
from dronevio.models.serialization import to_jsonable

FORMAT = "dronevio-map"
"""Name of the format, in the JSON document."""
VERSION = 1
"""Version of the format that is written, and the only one that is read."""
DOCUMENT = "map.json"
"""Member with the format, its version, the first keyframe and the cameras."""
MEMBERS = (DOCUMENT, *(f"{name}.npy" for name in LAYOUT))
"""Names of the members, in their order."""
MAX_FILE_BYTES = 2**30
"""Largest size of a file, which is about an hour of flight through new ground."""
MAX_DOCUMENT_BYTES = 2**20
"""Largest size of the JSON document."""
MAX_EXPANSION = 20
"""Largest ratio of the sizes of all members and of the file, beside `FREE_BYTES`. Descriptors can hardly be compressed,
so that maps have a ratio below 3."""
FREE_BYTES = 2**20
"""Number of bytes beyond that ratio."""

_EXPECTED = "a map that dronevio has saved"
_END = 22  # bytes of the end record of an archive without comment
_PIECE = 2**20
_DATE = (1980, 1, 1, 0, 0, 0)  # the same map gives the same bytes
_HEADER = re.compile(
    rb"\x93NUMPY\x01\x00..\{'descr': '([<|][a-z][0-9])', 'fortran_order': False,"
    rb" 'shape': \(([0-9, ]{0,60})\), \} *\n",
    re.DOTALL,
)


def write_map(path: Path, saved: SavedMap) -> None:
    """Write a map atomically; the same map gives the same bytes.

    Raises:
        InputError: The file cannot be written, or would be larger than files that are read.
    """
    document = {
        "format": FORMAT,
        "version": VERSION,
        "first": saved.first,
        "cameras": [to_jsonable(camera) for camera in saved.cameras],
    }
    members = {DOCUMENT: (json.dumps(document, indent=2) + "\n").encode()}
    for name, (dtype, _) in LAYOUT.items():
        with io.BytesIO() as content:
            array = np.ascontiguousarray(getattr(saved, name), dtype=dtype)
            np.lib.format.write_array(content, array, version=(1, 0), allow_pickle=False)
            members[f"{name}.npy"] = content.getvalue()
    with io.BytesIO() as content:
        with zipfile.ZipFile(content, "w") as archive:
            for name, data in members.items():
                archive.writestr(zipfile.ZipInfo(name, _DATE), data, zipfile.ZIP_DEFLATED)
        data = content.getvalue()
    if len(data) > MAX_FILE_BYTES:
        raise InputError(path, f"a map of {len(data)} bytes", f"at most {MAX_FILE_BYTES} bytes")
    write_bytes(path, data)


def read_map(path: Path) -> SavedMap:
    """Return the map of a file.

    Raises:
        InputError: The file is missing, damaged, of another version or format, or larger than a map; or its values are
            not those of a map. The message names the member.
    """
    members = _members(path)
    document = _document(path, members[DOCUMENT])
    arrays = {name: _array(path, name, members[f"{name}.npy"]) for name in LAYOUT}
    with as_input_error(path):
        return SavedMap(cameras=_cameras(path, document), first=_whole(path, document, "first"), **arrays)


def _members(path: Path) -> Mapping[str, bytes]:
    """Return the contents of all members.

    Raises:
        InputError: The archive is damaged or too large, or has other members.
    """
    check_regular_file(path, _EXPECTED)
    try:
        with path.open("rb") as stream:
            size = stream.seek(0, io.SEEK_END)
            if size > MAX_FILE_BYTES:
                raise InputError(path, f"a file of {size} bytes", f"{_EXPECTED}, of at most {MAX_FILE_BYTES} bytes")
            _check_end(path, stream, size)
            with zipfile.ZipFile(stream) as archive:
                _check_entries(path, archive.infolist(), size)
                return {entry.filename: _content(archive, entry) for entry in archive.infolist()}
    except FileNotFoundError:
        raise InputError(path, "no such file", _EXPECTED) from None
    except IsADirectoryError:
        raise InputError(path, "a folder", _EXPECTED) from None
    except (
        zipfile.BadZipFile,
        zlib.error,
        EOFError,
        OSError,
        ValueError,
        NotImplementedError,
        RuntimeError,  # an encrypted member
    ) as error:
        raise InputError(path, f"an archive that cannot be read ({error})", _EXPECTED) from None


def _check_end(path: Path, stream: io.BufferedReader, size: int) -> None:
    """Raise InputError unless a file ends as an archive with as many members as a map has.

    It is checked before the archive is opened, which reads its whole directory.
    """
    stream.seek(max(size - _END - 20, 0))
    tail = stream.read()
    end = tail[-_END:]
    if len(end) < _END or not end.startswith(b"PK\x05\x06") or tail.startswith(b"PK\x06\x07"):
        raise InputError(path, "no archive, or a truncated one", _EXPECTED)
    count, directory = int.from_bytes(end[10:12], "little"), int.from_bytes(end[12:16], "little")
    if count != len(MEMBERS):
        raise InputError(path, f"an archive with {count} members", f"{_EXPECTED}, with {len(MEMBERS)} members")
    if directory > 2**16:
        raise InputError(path, f"an archive whose directory has {directory} bytes", f"{_EXPECTED}, with at most 65536")


def _check_entries(path: Path, entries: list[zipfile.ZipInfo], size: int) -> None:
    """Raise InputError unless an archive has the members of a map, of plausible size."""
    names = [entry.filename for entry in entries]
    missing, unknown = sorted(set(MEMBERS) - set(names)), sorted(set(names) - set(MEMBERS))
    if unknown:
        raise InputError(path, f"the member {unknown[0]!r}", "the members of a map, such as 'map.json'")
    if missing or len(names) != len(MEMBERS):
        raise InputError(path, f"no {missing[0]}" if missing else "a repeated member", _EXPECTED)
    for entry in entries:
        if entry.filename == DOCUMENT and entry.file_size > MAX_DOCUMENT_BYTES:
            raise InputError(path, f"{DOCUMENT} of {entry.file_size} bytes", f"at most {MAX_DOCUMENT_BYTES} bytes")
    total, largest = sum(entry.file_size for entry in entries), MAX_EXPANSION * size + FREE_BYTES
    if total > largest:
        raise InputError(path, f"members of {total} bytes", f"at most {largest} bytes in a file of {size} bytes")


def _content(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> bytes:
    """Return the content of a member, of which no more is decompressed at a time than a piece."""
    pieces = []
    with archive.open(entry) as stream:
        while piece := stream.read(_PIECE):
            pieces.append(piece)
    return b"".join(pieces)


def _array(path: Path, name: str, content: bytes) -> npt.NDArray[Any]:
    """Return an array of the type of the layout.

    Raises:
        InputError: The header is not that of such an array, or the data have another size.
    """
    dtype, layout = LAYOUT[name]
    header = _HEADER.match(content)
    if header is None or int.from_bytes(content[8:10], "little") + 10 != header.end():
        raise InputError(path, f"{name}.npy without the header of an array", f"an array of type {dtype}")
    if (found := header[1].decode()) != dtype:
        raise InputError(path, f"{name}.npy of type {found}", f"type {dtype}")
    try:
        shape = tuple(int(word) for word in header[2].decode().split(",") if word.strip())
    except ValueError:
        raise InputError(path, f"{name}.npy without a shape", f"an array of type {dtype}") from None
    if len(shape) != len(layout):
        raise InputError(path, f"{name}.npy with {len(shape)} dimensions", f"{len(layout)}")
    needed = np.dtype(dtype).itemsize
    for length in shape:
        needed *= length
    if needed != len(content) - header.end():
        raise InputError(path, f"{name}.npy with {len(content) - header.end()} bytes", f"{needed} for shape {shape}")
    return np.frombuffer(content, dtype, offset=header.end()).reshape(shape)


def _document(path: Path, content: bytes) -> dict[str, Any]:
    """Return the JSON document.

    Raises:
        InputError: It is damaged, or of another format or version.
    """
    try:
        document = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise InputError(path, f"{DOCUMENT} that cannot be read ({error})", "a JSON object") from None
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise InputError(path, f"{DOCUMENT} of another format", f"the format {FORMAT!r}")
    version = document.get("version")
    if type(version) is not int or version != VERSION:
        raise InputError(path, f"{DOCUMENT} with version {_short(version)}", f"version {VERSION}")
    return document


def _whole(path: Path, values: Mapping[str, Any], name: str) -> int:
    """Return a whole number of a document, or raise InputError."""
    value = values.get(name)
    if type(value) is not int or abs(value) >= 2**31:
        raise InputError(path, f"{DOCUMENT}: {name} = {_short(value)}", "a whole number")
    return value


def _number(path: Path, values: Mapping[str, Any], name: str) -> float:
    """Return a number of a document, or raise InputError."""
    value = values.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e12:
        raise InputError(path, f"{DOCUMENT}: {name} = {_short(value)}", "a number")
    return float(value)


def _numbers(path: Path, values: Any, name: str, count: int | None = None) -> list[float]:
    """Return a list of numbers of a document, of any length if none is given, or raise InputError."""
    if not isinstance(values, list) or (count is not None and len(values) != count):
        expected = "numbers" if count is None else f"{count} numbers"
        raise InputError(path, f"{DOCUMENT}: {name} = {_short(values)}", expected)
    return [_number(path, {name: value}, name) for value in values]


def _cameras(path: Path, document: Mapping[str, Any]) -> tuple[RigCamera, ...]:
    """Return the cameras of a document.

    Raises:
        InputError: A value is missing or of another type.
        ConfigError: A value is not allowed.
    """
    cameras = document.get("cameras")
    if not isinstance(cameras, list) or not 0 < len(cameras) < 256:
        raise InputError(path, f"{DOCUMENT}: cameras = {_short(cameras)}", "a list of 1 to 255 cameras")
    return tuple(_camera(path, camera) for camera in cameras)


def _camera(path: Path, values: Any) -> RigCamera:
    """Return a camera of a document; see `_cameras`."""
    if not isinstance(values, dict) or not isinstance(model := values.get("model"), dict):
        raise InputError(path, f"{DOCUMENT}: cameras with {_short(values)}", "an object with model and T_imu_cam")
    rows = values.get("T_imu_cam")
    if not isinstance(rows, list) or len(rows) != 4:
        raise InputError(path, f"{DOCUMENT}: T_imu_cam = {_short(rows)}", "4 rows of 4 numbers")
    lens = model.get("lens")
    if not isinstance(lens, str):
        raise InputError(path, f"{DOCUMENT}: lens = {_short(lens)}", "the name of a lens model")
    return RigCamera(
        CameraModel(
            _whole(path, model, "width"),
            _whole(path, model, "height"),
            _number(path, model, "fx"),
            _number(path, model, "fy"),
            _number(path, model, "cx"),
            _number(path, model, "cy"),
            distortion=tuple(_numbers(path, model.get("distortion"), "distortion")),
            lens=lens,  # type: ignore[arg-type]  # checked by the model
        ),
        np.array([_numbers(path, row, "T_imu_cam", 4) for row in rows]),
        _number(path, values, "rate_hz"),
        _number(path, values, "readout_s"),
        _number(path, values, "time_offset_s") if "time_offset_s" in values else 0.0,  # not in maps of older versions
    )


def _short(value: object) -> str:
    """Return a value as text on one line, not too long."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else f"{text[:57]}…"
