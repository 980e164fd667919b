"""Meshes as binary glTF 2.0 files (GLB), which browsers and game engines show.

A file has one buffer with positions, normals, colours and indices, or coordinates of a texture instead of colours and
the texture as JPEG. A vertex at a seam of the texture is there more than once. glTF's y points up: a node turns the
mesh, whose z points up, and moves it, so that positions near zero lose little as 32-bit numbers. Colours of vertices
are linear in glTF; those of photographs are converted from sRGB. The material is unlit, since the colours contain the
light of the scene. Source: Khronos Group, "glTF 2.0 Specification", 2021, and the extension KHR_materials_unlit.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.recordings.files import write_bytes
from dronevio.models.recordings.images import encode_jpeg
from dronevio.models.surfaces import Colours, Mesh

_FLOAT, _UINT16, _UINT32 = 5126, 5123, 5125  # types of components
_QUALITY = 92  # of the JPEG image of a texture
_VERTICES, _INDICES = 34962, 34963  # targets of buffer views
_LINEAR = 9729  # filter of a texture
_TURN_XYZW = [-np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]  # (x, y, z) becomes (x, z, −y)
_UNLIT = "KHR_materials_unlit"


def write_glb(path: Path, mesh: Mesh) -> None:
    """Write a mesh with the normals of its vertices, and its texture or the colours of the vertices.

    Args:
        path: The file to write.
        mesh: The mesh.

    Raises:
        InputError: The file cannot be written.
    """
    if not len(mesh.triangles):  # a file has no empty meshes
        write_bytes(Path(path), _file({"scenes": [{}]}, b""))
        return
    centre = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2.0
    texture = mesh.texture
    vertices, triangles = (slice(None), mesh.triangles) if texture is None else (texture.vertices, texture.triangles)
    parts = {
        "POSITION": ((mesh.vertices[vertices] - centre).astype("<f4"), _FLOAT, "VEC3"),
        "NORMAL": (_unit(mesh.normals[vertices]).astype("<f4"), _FLOAT, "VEC3"),
    }
    if texture is None:
        parts["COLOR_0"] = (_linear(mesh.colours), _UINT16, "VEC4")
    else:
        parts["TEXCOORD_0"] = (texture.coordinates().astype("<f4"), _FLOAT, "VEC2")
    parts["indices"] = (triangles.reshape(-1).astype("<u4"), _UINT32, "SCALAR")
    buffers: list[bytes] = []
    views: list[dict[str, Any]] = []
    accessors = []
    for name, (values, component, kind) in parts.items():
        accessor: dict[str, Any] = {"bufferView": len(views), "componentType": component, "count": len(values)}
        accessors.append({**accessor, "type": kind, **_normalized(name), **_bounds(name, values)})
        _append(buffers, views, values.tobytes(), target=_INDICES if name == "indices" else _VERTICES)
    attributes = {name: number for number, name in enumerate(parts) if name != "indices"}
    primitive = {"attributes": attributes, "indices": len(accessors) - 1, "material": 0}
    material: dict[str, Any] = {"doubleSided": True, "extensions": {_UNLIT: {}}}
    x, y, z = centre.tolist()
    document: dict[str, Any] = {
        "extensionsUsed": [_UNLIT],
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": _TURN_XYZW, "translation": [x, z, -y]}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [material],
        "accessors": accessors,
        "bufferViews": views,
    }
    if texture is not None:
        material["pbrMetallicRoughness"] = {"baseColorTexture": {"index": 0}, "metallicFactor": 0.0}
        document["textures"] = [{"source": 0, "sampler": 0}]
        document["samplers"] = [{"magFilter": _LINEAR, "minFilter": _LINEAR}]
        document["images"] = [{"bufferView": len(views), "mimeType": "image/jpeg"}]
        _append(buffers, views, encode_jpeg(texture.image, _QUALITY))
    content = b"".join(buffers)
    write_bytes(Path(path), _file({**document, "buffers": [{"byteLength": len(content)}]}, content))


def _append(buffers: list[bytes], views: list[dict[str, Any]], content: bytes, **more: int) -> None:
    """Append a part of the buffer, which ends at a multiple of four as all components need, with its view."""
    offset = sum(map(len, buffers))
    views.append({"buffer": 0, "byteOffset": offset, "byteLength": len(content), **more})
    buffers.append(content + b"\0" * (-len(content) % 4))


def _unit(normals: Array) -> Array:
    """Return normals (N, 3) of unit length, upwards where there is none, since a file must not have others."""
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(lengths > 0.0, normals / np.where(lengths > 0.0, lengths, 1.0), [0.0, 0.0, 1.0])


def _normalized(name: str) -> dict[str, Any]:
    """Return the mark of colours: integers that stand for values from 0 to 1."""
    return {"normalized": True} if name == "COLOR_0" else {}


def _bounds(name: str, values: npt.NDArray[Any]) -> dict[str, Any]:
    """Return the limits of positions, which a file must state."""
    return {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()} if name == "POSITION" else {}


def _linear(colours: Colours) -> npt.NDArray[np.uint16]:
    """Return linear values (N, 4), opaque, of colours (N, 3) in sRGB (IEC 61966-2-1)."""
    values = colours / 255.0
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    return np.rint(65535.0 * np.hstack([linear, np.ones((len(colours), 1))])).astype("<u2")


def _file(document: dict[str, Any], binary: bytes) -> bytes:
    """Return a file with a chunk of JSON and, unless it is empty, one of binary data."""
    asset = {"asset": {"version": "2.0", "generator": "dronevio"}, "scene": 0}
    text = json.dumps({**asset, **document}, separators=(",", ":")).encode("ascii")
    chunks = _chunk(b"JSON", text + b" " * (-len(text) % 4))
    if binary:
        chunks += _chunk(b"BIN\0", binary + b"\0" * (-len(binary) % 4))
    return b"glTF" + np.array([2, 12 + len(chunks)], "<u4").tobytes() + chunks


def _chunk(kind: bytes, content: bytes) -> bytes:
    """Return a chunk: its length, its kind, and its content."""
    return np.array(len(content), "<u4").tobytes() + kind + content
