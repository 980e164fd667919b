"""Meshes as OBJ files (Wavefront), which nearly every program of 3D models reads.

A texture is a JPEG file beside the OBJ file, which a material file (MTL) names. Without one, the colour of a vertex
follows its position, red, green and blue from 0 to 1, as MeshLab, CloudCompare and Blender read it; other programs
ignore it. Source: Wavefront, "Appendix B1. Object Files (.obj)", Advanced Visualizer manual, 1995.
"""

import io
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dronevio.models.recordings.files import write_bytes
from dronevio.models.recordings.images import encode_jpeg
from dronevio.models.surfaces import Mesh

_QUALITY = 92  # of the JPEG image of a texture


def write_obj(path: Path, mesh: Mesh) -> None:
    """Write a mesh with the normals of its vertices, and its texture or the colours of the vertices.

    Args:
        path: The file to write; the texture of ``mesh.obj`` is in ``mesh-texture.jpg``, its material in ``mesh.mtl``.
        mesh: The mesh.

    Raises:
        InputError: A file cannot be written.
    """
    path, texture = Path(path), mesh.texture
    normals = _lines("vn" + 3 * " %.6g", mesh.normals)
    if texture is None:
        corners = np.repeat(mesh.triangles + 1, 2, axis=1)  # a vertex and its normal have one number
        parts = [
            b"# Vertices: x y z red green blue\n",
            _lines("v" + 3 * " %.9g" + 3 * " %.5g", np.hstack([mesh.vertices, mesh.colours / 255.0])),
            normals,
            _lines("f" + 3 * " %d//%d", corners),
        ]
    else:
        corners = np.stack([mesh.triangles, texture.triangles, mesh.triangles], axis=2).reshape(-1, 9) + 1
        coordinates = texture.coordinates() * [1.0, -1.0] + [0.0, 1.0]  # of which the second grows upwards
        parts = [
            f"mtllib {path.stem}.mtl\nusemtl texture\n".encode(),
            _lines("v" + 3 * " %.9g", mesh.vertices),
            _lines("vt" + 2 * " %.7g", coordinates),
            normals,
            _lines("f" + 3 * " %d/%d/%d", corners),
        ]
        image = f"{path.stem}-texture.jpg"  # `mesh.jpg` is a picture of the report
        material = f"newmtl texture\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {image}\n"
        write_bytes(path.with_suffix(".mtl"), material.encode())
        write_bytes(path.with_name(image), encode_jpeg(texture.image, _QUALITY))
    write_bytes(path, b"".join(parts))


def _lines(form: str, values: npt.NDArray[np.generic]) -> bytes:
    """Return a line of text for each row of values (N, …)."""
    buffer = io.BytesIO()
    np.savetxt(buffer, values, fmt=form)
    return buffer.getvalue()
