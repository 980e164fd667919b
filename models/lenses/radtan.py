"""Pinhole with radial-tangential distortion (Brown 1966; OpenCV's, ROS' and Kalibr's ``radtan``).

    d(x) = g(r) x + r² p + 2 (x·p) x,   x at depth 1, r = |x|, p = (p₂, p₁)
    g(r) = (1 + k₁ r² + k₂ r⁴ + k₃ r⁶) / (1 + k₄ r² + k₅ r⁴ + k₆ r⁶)

The coefficients have OpenCV's order k₁, k₂, p₁, p₂, k₃, k₄, k₅, k₆; without the last four or three, these are zero.
With eight this is the rational model (D. Claus, A. Fitzgibbon, "A rational function lens distortion model for general
cameras", CVPR 2005, and OpenCV's ``CALIB_RATIONAL_MODEL``).

The Jacobian of d is symmetric, so d is the gradient of a potential, and on a disc where the Jacobian is positive
definite d is injective. Outside that disc d may map several points to one, and the model is not valid there.
"""

from collections.abc import Mapping
from functools import lru_cache

import numpy as np
from numpy.polynomial import polynomial

from dronevio.models.arrays import Array
from dronevio.models.lenses.monotone import inverse
from dronevio.models.ranges import FINITE, Range

Coefficients = tuple[float, ...]

COEFFICIENTS: Mapping[str, Range] = dict.fromkeys(("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), FINITE)
"""Names and ranges of the coefficients."""
COUNTS: tuple[int, ...] = (4, 5, 8)
"""Allowed numbers of coefficients."""

_ITERATIONS = 40  # Newton needs 4 inside the image of EuRoC's camera, and more only far outside
_CONVERGED = 1e-13  # largest residual in focal lengths
_SOLVED = 1e-11  # a larger residual after the last iteration belongs to a point without a ray
_LEAST_INVERSE = 1e-100  # inverse of a radius that no image has, whose square is still a number
_INSIDE = 1.0 - 1e-12  # keeps Newton inside the circle on which the Jacobian may be singular


@lru_cache(maxsize=64)
def valid_limit(coefficients: Coefficients) -> float:
    """Return the largest valid radius at depth 1; inf if the model is valid everywhere.

    In the basis of the radial direction and its normal, the Jacobian of the radial part has the eigenvalues
    a = d(r g)/dr and b = g, and that of the tangential part is bounded below by −6 r |p|. Therefore
    min(a, b) − 6 r |p| > 0 is sufficient, as long as the denominator of g is positive.
    """
    k1, k2, p1, p2, k3, k4, k5, k6 = (*coefficients, *(8 - len(coefficients)) * (0.0,))
    numerator, denominator = np.array([1.0, 0.0, k1, 0.0, k2, 0.0, k3]), np.array([1.0, 0.0, k4, 0.0, k5, 0.0, k6])
    if not any((k4, k5, k6)):
        denominator = np.ones(1)
    tangential = np.array([0.0, -6.0 * np.hypot(p1, p2)])
    powers = np.arange(len(numerator))
    # r g′ times the square of the denominator; r times a derivative multiplies each coefficient by its power.
    slope = polynomial.polysub(
        polynomial.polymul(powers * numerator, denominator),
        polynomial.polymul(numerator, np.arange(len(denominator)) * denominator),
    )
    b = polynomial.polymul(numerator, denominator)
    bound = polynomial.polymul(tangential, polynomial.polymul(denominator, denominator))
    positive = [polynomial.polyadd(polynomial.polyadd(b, slope), bound), polynomial.polyadd(b, bound), denominator]
    inverse_radii = np.concatenate([np.roots(p) for p in positive])  # well conditioned in 1 / r
    roots = inverse_radii.real[np.abs(inverse_radii.imag) < 1e-9 * np.abs(inverse_radii)]
    nearest = roots.max(initial=0.0)
    return float(1.0 / nearest) if nearest > _LEAST_INVERSE else np.inf


def central_scale(coefficients: Coefficients) -> float:
    """Return 1: near the axis, the image has the scale of the focal length."""
    return 1.0


def project(p_cam: Array, coefficients: Coefficients) -> Array:
    """Return image coordinates (…, 2), in focal lengths, of points (…, 3) in the camera frame.

    The result is NaN where a point is not in front of the camera, or is beyond `valid_limit`.
    """
    z = np.where(p_cam[..., 2:] > 0.0, p_cam[..., 2:], np.nan)
    xy = p_cam[..., :2] / z
    defined = np.hypot(xy[..., :1], xy[..., 1:]) < valid_limit(coefficients)
    return distort(np.where(defined, xy, np.nan), coefficients)


def unproject(uv: Array, coefficients: Coefficients) -> Array:
    """Return the rays (…, 3), of depth 1, of image coordinates (…, 2), in focal lengths.

    The solver is Newton's method, starting at the image coordinates, and where this fails, without tangential
    distortion. The result is NaN where no ray within `valid_limit` has that image.
    """
    x, y = u, v = uv[..., 0], uv[..., 1]
    if any(coefficients):
        x, y = _solved(u, v, u, v, coefficients)
        failed = np.isnan(x) & np.isfinite(u) & np.isfinite(v)
        if np.any(failed):
            x, y = np.array(x), np.array(y)
            u, v = u[failed], v[failed]
            x[failed], y[failed] = _solved(u, v, *_without_tangential(u, v, coefficients), coefficients)
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def _solved(u: Array, v: Array, x: Array, y: Array, coefficients: Coefficients) -> tuple[Array, Array]:
    """Return the points (…) at depth 1 with the image (u, v), by Newton's method from (x, y); NaN where it fails."""
    limit = valid_limit(coefficients) * _INSIDE
    for _ in range(_ITERATIONS):
        terms = _terms(x, y, coefficients)
        du, dv = (image - target for image, target in zip(_image(x, y, terms, coefficients), (u, v), strict=True))
        if not np.any((np.abs(du) > _CONVERGED) | (np.abs(dv) > _CONVERGED)):
            break
        xx, off, yy = _derivatives(x, y, terms, coefficients)
        det = xx * yy - off * off
        x, y = _within(x - (yy * du - off * dv) / det, y - (xx * dv - off * du) / det, limit)
    else:
        image = _image(x, y, _terms(x, y, coefficients), coefficients)
        du, dv = image[0] - u, image[1] - v
    unsolved = ~(np.maximum(np.abs(du), np.abs(dv)) <= _SOLVED)
    return np.where(unsolved, np.nan, x), np.where(unsolved, np.nan, y)


def _without_tangential(u: Array, v: Array, coefficients: Coefficients) -> tuple[Array, Array]:
    """Return the points (N,) at depth 1 with the image (u, v) without tangential distortion, at the limit if beyond."""
    radial, limit = (*coefficients[:2], 0.0, 0.0, *coefficients[4:]), valid_limit(coefficients) * _INSIDE
    last = float(np.arctan(limit))  # the angle from the axis, which is finite, replaces the radius

    def image(angle: Array) -> Array:
        r = np.tan(angle)
        return np.asarray(r * _terms(r, np.zeros_like(r), radial)[1])

    def slope(angle: Array) -> Array:
        r = np.tan(angle)
        zero = np.zeros_like(r)
        return np.asarray(_derivatives(r, zero, _terms(r, zero, radial), radial)[0] * (1.0 + r * r))

    r_d = np.hypot(u, v)
    angle = inverse(r_d, image, slope, last)
    factor = np.tan(np.where(np.isnan(angle), last, angle)) / np.where(r_d > 0.0, r_d, 1.0)
    return u * factor, v * factor


def distort(xy: Array, coefficients: Coefficients) -> Array:
    """Return d(x) (…, 2) of points x (…, 2) at depth 1, also outside the valid domain."""
    x, y = xy[..., 0], xy[..., 1]
    return np.stack(_image(x, y, _terms(x, y, coefficients), coefficients), axis=-1)


def jacobian(xy: Array, coefficients: Coefficients) -> Array:
    """Return ∂d/∂x (…, 2, 2) at points x (…, 2) at depth 1."""
    x, y = xy[..., 0], xy[..., 1]
    xx, off, yy = _derivatives(x, y, _terms(x, y, coefficients), coefficients)
    return np.stack([np.stack([xx, off], axis=-1), np.stack([off, yy], axis=-1)], axis=-2)


def _terms(x: Array, y: Array, coefficients: Coefficients) -> tuple[Array, Array]:
    """Return r² and g (…) at points (x, y) at depth 1."""
    k1, k2, _, _, *higher = coefficients
    r2 = x * x + y * y
    if not higher:
        return r2, 1.0 + r2 * (k1 + r2 * k2)
    k3, k4, k5, k6 = _padded(higher)
    return r2, (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))


def _slope(terms: tuple[Array, Array], coefficients: Coefficients) -> Array:
    """Return 2 dg / d(r²) (…), given the terms of a point: ∂g/∂x is x times it."""
    (k1, k2, _, _, *higher), (r2, radial) = coefficients, terms
    if not higher:
        return np.asarray(2.0 * (k1 + 2.0 * k2 * r2))
    k3, k4, k5, k6 = _padded(higher)
    numerator = k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3)
    denominator = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
    return np.asarray(2.0 * (numerator - radial * (k4 + r2 * (2.0 * k5 + 3.0 * r2 * k6))) / denominator)


def _padded(higher: list[float]) -> tuple[float, ...]:
    """Return k₃ to k₆ of the coefficients after the fourth."""
    return (*higher, *(4 - len(higher)) * (0.0,))


def _image(x: Array, y: Array, terms: tuple[Array, Array], coefficients: Coefficients) -> tuple[Array, Array]:
    """Return the two components of d (…) at points (x, y) at depth 1, given their terms."""
    (_, _, p1, p2, *_), (r2, radial) = coefficients, terms
    return (
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
    )


def _derivatives(
    x: Array, y: Array, terms: tuple[Array, Array], coefficients: Coefficients
) -> tuple[Array, Array, Array]:
    """Return ∂d₁/∂x₁, ∂d₁/∂x₂ = ∂d₂/∂x₁ and ∂d₂/∂x₂ (…) at points (x, y) at depth 1, given their terms."""
    (_, _, p1, p2, *_), (_, radial), d_radial = coefficients, terms, _slope(terms, coefficients)
    off = x * y * d_radial + 2.0 * p1 * x + 2.0 * p2 * y
    xx = radial + x * x * d_radial + 2.0 * p1 * y + 6.0 * p2 * x
    yy = radial + y * y * d_radial + 6.0 * p1 * y + 2.0 * p2 * x
    return xx, off, yy


def _within(x: Array, y: Array, limit: float) -> tuple[Array, Array]:
    """Return points (x, y) with those beyond a radius projected onto the circle of that radius."""
    if limit == np.inf or not np.any((r2 := x * x + y * y) > limit * limit):
        return x, y
    factor = np.minimum(1.0, limit / np.maximum(np.sqrt(r2), np.finfo(float).tiny))
    return x * factor, y * factor
