"""Point clouds as PLY files, ascii and binary, which viewers such as MeshLab and CloudCompare show.

Camera frusta are written as vertices behind the points, connected by edges. Source: Turk, "The PLY polygon file
format", 1994.
"""

from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.reconstructions.parsing import check_numbers, colours_from_numbers, parse_numbers, truncated
from dronevio.models.recordings.files import read_bytes, write_bytes

Colours = npt.NDArray[np.uint8]

MAGIC = b"ply"
"""First bytes of a file."""
NO_COLOUR = 128
"""Grey value of points that are read without a colour."""
FRUSTUM_COLOUR = (255, 64, 64)
"""Colour of camera frusta: red, green, blue."""

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_BYTE_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_LONGEST_HEADER = 1 << 16
_VERTEX = np.dtype([("position", "<f8", 3), ("colour", "u1", 3)])
_EDGE = np.dtype([("vertices", "<i4", 2), ("colour", "u1", 3)])
_FRUSTUM_EDGES = np.array([(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)])  # vertex 0 is the camera


@dataclass(frozen=True)
class _Header:
    """Header of a file, as far as it describes the vertices."""

    form: str
    """Name of the format of the data: ``ascii`` or one of the binary ones."""
    size: int
    """Number of bytes of the header."""
    lines: int
    """Number of lines of the header."""
    skipped_rows: int
    """Number of rows of ascii data before the vertices."""
    skipped_bytes: int
    """Number of bytes of binary data before the vertices."""
    count: int
    """Number of vertices."""
    vertex: np.dtype[np.void]
    """Properties of a vertex."""


def write_ply(
    path: Path, reconstruction: Reconstruction, frustum_depth: float | None = None, binary: bool = True
) -> None:
    """Write the points of a reconstruction and their colours, and the frusta of its cameras on request.

    Args:
        path: The file to write.
        reconstruction: The reconstruction to write.
        frustum_depth: Length of the edges of the camera frusta in the unit of the world frame; None for no frusta.
        binary: Whether to write binary little-endian data instead of ascii.

    Raises:
        InputError: The file cannot be written.
        ConfigError: The length of the frusta is not positive.
    """
    vertices = np.empty(len(reconstruction.points), _VERTEX)
    vertices["position"], vertices["colour"] = reconstruction.points, reconstruction.colours
    edges = np.empty(0, _EDGE)
    if frustum_depth is not None:
        if not 0.0 < frustum_depth < np.inf:
            raise ConfigError(f"frustum_depth = {frustum_depth}; expected a length above zero")
        corners, edges = _frusta(reconstruction, frustum_depth, len(vertices))
        vertices = np.concatenate([vertices, corners])
    colour = [f"property uchar {name}" for name in ("red", "green", "blue")]
    header = [
        "ply",
        f"format {'binary_little_endian' if binary else 'ascii'} 1.0",
        f"element vertex {len(vertices)}",
        *(f"property double {name}" for name in "xyz"),
        *colour,
    ]
    if len(edges):
        header += [f"element edge {len(edges)}", "property int vertex1", "property int vertex2", *colour]
    content = "\n".join([*header, "end_header\n"]).encode("ascii")
    if binary:
        content += vertices.tobytes() + edges.tobytes()
    else:
        content += (
            _rows(vertices["position"], vertices["colour"]) + _rows(edges["vertices"], edges["colour"])
        ).encode()
    write_bytes(Path(path), content)


def read_ply(path: Path) -> Reconstruction:
    """Read the vertices of a PLY file as a reconstruction without images; other elements are ignored.

    Points without the properties ``red``, ``green`` and ``blue`` are grey. The vertices of camera frusta are points,
    too.

    Raises:
        InputError: The file is missing, damaged or truncated, or has no vertices with ``x``, ``y`` and ``z``.
    """
    path = Path(path)
    data = read_bytes(path, "a PLY file")
    header = _parse_header(path, data)
    vertices = _ascii_vertices(path, data, header) if header.form == "ascii" else _binary_vertices(path, data, header)
    names = vertices.dtype.names or ()
    colours = np.full((len(vertices), 3), NO_COLOUR, np.uint8)
    if {"red", "green", "blue"} <= set(names):
        colours = colours_from_numbers(path, _columns(vertices, ("red", "green", "blue")))
    none = np.empty(0, np.int64)
    return Reconstruction(
        cameras=(),
        image_names=(),
        image_camera=none,
        Ts_world_cam=np.empty((0, 4, 4)),
        points=check_numbers(path, _columns(vertices, ("x", "y", "z"))),
        colours=colours,
        observation_image=none,
        observation_point=none,
        observation_px=np.empty((0, 2)),
    )


def _parse_header(path: Path, data: bytes) -> _Header:
    """Return the header of a file.

    Raises:
        InputError: The header is damaged, or describes no vertices that can be read.
    """
    form = ""
    elements: list[tuple[str, int, list[tuple[str, str]]]] = []
    start = 0
    for line in range(1, _LONGEST_HEADER):
        end = data.find(b"\n", start, _LONGEST_HEADER)
        if end < 0:
            raise truncated(path, "a header without end_header", line)
        words = data[start:end].decode("ascii", errors="replace").split() or [""]
        start = end + 1
        if line == 1:
            if words != ["ply"]:
                raise InputError(path, repr(" ".join(words)[:40]), "'ply' in the first line", 1)
        elif words[0] == "format" and len(words) == 3 and words[1] in _BYTE_ORDERS and not form:
            form = words[1]
        elif words[0] == "element" and len(words) == 3 and form and words[2].isdecimal() and len(words[2]) < 19:
            elements.append((words[1], int(words[2]), []))
        elif words[0] == "property" and elements and _is_property(words):
            elements[-1][2].append((words[-1], "list" if words[1] == "list" else _BYTE_ORDERS[form] + _TYPES[words[1]]))
        elif words[0] == "end_header":
            break
        elif words[0] not in ("", "comment", "obj_info"):
            raise InputError(path, repr(" ".join(words)[:40]), "a line of a PLY header", line)
    skipped_rows = skipped_bytes = 0
    for name, count, properties in elements:
        fixed = all(kind != "list" for _, kind in properties)
        if not fixed and (name == "vertex" or form != "ascii"):
            raise InputError(path, f"{name} elements of variable size", "vertices of fixed size before all others")
        dtype = np.dtype([]) if not fixed else _structure(path, properties)
        if name == "vertex":
            if not {"x", "y", "z"} <= set(dtype.names or ()):
                raise InputError(path, "vertices without x, y and z", "vertices with a position")
            return _Header(form, start, line, skipped_rows, skipped_bytes, count, dtype)
        skipped_rows += count
        skipped_bytes += count * dtype.itemsize
    raise InputError(path, "no vertices", "an element named vertex")


def _is_property(words: list[str]) -> bool:
    """Return whether the words of a header line describe a property of known type."""
    if words[1:2] == ["list"]:
        return len(words) == 5 and words[2] in _TYPES and words[3] in _TYPES
    return len(words) == 3 and words[1] in _TYPES


def _structure(path: Path, properties: list[tuple[str, str]]) -> np.dtype[np.void]:
    """Return the type of an element.

    Raises:
        InputError: Two properties have the same name.
    """
    if len({name for name, _ in properties}) != len(properties):
        raise InputError(path, "two properties of the same name", "properties of different names")
    return np.dtype(properties)


def _binary_vertices(path: Path, data: bytes, header: _Header) -> npt.NDArray[np.void]:
    """Return the vertices (N,) of binary data.

    Raises:
        InputError: The data end before the last vertex.
    """
    start = header.size + header.skipped_bytes
    needed = header.count * header.vertex.itemsize
    if start + needed > len(data):
        left = max(len(data) - start, 0)
        raise truncated(path, f"{left} bytes where {header.count} vertices need {needed}")
    return np.frombuffer(data, header.vertex, header.count, start)


def _ascii_vertices(path: Path, data: bytes, header: _Header) -> npt.NDArray[np.void]:
    """Return the vertices (N,) of ascii data.

    Raises:
        InputError: A row is missing, or has other values than the header describes.
    """
    names = header.vertex.names or ()
    rows = data[header.size :].decode("ascii", errors="replace").split("\n")[header.skipped_rows :][: header.count]
    if len(rows) < header.count:
        raise truncated(path, f"{len(rows)} rows where the header has {header.count} vertices")
    fields = [row.split() for row in rows]
    first_line = header.lines + header.skipped_rows + 1
    wrong = next((i for i, words in enumerate(fields) if len(words) != len(names)), None)
    if wrong is not None:
        expected = f"{len(names)} values: {', '.join(names)[:80]}"
        raise InputError(path, f"{len(fields[wrong])} values", expected, first_line + wrong)
    try:
        values = parse_numbers(path, chain.from_iterable(fields))
    except InputError:
        for i, words in enumerate(fields):
            parse_numbers(path, words, first_line + i)  # the error with its line
        raise
    vertices = np.empty(header.count, [(name, np.float64) for name in names])
    for k, name in enumerate(names):
        vertices[name] = values[k :: len(names)]
    return vertices


def _columns(vertices: npt.NDArray[np.void], names: tuple[str, ...]) -> Array:
    """Return properties of vertices (N,) as numbers (N, len(names))."""
    return np.stack([vertices[name].astype(np.float64) for name in names], axis=1)


def _rows(values: npt.NDArray[Any], colours: Colours) -> str:
    """Return rows of numbers (N, …) and colours (N, 3) as text without loss of precision."""
    rows = zip(values.tolist(), colours.tolist(), strict=True)
    return "".join(f"{' '.join(map(repr, [*value, *colour]))}\n" for value, colour in rows)


def _frusta(
    reconstruction: Reconstruction, depth: float, first: int
) -> tuple[npt.NDArray[np.void], npt.NDArray[np.void]]:
    """Return vertices (5 C,) and edges (8 C,) of the frusta of all images.

    Args:
        reconstruction: The reconstruction.
        depth: Length of the edges from the camera to the corners, in the unit of the world frame.
        first: Index of the first of these vertices in the file.
    """
    C = len(reconstruction.image_names)
    in_camera = np.zeros((C, 5, 3))
    for i, camera in enumerate(reconstruction.image_camera):
        in_camera[i, 1:] = depth * _corner_directions(reconstruction.cameras[camera])
    T = reconstruction.Ts_world_cam
    vertices, edges = np.empty(5 * C, _VERTEX), np.empty(8 * C, _EDGE)
    positions = np.einsum("cij,ckj->cki", T[:, :3, :3], in_camera) + T[:, None, :3, 3]
    vertices["position"], vertices["colour"] = positions.reshape(-1, 3), FRUSTUM_COLOUR
    numbers = first + 5 * np.arange(C)[:, None, None] + _FRUSTUM_EDGES
    edges["vertices"], edges["colour"] = numbers.reshape(-1, 2), FRUSTUM_COLOUR
    return vertices, edges


def _corner_directions(camera: CameraModel) -> Array:
    """Return the directions (4, 3) of the image corners; those without distortion where the lens model is not valid."""
    right, bottom = camera.width - 0.5, camera.height - 0.5
    corners = np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom]])
    pinhole = np.column_stack([(corners - [camera.cx, camera.cy]) / camera.central_focal_px, np.ones(4)])
    bearing = camera.unproject(corners)
    return np.where(np.isfinite(bearing), bearing, pinhole / np.linalg.norm(pinhole, axis=1, keepdims=True))
