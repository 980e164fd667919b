"""Rays of pixels, and the residual of a ray on the plane that touches the unit sphere at it.

The residual is defined for every lens, also beyond 90° from the optical axis, where normalized coordinates are not.
"""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def tangent_bases(bearings: Array) -> Array:
    """Return two orthonormal vectors (…, 2, 3) orthogonal to each unit vector (…, 3)."""
    helper = np.where(np.abs(bearings[..., 2:]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    first = np.cross(helper, bearings)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(bearings, first)], axis=-2)


def angles_rad(a: Array, b: Array) -> Array:
    """Return the angles (…) between vectors (…, 3) of any length [rad]."""
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1)))


def nearest_point(origins: Array, bearings: Array, weights: Array) -> Array:
    """Return the points (…, 3) nearest to bundles of V rays: the weighted least squares of the distances.

    Args:
        origins: (…, V, 3) Origins of the rays.
        bearings: (…, V, 3) Unit directions of the rays.
        weights: (…, V) Weights of the rays; zero excludes a ray.

    Returns:
        Points, NaN where the rays with a weight are parallel.
    """
    projectors = np.eye(3) - bearings[..., :, None] * bearings[..., None, :]
    A = np.einsum("...v,...vij->...ij", weights, projectors)
    b = np.einsum("...v,...vij,...vj->...i", weights, projectors, origins)
    determinant = np.linalg.det(A)
    is_defined = determinant > 1e-12 * np.maximum(np.trace(A, axis1=-2, axis2=-1), 1e-300) ** 3
    A = np.where(is_defined[..., None, None], A, np.eye(3))
    return np.where(is_defined[..., None], np.linalg.solve(A, b[..., None])[..., 0], np.nan)
