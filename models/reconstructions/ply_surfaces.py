"""Point clouds with normals, and meshes, as binary PLY files, which MeshLab, CloudCompare and Blender open."""

from pathlib import Path

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.recordings.files import write_bytes
from dronevio.models.surfaces import Colours, Mesh, PointCloud

_VERTEX = np.dtype([("position", "<f4", 3), ("normal", "<f4", 3), ("colour", "u1", 3)])
_FACE = np.dtype([("count", "u1"), ("vertices", "<i4", 3)])


def write_cloud(path: Path, cloud: PointCloud) -> None:
    """Write a point cloud with its normals and colours.

    Args:
        path: The file to write.
        cloud: The points.

    Raises:
        InputError: The file cannot be written.
    """
    header = _header(len(cloud), 0)
    write_bytes(Path(path), header + _vertices(cloud.points, cloud.normals, cloud.colours))


def write_mesh(path: Path, mesh: Mesh) -> None:
    """Write a mesh with the normals and colours of its vertices.

    Args:
        path: The file to write.
        mesh: The mesh.

    Raises:
        InputError: The file cannot be written.
    """
    faces = np.empty(len(mesh.triangles), _FACE)
    faces["count"], faces["vertices"] = 3, mesh.triangles
    content = _vertices(mesh.vertices, mesh.normals, mesh.colours) + faces.tobytes()
    write_bytes(Path(path), _header(len(mesh.vertices), len(faces)) + content)


def _header(vertices: int, faces: int) -> bytes:
    """Return the header of a file."""
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {vertices}"]
    lines += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    lines += [f"property uchar {name}" for name in ("red", "green", "blue")]
    if faces:
        lines += [f"element face {faces}", "property list uchar int vertex_indices"]
    return "\n".join([*lines, "end_header\n"]).encode("ascii")


def _vertices(points: Array, normals: Array, colours: Colours) -> bytes:
    """Return the rows of the vertices."""
    rows = np.empty(len(points), _VERTEX)
    rows["position"], rows["normal"], rows["colour"] = points, normals, colours
    return rows.tobytes()
