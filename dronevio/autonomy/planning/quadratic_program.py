"""Convex quadratic programs with two-sided bounds, by a primal-dual interior-point method.

Source: Mehrotra, "On the implementation of a primal-dual interior point method", 1992; Nocedal and Wright, "Numerical
Optimization", 2006, algorithm 16.4.
"""

import numpy as np

from dronevio.models.arrays import Array

_ITERATIONS = 40  # about 10 suffice where there is a solution
_CONTRADICTION = 1e10  # multiplier, relative to the scale of the matrix, that only grows without a feasible point
_TO_BOUNDARY = 0.99  # fraction of the step to the boundary


def bounded_minimum(
    hessian: Array, gradient: Array, rows: Array, low: Array, high: Array, tolerance: float
) -> Array | None:
    """Return the minimizers (N, D) of D programs ½ xᵀ H x + gᵀ x subject to low ≤ A x ≤ high, or None.

    Args:
        hessian: (N, N) Positive definite matrix H.
        gradient: (N, D) Vectors g.
        rows: (M, N) Matrix A.
        low: (M, D) Lower bounds.
        high: (M, D) Upper bounds, above the lower ones.
        tolerance: Largest violation of a bound.

    Returns:
        The minimizers; None if one of the programs has no feasible point, or none was found.
    """
    free = np.linalg.solve(hessian, -gradient)
    values = rows @ free
    bound = np.flatnonzero(np.any((values < low) | (values > high), axis=0))
    if len(bound):
        found = _interior_point(
            hessian, gradient.T[bound], np.vstack([rows, -rows]), np.vstack([low, -high]).T[bound], tolerance
        )
        if found is None:
            return None
        free[:, bound] = found.T
    return np.asarray(free)


def _interior_point(hessian: Array, gradient: Array, rows: Array, low: Array, tolerance: float) -> Array | None:
    """Return the minimizers (D, N) for gradients (D, N) and lower bounds (D, M) of all values of rows (M, N)."""
    scale = np.trace(hessian) / len(hessian)
    hessian, gradient = hessian / scale, gradient / scale
    x = np.linalg.solve(hessian, -gradient.T).T
    slack = np.maximum(np.abs(x @ rows.T - low), 0.1)
    dual = np.ones_like(slack)
    for _ in range(_ITERATIONS):
        unstationary = x @ hessian + gradient - dual @ rows
        short = x @ rows.T - slack - low
        gap = np.mean(slack * dual, axis=1, keepdims=True)
        if max(np.abs(short).max(), gap.max()) < tolerance and np.abs(unstationary).max() < tolerance:
            return np.asarray(x)
        if dual.max() > _CONTRADICTION:
            return None
        system = hessian + rows.T @ ((dual / slack)[..., None] * rows)
        centring = -slack * dual
        for corrector in (False, True):
            right = (centring - dual * short) / slack @ rows - unstationary
            step = np.linalg.solve(system, right[..., None])[..., 0]
            slack_step = step @ rows.T + short
            dual_step = (centring - dual * slack_step) / slack
            length = np.minimum(_to_boundary(slack, slack_step), _to_boundary(dual, dual_step))
            if not corrector:
                predicted = np.mean((slack + length * slack_step) * (dual + length * dual_step), axis=1, keepdims=True)
                centring = (predicted / gap) ** 3 * gap - slack * dual - slack_step * dual_step
        x = x + _TO_BOUNDARY * length * step
        slack = slack + _TO_BOUNDARY * length * slack_step
        dual = dual + _TO_BOUNDARY * length * dual_step
    return None


def _to_boundary(values: Array, steps: Array) -> Array:
    """Return the largest lengths (D, 1) up to 1 of steps (D, M) for which positive values (D, M) stay positive."""
    shares = np.where(steps < 0.0, -values / np.minimum(steps, -1e-30), np.inf)
    return np.asarray(np.minimum(shares.min(axis=1, keepdims=True), 1.0))
