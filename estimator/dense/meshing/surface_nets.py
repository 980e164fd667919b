"""Triangle mesh of the zero level of a signed distance function.

Each edge between two voxels of different sign is crossed by a quadrilateral, whose four vertices lie in the four cells
around the edge, each at the mean of the crossings of its cell's edges. Source: Gibson, "Constrained elastic surface
nets", MICCAI 1998, without the relaxation. Unlike marching cubes it needs no table of cases.
"""

import numpy as np
import numpy.typing as npt

from dronevio.estimator.dense.meshing.tsdf import BLOCK, Volume
from dronevio.models.arrays import Array, Floats

Indices = npt.NDArray[np.int64]

_MAX_DIFFERENCE = 1.0  # of the truncated distances of neighbouring voxels on either side of a surface


def surface_nets(volume: Volume) -> tuple[Array, Indices]:
    """Return the vertices (V, 3) and the triangles (F, 3) of the zero level of a volume.

    The triangles are counterclockwise as seen from the side where the distances are positive.
    """
    crossings, inward, axes = [], [], []
    for axis in range(3):
        voxels, share, is_inward = _crossed_edges(volume, axis)
        crossings.append(voxels + share[:, None] * np.eye(3)[axis])
        axes.append(np.full(len(voxels), axis))
        inward.append(is_inward)
    points, axis_of, is_inward = np.concatenate(crossings), np.concatenate(axes), np.concatenate(inward)
    if not len(points):
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    cells = _surrounding_cells(np.floor(points + 1e-9).astype(np.int64), axis_of)
    corner = cells.reshape(-1, 3)
    lowest = corner.min(axis=0)
    extent = tuple(corner.max(axis=0) - lowest + 1)
    _, vertex = np.unique(np.ravel_multi_index(tuple((corner - lowest).T), extent), return_inverse=True)
    count = np.bincount(vertex)
    repeated = np.repeat(points, 4, axis=0)
    vertices = np.stack([np.bincount(vertex, column) / count for column in repeated.T], axis=1) * volume.voxel
    quads = vertex.reshape(-1, 4)
    quads = np.where(is_inward[:, None], quads[:, ::-1], quads)
    return vertices, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int64)


def _crossed_edges(volume: Volume, axis: int) -> tuple[Indices, Array, npt.NDArray[np.bool_]]:
    """Return the edges along an axis between voxels of different sign.

    Returns:
        (E, 3) Coordinates of the first voxel; (E,) share of the edge before the crossing; (E,) True where the distance
        falls along the axis.
    """
    first = volume.distances
    second, second_weight = (_next(values, volume.blocks, axis) for values in (first, volume.weights))
    crossed = (first > 0.0) != (second > 0.0)
    crossed &= (volume.weights > 0.0) & (second_weight > 0.0) & (np.abs(first - second) < _MAX_DIFFERENCE)
    block, *inner = np.nonzero(crossed)
    a, b = first[crossed].astype(np.float64), second[crossed].astype(np.float64)
    share = np.clip(a / (a - b), 0.0, 1.0 - 1e-6)
    return volume.corners()[block] + np.stack(inner, axis=1), share, a > 0.0


def _next(values: Floats, blocks: Indices, axis: int) -> Floats:
    """Return the values (B, 8, 8, 8) of the next voxels along an axis; 0 beyond the last block."""
    step = np.zeros(3, np.int64)
    step[axis] = 1
    lowest = blocks.min(axis=0, initial=0)
    extent = tuple(blocks.max(axis=0, initial=0) - lowest + 2)
    keys = np.ravel_multi_index(tuple((blocks - lowest).T), extent)  # increasing, as the blocks are
    wanted = np.ravel_multi_index(tuple((blocks + step - lowest).T), extent)
    at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    is_there = keys[at] == wanted
    faces: Floats = np.take(values, 0, axis=axis + 1)
    face = np.where(is_there[:, None, None], faces[at], 0.0)
    rest = values.take(range(1, BLOCK), axis=axis + 1)
    return np.concatenate([rest, np.expand_dims(face, axis + 1)], axis=axis + 1).astype(np.float32)


def _surrounding_cells(voxels: Indices, axis: Indices) -> Indices:
    """Return the four cells (E, 4, 3) around edges, in the order of a rotation about the axis."""
    cells = np.repeat(voxels[:, None], 4, axis=1)
    second, third = (axis + 1) % 3, (axis + 2) % 3
    rows = np.arange(len(voxels))
    for k, (j, m) in enumerate(((0, 0), (-1, 0), (-1, -1), (0, -1))):
        cells[rows, k, second] += j
        cells[rows, k, third] += m
    return cells
