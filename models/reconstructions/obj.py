"""Meshes with the colours of their vertices as OBJ files (Wavefront), which nearly every program of 3D models reads.

The colour of a vertex follows its position, red, green and blue from 0 to 1, as MeshLab, CloudCompare and Blender read
it; other programs ignore it. Source: Wavefront, "Appendix B1. Object Files (.obj)", Advanced Visualizer manual, 1995.
"""

import io
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dronevio.models.recordings.files import write_bytes
from dronevio.models.surfaces import Mesh


def write_obj(path: Path, mesh: Mesh) -> None:
    """Write a mesh with the normals and colours of its vertices.

    Args:
        path: The file to write.
        mesh: The mesh.

    Raises:
        InputError: The file cannot be written.
    """
    corners = np.repeat(mesh.triangles + 1, 2, axis=1)  # a vertex and its normal have one number
    content = b"".join(
        [
            b"# Vertices: x y z red green blue\n",
            _lines("v" + 3 * " %.9g" + 3 * " %.5g", np.hstack([mesh.vertices, mesh.colours / 255.0])),
            _lines("vn" + 3 * " %.6g", mesh.normals),
            _lines("f" + 3 * " %d//%d", corners),
        ]
    )
    write_bytes(Path(path), content)


def _lines(form: str, values: npt.NDArray[np.generic]) -> bytes:
    """Return a line of text for each row of values (N, …)."""
    buffer = io.BytesIO()
    np.savetxt(buffer, values, fmt=form)
    return buffer.getvalue()
