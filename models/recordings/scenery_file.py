"""The file of the scenery beside a simulated recording: a NumPy archive without pickled objects.

It contains ``outline`` (L, 2, 3) and, for each mesh k, ``vertices_k``, ``texture_coordinates_k``, ``triangles_k`` and
``texture_k``, the bytes of a JPEG image.
"""

import io
import zipfile
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dronevio.models.errors import InputError
from dronevio.models.recordings.files import as_input_error, read_bytes, write_bytes
from dronevio.models.recordings.image_header import encoded_size
from dronevio.models.scenery import NO_SCENERY, Scenery, TexturedMesh

SCENERY_FILE = "world.npz"
"""Name of the file beside ``mav0``."""
_EXPECTED = "the scenery of a simulated flight"
_MAX_BYTES = 64 * 2**20  # of all arrays; a world has 1 to 3 MB
_MAX_PIXELS = 4096 * 4096
_JPEG_QUALITY = 85


def write_scenery(path: Path, scenery: Scenery) -> None:
    """Write the scenery of a world; the same scenery gives the same bytes.

    Raises:
        InputError: The file cannot be written.
    """
    import cv2

    arrays: dict[str, npt.NDArray[np.generic]] = {"outline": scenery.outline.astype(np.float32)}
    for k, mesh in enumerate(scenery.meshes):
        image = cv2.imencode(".jpg", mesh.texture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1]
        arrays |= {
            f"vertices_{k}": mesh.vertices,
            f"texture_coordinates_{k}": mesh.texture_coordinates,
            f"triangles_{k}": mesh.triangles,
            f"texture_{k}": np.asarray(image, np.uint8).ravel(),
        }
    with io.BytesIO() as content:
        np.savez_compressed(content, allow_pickle=False, **arrays)
        write_bytes(path, content.getvalue())


def read_scenery(recording: Path) -> Scenery:
    """Return the scenery beside a recording, without surfaces and outlines if there is no file.

    Args:
        recording: Folder of the recording: ``mav0`` or its parent.

    Raises:
        InputError: The file is damaged; the message names the array.
    """
    path = (recording.parent if recording.name == "mav0" else recording) / SCENERY_FILE
    if not path.is_file():
        return NO_SCENERY
    arrays = _arrays(path)
    count = sum(name.startswith("vertices_") for name in arrays)
    with as_input_error(path):
        return Scenery(
            _array(path, arrays, "outline", "f", (None, 2, 3)).astype(np.float64),
            tuple(_mesh(path, arrays, k) for k in range(count)),
        )


def _arrays(path: Path) -> dict[str, npt.NDArray[np.generic]]:
    """Return the arrays of a file.

    Raises:
        InputError: The file is no archive, too large, or damaged.
    """
    data = read_bytes(path, _EXPECTED)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > _MAX_BYTES:
            raise InputError(path, f"arrays of {size} bytes", f"at most {_MAX_BYTES} bytes")
        with np.load(io.BytesIO(data), allow_pickle=False) as loaded:
            return {name: loaded[name] for name in loaded.files}
    except (zipfile.BadZipFile, ValueError, EOFError, KeyError, OSError, NotImplementedError, MemoryError) as error:
        raise InputError(path, f"data that cannot be read ({error})", _EXPECTED) from None


def _array(
    path: Path, arrays: dict[str, npt.NDArray[np.generic]], name: str, kind: str, shape: tuple[int | None, ...]
) -> npt.NDArray[np.generic]:
    """Return an array of a kind (``f``, ``u``) and a shape, in which None stands for any length.

    Raises:
        InputError: It is missing, or of another kind or shape.
    """
    expected = f"{name}: an array of kind {kind!r} and shape {shape}".replace("None", "N")
    if name not in arrays:
        raise InputError(path, f"no {name}", expected)
    array = arrays[name]
    fits = array.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
    if array.dtype.kind != kind or not fits:
        raise InputError(path, f"{name} of kind {array.dtype.kind!r} and shape {array.shape}", expected)
    return array


def _mesh(path: Path, arrays: dict[str, npt.NDArray[np.generic]], k: int) -> TexturedMesh:
    """Return a mesh of a file.

    Raises:
        InputError: An array is missing or has another kind or shape, or the texture cannot be decoded.
        ConfigError: The arrays contradict each other.
    """
    import cv2

    encoded = _array(path, arrays, f"texture_{k}", "u", (None,)).astype(np.uint8)
    width, height = encoded_size(encoded.tobytes()) or (0, 0)
    texture = None
    if 0 < width * height <= _MAX_PIXELS:
        texture = cv2.imdecode(encoded, cv2.IMREAD_COLOR_RGB)
    if texture is None:
        raise InputError(path, f"texture_{k}: an image of {width} × {height} px", "a JPEG image of at most 16 Mpx")
    return TexturedMesh(
        _array(path, arrays, f"vertices_{k}", "f", (None, 3)).astype(np.float32),
        _array(path, arrays, f"texture_coordinates_{k}", "f", (None, 2)).astype(np.float32),
        _array(path, arrays, f"triangles_{k}", "u", (None, 3)).astype(np.uint32),
        np.asarray(texture, np.uint8),
    )
