"""The equidistant lens, or fisheye: the distance from the principal point grows with the angle off the axis.

    θ_d = θ (1 + k₁ θ² + k₂ θ⁴ + k₃ θ⁶ + k₄ θ⁸)

J. Kannala, S. Brandt, "A generic camera model and calibration method", PAMI 2006 (eq. 6), without its asymmetric terms;
OpenCV's ``fisheye``, Kalibr's ``equidistant``. It sees beyond 90° off the axis, up to where θ_d stops growing.
"""

from functools import lru_cache

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Coefficients = tuple[float, float, float, float]

_ITERATIONS = 60  # bisection alone would need 52 for double precision; Newton mostly needs 4
_CONVERGED_RAD = 1e-15


@lru_cache(maxsize=64)
def reach(coefficients: Coefficients) -> float:
    """Return the angle off the axis up to which the lens is defined [rad]: where θ_d stops growing, π at most."""
    k1, k2, k3, k4 = coefficients
    inverse_squares = np.roots([1.0, 3.0 * k1, 5.0 * k2, 7.0 * k3, 9.0 * k4])  # of dθ_d/dθ, in 1 / θ²: never ill posed
    turns = inverse_squares.real[np.abs(inverse_squares.imag) < 1e-9 * np.abs(inverse_squares)]
    nearest = turns.max(initial=0.0)
    return float(min(1.0 / np.sqrt(nearest), np.pi)) if nearest > 0.0 else float(np.pi)


def project(p_cam: Array, coefficients: Coefficients) -> Array:
    """Return where points (…, 3) of the camera frame are imaged (…, 2), in focal lengths.

    NaN where a point is further off the axis than the lens's `reach`, or is the camera's centre itself.
    """
    xy = p_cam[..., :2]
    r = np.linalg.norm(xy, axis=-1, keepdims=True)
    theta = np.arctan2(r, p_cam[..., 2:])
    defined = (theta < reach(coefficients)) & ((r > 0.0) | (p_cam[..., 2:] > 0.0))
    return np.asarray(xy * np.where(defined, _bent(theta, coefficients) / np.where(r > 0.0, r, 1.0), np.nan))


def rays(uv: Array, coefficients: Coefficients) -> Array:
    """Return the unit rays (…, 3) that are imaged at points (…, 2), in focal lengths; NaN where there is none."""
    bent = np.linalg.norm(uv, axis=-1, keepdims=True)
    theta = _unbent(bent, coefficients)
    sideways = uv * (np.sin(theta) / np.where(bent > 0.0, bent, 1.0))
    return np.concatenate([sideways, np.cos(theta)], axis=-1)


def _bent(theta: Array, coefficients: Coefficients) -> Array:
    """Return θ_d of angles θ off the axis [rad]."""
    k1, k2, k3, k4 = coefficients
    s = theta * theta
    return np.asarray(theta * (1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4)))))


def _slope(theta: Array, coefficients: Coefficients) -> Array:
    """Return dθ_d/dθ."""
    k1, k2, k3, k4 = coefficients
    s = theta * theta
    return np.asarray(1.0 + s * (3.0 * k1 + s * (5.0 * k2 + s * (7.0 * k3 + s * 9.0 * k4))))


def _unbent(bent: Array, coefficients: Coefficients) -> Array:
    """Return the angles off the axis whose θ_d is given [rad], NaN where there is none.

    Newton's method, with a bisection wherever it would leave the bracket: θ_d grows all the way, but close to the
    lens's reach hardly.
    """
    limit = reach(coefficients)
    low, high = np.zeros_like(bent), np.full_like(bent, limit)
    theta = np.minimum(bent, 0.5 * limit)
    for _ in range(_ITERATIONS):
        residual = _bent(theta, coefficients) - bent
        low, high = np.where(residual < 0.0, theta, low), np.where(residual > 0.0, theta, high)
        slope = _slope(theta, coefficients)
        newton = theta - residual / np.where(slope > 0.0, slope, np.nan)
        better = np.where((newton >= low) & (newton <= high), newton, 0.5 * (low + high))
        moved, theta = np.abs(better - theta), better
        if not np.any(moved > _CONVERGED_RAD * limit):
            break
    return np.where(bent < _bent(np.asarray(limit), coefficients), theta, np.nan)
