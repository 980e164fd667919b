"""Fisheye with one coefficient (``fov``): the distance from the principal point is proportional to an angle.

    r_d = arctan(2 r tan(w / 2)) / w,   r at depth 1

F. Devernay, O. Faugeras, "Straight lines have to be straight", Machine Vision and Applications 2001 (eqs. 13 and 14);
Kalibr's ``fov``, COLMAP's ``FOV``. The field of view is below 90° from the axis.
"""

from collections.abc import Mapping

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.ranges import Range

COEFFICIENTS: Mapping[str, Range] = {"w": Range(1e-6, 3.14)}
"""Name and range of the coefficient w, the field of view of an ideal fisheye [rad]."""
COUNTS: tuple[int, ...] = (1,)
"""Allowed numbers of coefficients."""


def central_scale(coefficients: tuple[float, ...]) -> float:
    """Return the radius in the image, in focal lengths, per radian from the optical axis, near the axis."""
    return 2.0 * float(np.tan(0.5 * coefficients[0])) / coefficients[0]


def project(p_cam: Array, coefficients: tuple[float, ...]) -> Array:
    """Return image coordinates (…, 2), in focal lengths, of points (…, 3); NaN where they are not in front."""
    (w,) = coefficients
    xy, z = p_cam[..., :2], np.where(p_cam[..., 2:] > 0.0, p_cam[..., 2:], np.nan)
    scaled = 2.0 * np.tan(0.5 * w) * np.linalg.norm(xy, axis=-1, keepdims=True)
    return np.asarray(xy * (2.0 * np.tan(0.5 * w) / w * _ratio(np.arctan2(scaled, z), scaled, 1.0 / z)))


def unproject(uv: Array, coefficients: tuple[float, ...]) -> Array:
    """Return the rays (…, 3) of image coordinates (…, 2), in focal lengths; NaN where there is none."""
    (w,) = coefficients
    angle = w * np.linalg.norm(uv, axis=-1, keepdims=True)
    angle = np.where(angle < 0.5 * np.pi, angle, np.nan)
    xy = uv * (w * _ratio(np.sin(angle), angle, 1.0))
    return np.concatenate([xy, 2.0 * np.tan(0.5 * w) * np.cos(angle)], axis=-1)


def _ratio(numerator: Array, denominator: Array, at_zero: Array | float) -> Array:
    """Return a quotient, and its limit where the denominator is zero."""
    is_zero = denominator == 0.0
    return np.where(is_zero, at_zero, numerator / np.where(is_zero, 1.0, denominator))
