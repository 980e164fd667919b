"""The radial-tangential lens: a pinhole whose image is bent a little (Brown 1966; OpenCV's and Kalibr's ``radtan``).

    d(x) = (1 + k₁ r² + k₂ r⁴) x + r² p + 2 (x·p) x,   x at depth 1, r = |x|, p = (p₂, p₁)

Its Jacobian is symmetric, so d is the gradient of a potential, and wherever the Jacobian is positive definite on a disc
no two points of the disc share an image. Beyond that disc d may fold back: there the lens is not defined.
"""

from functools import lru_cache

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Coefficients = tuple[float, float, float, float]

_ITERATIONS = 40  # Newton: EuRoC's lens needs 4 inside its image, and more only far outside
_CONVERGED = 1e-13  # of the image plane, in focal lengths
_SOLVED = 1e-11  # a residual above it, once Newton stands still, belongs to a point without a ray
_INSIDE = 1.0 - 1e-12  # keeps Newton off the circle on which the Jacobian may be singular


@lru_cache(maxsize=64)
def reach(coefficients: Coefficients) -> float:
    """Return the radius at depth 1 up to which the lens is defined; inf where it never folds.

    In the basis of the radial direction and its normal the radial part has the eigenvalues a = 1 + 3 k₁ r² + 5 k₂ r⁴
    and b = 1 + k₁ r² + k₂ r⁴, and the tangential part is −6 r |p| at least; so min(a, b) − 6 r |p| > 0 suffices.
    """
    k1, k2, p1, p2 = coefficients
    bend = -6.0 * np.hypot(p1, p2)
    inverse_radii = np.concatenate(
        [
            np.roots([1.0, bend, 3.0 * k1, 0.0, 5.0 * k2]),
            np.roots([1.0, bend, k1, 0.0, k2]),
        ]  # in 1 / r: never ill posed
    )
    folds = inverse_radii.real[np.abs(inverse_radii.imag) < 1e-9 * np.abs(inverse_radii)]
    nearest = folds.max(initial=0.0)
    return float(1.0 / nearest) if nearest > 0.0 else np.inf


def project(p_cam: Array, coefficients: Coefficients) -> Array:
    """Return where points (…, 3) of the camera frame are imaged (…, 2), in focal lengths.

    NaN where a point is not in front of the camera or beyond the lens's `reach`.
    """
    z = np.where(p_cam[..., 2:] > 0.0, p_cam[..., 2:], np.nan)
    xy = p_cam[..., :2] / z
    defined = np.sum(xy * xy, axis=-1, keepdims=True) < reach(coefficients) ** 2
    return distort(np.where(defined, xy, np.nan), coefficients)


def rays(uv: Array, coefficients: Coefficients) -> Array:
    """Return the rays (…, 3), of depth 1, that are imaged at points (…, 2), in focal lengths.

    Newton's method, from the point itself. NaN where no ray within the lens's `reach` is imaged.
    """
    xy = uv.copy()
    if any(coefficients):
        limit = reach(coefficients) * _INSIDE
        for _ in range(_ITERATIONS):
            residual = distort(xy, coefficients) - uv
            if not np.any(np.abs(residual) > _CONVERGED):
                break
            J = jacobian(xy, coefficients)
            det = J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0]
            dx = (J[..., 1, 1] * residual[..., 0] - J[..., 0, 1] * residual[..., 1]) / det
            dy = (J[..., 0, 0] * residual[..., 1] - J[..., 1, 0] * residual[..., 0]) / det
            xy = _within(xy - np.stack([dx, dy], axis=-1), limit)
        unsolved = np.abs(distort(xy, coefficients) - uv).max(axis=-1, keepdims=True) > _SOLVED
        xy = np.where(unsolved, np.nan, xy)
    return np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1)


def distort(xy: Array, coefficients: Coefficients) -> Array:
    """Return d(x) (…, 2) of points x (…, 2) at depth 1, wherever they are."""
    k1, k2, p1, p2 = coefficients
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * k2)
    return np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=-1,
    )


def jacobian(xy: Array, coefficients: Coefficients) -> Array:
    """Return ∂d/∂x (…, 2, 2) at points x (…, 2) at depth 1."""
    k1, k2, p1, p2 = coefficients
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * k2)
    d_radial = 2.0 * (k1 + 2.0 * k2 * r2)  # ∂radial/∂x = x · d_radial
    off = x * y * d_radial + 2.0 * p1 * x + 2.0 * p2 * y
    xx = radial + x * x * d_radial + 2.0 * p1 * y + 6.0 * p2 * x
    yy = radial + y * y * d_radial + 6.0 * p1 * y + 2.0 * p2 * x
    return np.stack([np.stack([xx, off], axis=-1), np.stack([off, yy], axis=-1)], axis=-2)


def _within(xy: Array, limit: float) -> Array:
    """Return points (…, 2), those beyond a radius moved onto it."""
    if np.isinf(limit):
        return xy
    r = np.linalg.norm(xy, axis=-1, keepdims=True)
    return np.asarray(xy * np.minimum(1.0, limit / np.maximum(r, np.finfo(float).tiny)))
