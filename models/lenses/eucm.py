"""Extended unified camera model (``eucm``): a sphere or an ellipsoid, and a perspective centre inside it.

    u = (x, y) / (α d + (1 − α) z),   d² = β (x² + y²) + z²

B. Khomutenko, G. Garcia, P. Martinet, "An enhanced unified camera model", RA-L 2016. Projection, domain and inverse in
the notation of V. Usenko, N. Demmel, D. Cremers, "The double sphere camera model", 3DV 2018 (section II-C). With β = 1
it is the unified model; with α = 0 the pinhole. For α > 0 the field of view may exceed 90° from the axis.
"""

from collections.abc import Mapping

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.ranges import Range

COEFFICIENTS: Mapping[str, Range] = {"alpha": Range(0.0, 1.0), "beta": Range(1e-3, 1e3)}
"""Names and ranges of the coefficients α and β."""
COUNTS: tuple[int, ...] = (2,)
"""Allowed numbers of coefficients."""


def central_scale(coefficients: tuple[float, ...]) -> float:
    """Return 1: near the axis, the image has the scale of the focal length."""
    return 1.0


def project(p_cam: Array, coefficients: tuple[float, ...]) -> Array:
    """Return image coordinates (…, 2), in focal lengths, of points (…, 3) in the camera frame.

    The result is NaN from the largest radius in the image on, or from the angle at which the radius is infinite.
    """
    alpha, beta = coefficients
    xy, z = p_cam[..., :2], p_cam[..., 2:]
    d = np.sqrt(beta * np.sum(xy * xy, axis=-1, keepdims=True) + z * z)
    least = min(alpha, 1.0 - alpha) / max(alpha, 1.0 - alpha)
    return np.asarray(xy / np.where(z > -least * d, alpha * d + (1.0 - alpha) * z, np.nan))


def unproject(uv: Array, coefficients: tuple[float, ...]) -> Array:
    """Return the rays (…, 3) of image coordinates (…, 2), in focal lengths; NaN where there is none."""
    alpha, beta = coefficients
    s = beta * np.sum(uv * uv, axis=-1, keepdims=True)
    square = 1.0 - (2.0 * alpha - 1.0) * s
    root = np.sqrt(np.where(square > 0.0, square, np.nan))
    return np.concatenate([uv, (1.0 - alpha * alpha * s) / (alpha * root + 1.0 - alpha)], axis=-1)
