"""Double sphere (``ds``): a point is projected onto a sphere, onto a second one at a distance ξ, then to the image.

    u = (x, y) / (α |q| + (1 − α) q_z),   q = p + ξ |p| e_z

V. Usenko, N. Demmel, D. Cremers, "The double sphere camera model", 3DV 2018 (eqs. 40 to 52). The second half is the
unified model, `eucm` with β = 1. The field of view may exceed 90° from the axis.
"""

from collections.abc import Mapping

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.lenses import eucm
from dronevio.models.ranges import Range

COEFFICIENTS: Mapping[str, Range] = {"xi": Range(high=1.0, above=-1.0), "alpha": Range(0.0, 1.0)}
"""Names and ranges of the coefficients ξ and α."""
COUNTS: tuple[int, ...] = (2,)
"""Allowed numbers of coefficients."""


def central_scale(coefficients: tuple[float, ...]) -> float:
    """Return the radius in the image, in focal lengths, per radian from the optical axis, near the axis."""
    return 1.0 / (1.0 + coefficients[0])


def project(p_cam: Array, coefficients: tuple[float, ...]) -> Array:
    """Return image coordinates (…, 2), in focal lengths, of points (…, 3) in the camera frame.

    The result is NaN from the largest radius in the image on, or from the angle at which the radius is infinite.
    """
    xi, alpha = coefficients
    z = p_cam[..., 2:] + xi * np.linalg.norm(p_cam, axis=-1, keepdims=True)
    return eucm.project(np.concatenate([p_cam[..., :2], z], axis=-1), (alpha, 1.0))


def unproject(uv: Array, coefficients: tuple[float, ...]) -> Array:
    """Return the unit rays (…, 3) of image coordinates (…, 2), in focal lengths; NaN where there is none."""
    xi, alpha = coefficients
    return from_sphere(eucm.unproject(uv, (alpha, 1.0)), xi)


def from_sphere(q: Array, xi: float) -> Array:
    """Return the unit rays p (…, 3) whose p + ξ e_z have the directions q (…, 3), the farther ones; NaN without one."""
    z, square = q[..., 2:], np.sum(q * q, axis=-1, keepdims=True)
    discriminant = square - xi * xi * (square - z * z)
    root = np.sqrt(np.where(discriminant > 0.0, discriminant, np.nan))
    ray = q * ((xi * z + root) / square)
    return np.concatenate([ray[..., :2], ray[..., 2:] - xi], axis=-1)
