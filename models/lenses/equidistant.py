"""Equidistant fisheye lens: the distance from the principal point is a polynomial of the angle from the axis.

    θ_d = θ (1 + k₁ θ² + k₂ θ⁴ + k₃ θ⁶ + k₄ θ⁸)

J. Kannala, S. Brandt, "A generic camera model and calibration method", PAMI 2006 (eq. 6), without its asymmetric terms;
OpenCV's ``fisheye``, Kalibr's ``equidistant``. The field of view may exceed 90° from the axis; the model is valid up to
the first maximum of θ_d.
"""

from collections.abc import Mapping
from functools import lru_cache

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.lenses.monotone import inverse
from dronevio.models.ranges import FINITE, Range

Coefficients = tuple[float, ...]

COEFFICIENTS: Mapping[str, Range] = dict.fromkeys(("k1", "k2", "k3", "k4"), FINITE)
"""Names and ranges of the coefficients."""
COUNTS: tuple[int, ...] = (4,)
"""Allowed numbers of coefficients."""


@lru_cache(maxsize=64)
def valid_limit(coefficients: Coefficients) -> float:
    """Return the largest valid angle from the axis [rad]: that of the first maximum of θ_d, at most π."""
    k1, k2, k3, k4 = coefficients
    inverse_squares = np.roots([1.0, 3.0 * k1, 5.0 * k2, 7.0 * k3, 9.0 * k4])  # of dθ_d/dθ; well conditioned in 1 / θ²
    stationary = inverse_squares.real[np.abs(inverse_squares.imag) < 1e-9 * np.abs(inverse_squares)]
    nearest = stationary.max(initial=0.0)
    return float(min(1.0 / np.sqrt(nearest), np.pi)) if nearest > 0.0 else float(np.pi)


def central_scale(coefficients: Coefficients) -> float:
    """Return 1: near the axis, the image has the scale of the focal length."""
    return 1.0


def project(p_cam: Array, coefficients: Coefficients) -> Array:
    """Return image coordinates (…, 2), in focal lengths, of points (…, 3) in the camera frame.

    The result is NaN where the angle from the axis exceeds `valid_limit`, and at the camera centre itself.
    """
    xy = p_cam[..., :2]
    r = np.linalg.norm(xy, axis=-1, keepdims=True)
    theta = np.arctan2(r, p_cam[..., 2:])
    defined = (theta < valid_limit(coefficients)) & ((r > 0.0) | (p_cam[..., 2:] > 0.0))
    return np.asarray(xy * np.where(defined, _distorted(theta, coefficients) / np.where(r > 0.0, r, 1.0), np.nan))


def unproject(uv: Array, coefficients: Coefficients) -> Array:
    """Return the unit rays (…, 3) of image coordinates (…, 2), in focal lengths; NaN where there is none."""
    theta_d = np.linalg.norm(uv, axis=-1, keepdims=True)
    theta = inverse(
        theta_d,
        lambda t: _distorted(t, coefficients),
        lambda t: _derivative(t, coefficients),
        valid_limit(coefficients),
    )
    xy = uv * (np.sin(theta) / np.where(theta_d > 0.0, theta_d, 1.0))
    return np.concatenate([xy, np.cos(theta)], axis=-1)


def _distorted(theta: Array, coefficients: Coefficients) -> Array:
    """Return θ_d (…) of angles θ (…) from the axis [rad]."""
    k1, k2, k3, k4 = coefficients
    s = theta * theta
    return np.asarray(theta * (1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4)))))


def _derivative(theta: Array, coefficients: Coefficients) -> Array:
    """Return dθ_d/dθ (…) at angles θ (…) from the axis [rad]."""
    k1, k2, k3, k4 = coefficients
    s = theta * theta
    return np.asarray(1.0 + s * (3.0 * k1 + s * (5.0 * k2 + s * (7.0 * k3 + s * 9.0 * k4))))
