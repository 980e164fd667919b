"""Inverse of a function of one variable that increases up to a limit."""

from collections.abc import Callable

import numpy as np

from dronevio.models.arrays import Array

_ITERATIONS = 60  # Newton usually needs 4; bisection alone would need 52 for double precision
_CONVERGED = 1e-15  # step relative to the limit


def inverse(
    target: Array, function: Callable[[Array], Array], derivative: Callable[[Array], Array], limit: float
) -> Array:
    """Return the arguments (…) between 0 and a limit at which a function has given values (…); NaN where there is none.

    The solver is Newton's method, with a bisection step wherever it would leave the bracket: the function increases
    monotonically from 0, but possibly with a derivative near zero close to the limit.
    """
    low, high = np.zeros_like(target), np.full_like(target, limit)
    x = np.minimum(target, 0.5 * limit)
    for _ in range(_ITERATIONS):
        residual = function(x) - target
        low, high = np.where(residual < 0.0, x, low), np.where(residual > 0.0, x, high)
        slope = derivative(x)
        newton = x - residual / np.where(slope > 0.0, slope, np.nan)
        improved = np.where((newton >= low) & (newton <= high), newton, 0.5 * (low + high))
        step, x = np.abs(improved - x), improved
        if not np.any(step > _CONVERGED * limit):
            break
    return np.where(target < function(np.asarray(limit)), x, np.nan)
