"""Orientations of the large surfaces of a scene, from the points of a reconstruction.

A plane sweep along the normal of a floor or a wall matches windows that are parallel to it. Source: Gallup et al.,
"Real-time plane-sweeping stereo with multiple sweeping directions", CVPR 2007.
"""

import numpy as np
from scipy.spatial import cKDTree

from dronevio.models.arrays import Array

_NEIGHBOURS = 12  # points of the plane through a point
_MAX_FLATNESS = 0.15  # ratio of the two smallest standard deviations of a planar neighbourhood
_SAME_DIRECTION = np.cos(np.radians(10.0))
_OTHER_DIRECTION = np.cos(np.radians(25.0))
_MIN_SHARE = 0.04  # of the planar points, that a direction explains
_MAX_CANDIDATES = 2000


def dominant_normals(points: Array, count: int) -> Array:
    """Return the normals (D, 3) of the most frequent surface orientations, D ≤ count, the most frequent first.

    Args:
        points: (N, 3) Points on the surfaces.
        count: Largest number of normals. Opposite normals count as one.
    """
    if len(points) <= _NEIGHBOURS or count < 1:
        return np.zeros((0, 3))
    _, nearest = cKDTree(points).query(points, k=_NEIGHBOURS)
    patches = points[nearest] - points[nearest].mean(axis=1, keepdims=True)
    _, deviations, axes = np.linalg.svd(patches, full_matrices=False)
    planar = deviations[:, 2] < _MAX_FLATNESS * deviations[:, 1]
    normals = axes[planar, 2]
    normals = normals[:: max(1, len(normals) // _MAX_CANDIDATES)]
    dominant: list[Array] = []
    total = len(normals)
    while len(dominant) < count and len(normals):
        alignment = np.abs(normals @ normals.T)
        support = np.count_nonzero(alignment > _SAME_DIRECTION, axis=1)
        best = int(np.argmax(support))
        if support[best] < _MIN_SHARE * total:
            break
        similar = normals[alignment[best] > _SAME_DIRECTION]
        dominant.append(np.linalg.svd(similar, full_matrices=False)[2][0])  # mean direction without signs
        normals = normals[np.abs(normals @ dominant[-1]) < _OTHER_DIRECTION]
    return np.array(dominant).reshape(-1, 3)
