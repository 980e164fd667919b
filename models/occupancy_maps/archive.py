"""Occupancy grids as archives of numpy arrays (``.npz``), which hold numbers and text alone, never pickled objects.

An archive has the arrays

    low_m     (3,) float64, lower corner of the first cell [m]
    cell_m    () float64, side of a cell [m]
    states    (X, Y, Z) uint8: 0 unknown, 1 free, 2 occupied
    frame     () text: "odom" or "map"
"""

import io
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any, get_args

import numpy as np
import numpy.typing as npt

from dronevio.models.errors import InputError
from dronevio.models.occupancy import OCCUPIED, Frame, OccupancyGrid
from dronevio.models.recordings.files import read_bytes, write_bytes

MAX_CELLS = 2_000_000_000
"""Largest number of cells of a grid that is read."""
_EXPECTED = "an occupancy grid of `dronevio map`, a .npz file with low_m, cell_m, states and frame"
_FIELDS = ("low_m", "cell_m", "states", "frame")
_HEADER_BYTES = 4096  # more than the header of an array takes
_DAMAGED: tuple[type[Exception], ...] = (
    ValueError,
    TypeError,
    EOFError,
    KeyError,
    OSError,
    NotImplementedError,
    RuntimeError,
    SyntaxError,
)
_DAMAGED += (MemoryError, zipfile.BadZipFile, zlib.error, struct.error)


def write_occupancy(path: Path, grid: OccupancyGrid) -> None:
    """Write an occupancy grid, compressed.

    Args:
        path: The file to write, with the suffix ``.npz``.
        grid: The grid.

    Raises:
        InputError: The file cannot be written.
    """
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        low_m=grid.low_m.astype(np.float64),
        cell_m=np.float64(grid.cell_m),
        states=grid.states,
        frame=np.array(grid.frame),
    )
    write_bytes(Path(path), buffer.getvalue())


def read_occupancy(path: str | Path) -> OccupancyGrid:
    """Read an occupancy grid.

    Args:
        path: A file that `write_occupancy` wrote.

    Raises:
        InputError: The file is missing, damaged, or holds something else; the message names the array.
    """
    path = Path(path)
    data = read_bytes(path, _EXPECTED)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            sizes = {info.filename.removesuffix(".npy"): info.file_size for info in archive.infolist()}
        _check_contents(path, sizes)
        with np.load(io.BytesIO(data), allow_pickle=False) as loaded:
            arrays = {name: loaded[name] for name in _FIELDS}
    except _DAMAGED as error:
        raise InputError(path, f"a damaged archive ({str(error)[:80] or type(error).__name__})", _EXPECTED) from None
    low_m, cell_m, states, frame = (arrays[name] for name in _FIELDS)
    _check(path, low_m.shape == (3,) and low_m.dtype.kind == "f", "low_m", low_m, "(3,) numbers")
    _check(path, bool(np.isfinite(low_m).all()), "low_m", low_m, "finite numbers")
    _check(path, cell_m.shape == () and cell_m.dtype.kind == "f", "cell_m", cell_m, "a number")
    _check(path, bool(np.isfinite(cell_m)) and float(cell_m) > 0.0, "cell_m", cell_m, "a positive number")
    _check(path, states.ndim == 3 and states.dtype == np.uint8, "states", states, "(X, Y, Z) bytes")
    _check(path, int(states.max(initial=0)) <= OCCUPIED, "states", states, f"0 to {OCCUPIED}")
    _check(path, frame.shape == () and frame.dtype.kind == "U", "frame", frame, "a text")
    frames: dict[str, Frame] = {name: name for name in get_args(Frame)}
    _check(path, str(frame) in frames, "frame", frame, " or ".join(frames))
    return OccupancyGrid(low_m.astype(np.float64), float(cell_m), states, frames[str(frame)])


def _check_contents(path: Path, sizes: dict[str, int]) -> None:
    """Raise InputError unless an archive has the arrays of a grid, of a size that is reasonable once unpacked."""
    missing = [name for name in _FIELDS if name not in sizes]
    if missing:
        raise InputError(path, f"an archive without {', '.join(missing)}", _EXPECTED)
    limits = dict.fromkeys(_FIELDS, _HEADER_BYTES) | {"states": MAX_CELLS + _HEADER_BYTES}
    for name, limit in limits.items():
        if sizes[name] > limit:
            raise InputError(path, f"{name} of {sizes[name]} bytes", f"at most {limit}")


def _check(path: Path, is_right: bool, name: str, array: npt.NDArray[Any], expected: str) -> None:
    """Raise InputError unless an array is as expected."""
    if not is_right:
        value = f"{array}"[:60] if array.size <= 4 else f"an array {array.shape} of {array.dtype}"
        if array.size > 4 and array.dtype == np.uint8 and array.ndim == 3:
            value += f" with values up to {array.max()}"
        raise InputError(path, f"{name}: {value}", expected)
