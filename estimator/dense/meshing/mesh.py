"""Mesh of the surfaces in a volume of signed distances, with the colours of a point cloud."""

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from dronevio.estimator.dense.meshing.surface_nets import surface_nets
from dronevio.estimator.dense.meshing.tsdf import Volume
from dronevio.models.arrays import Array
from dronevio.models.surfaces import Mesh, PointCloud

Indices = npt.NDArray[np.int64]


def build_mesh(volume: Volume, cloud: PointCloud, min_triangles: int) -> Mesh:
    """Return the mesh of the surfaces in a volume.

    Args:
        volume: Signed distances.
        cloud: Points from whose nearest the vertices take their colours.
        min_triangles: Smallest number of triangles of a connected part.
    """
    vertices, triangles = without_small_parts(*surface_nets(volume), min_triangles)
    normals = vertex_normals(vertices, triangles)
    colours = np.full((len(vertices), 3), 128, np.uint8)
    if len(vertices) and len(cloud):
        colours = cloud.colours[cKDTree(cloud.points).query(vertices)[1]]
    return Mesh(vertices, normals, colours, triangles)


def without_small_parts(vertices: Array, triangles: Indices, min_triangles: int) -> tuple[Array, Indices]:
    """Return a mesh without its connected parts of fewer triangles, and without vertices that it does not use."""
    if not len(triangles):
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    edges = triangles[:, [0, 1, 1, 2]].reshape(-1, 2)
    count = len(vertices)
    graph = coo_array((np.ones(len(edges), bool), (edges[:, 0], edges[:, 1])), shape=(count, count))
    _, part = connected_components(graph, directed=False)
    part_of_triangle = part[triangles[:, 0]]
    kept = triangles[np.bincount(part_of_triangle)[part_of_triangle] >= min_triangles]
    used, new = np.unique(kept, return_inverse=True)
    return vertices[used], new.reshape(-1, 3).astype(np.int64)


def vertex_normals(vertices: Array, triangles: Indices) -> Array:
    """Return the unit normals (V, 3) of vertices, the mean of those of their triangles weighted by area."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    face = np.cross(b - a, c - a)
    corner = triangles.T.ravel()
    total = np.stack([np.bincount(corner, np.tile(face[:, k], 3), len(vertices)) for k in range(3)], axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.asarray(total / np.maximum(length, np.finfo(float).tiny))
