"""Geometry of bearings, the unit vectors of pixels.

Bearings exist for every lens, also beyond 90° from the optical axis, where normalized coordinates do not.
"""

import numpy as np

from dronevio.models.arrays import Array


def tangent_bases(bearings: Array) -> Array:
    """Return two orthonormal vectors (…, 2, 3) orthogonal to each unit vector (…, 3)."""
    helper = np.where(np.abs(bearings[..., 2:]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    first = np.cross(helper, bearings)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(bearings, first)], axis=-2)


def angles_between_rad(a: Array, b: Array) -> Array:
    """Return the angles (…) between vectors (…, 3) of any length [rad]."""
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1)))


def midpoints(c0: Array, r0: Array, c1: Array, r1: Array) -> Array:
    """Return the midpoints (L, 3) of pairs of rays; NaN for parallel rays and for points behind a camera."""
    cosine = np.sum(r0 * r1, axis=1)
    between = c1 - c0
    d0, d1 = np.sum(between * r0, axis=1), np.sum(between * r1, axis=1)
    determinant = 1.0 - cosine**2
    with np.errstate(divide="ignore", invalid="ignore"):
        s0 = (d0 - cosine * d1) / determinant
        s1 = (cosine * d0 - d1) / determinant
    valid = (determinant > 1e-12) & (s0 > 0.0) & (s1 > 0.0)
    points = 0.5 * (c0 + s0[:, None] * r0 + c1 + s1[:, None] * r1)
    return np.where(valid[:, None], points, np.nan)
