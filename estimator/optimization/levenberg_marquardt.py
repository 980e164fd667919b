"""The method of Levenberg and Marquardt: damped Gauss-Newton steps that decrease the cost.

References:
    Marquardt, "An algorithm for least-squares estimation of nonlinear parameters", SIAM J. 1963.
    Madsen, Nielsen, Tingleff, "Methods for non-linear least squares problems", 2004, section 3.2.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic

import numpy as np

from dronevio.estimator.optimization.gauss_newton import Factor
from dronevio.estimator.optimization.objective import Linearized, Objective, S, X
from dronevio.models.arrays import Array

INITIAL_DAMPING = 1e-4
"""Damping of the first step, relative to the diagonal of the information matrix."""
DAMPING_FACTOR = 10.0
"""Factor by which the damping grows after a step that is rejected, and shrinks after one that is accepted."""
MIN_DECREASE = 1e-3
"""Decrease of the cost, relative to the cost, below which a step is the last one."""


@dataclass(frozen=True, eq=False)
class Minimum(Generic[X, S]):
    """The result of the method."""

    x: X
    """Variables of the least cost."""
    equations: Linearized[X, S]
    """Normal equations at these variables."""
    steps: int
    """Number of steps that were tried."""
    rejected: int
    """Number of those that did not decrease the cost."""
    converged: bool
    """Whether the last step was short, and not the last one that was allowed."""


def levenberg_marquardt(
    objective: Objective[X, S], x: X, factorize: Callable[[Array], Factor], iterations: int
) -> Minimum[X, S]:
    """Minimize an objective.

    A step is accepted if it decreases the cost, before and after at the scales of the linearization that it follows
    from.

    Args:
        objective: What is minimized.
        x: Initial variables.
        factorize: Factorizes a damped information matrix.
        iterations: Largest number of steps.

    Raises:
        SingularError: A damped information matrix is singular, by the factorization.
    """
    equations, damping, rejected = objective.linearize(x), INITIAL_DAMPING, 0
    for step in range(1, iterations + 1):
        # A damped step, and the costs before and after
        damped = equations.H + damping * np.diag(np.diag(equations.H))
        delta = factorize(damped).solve(equations.b)
        candidate = equations.retract(delta)
        before, after = (objective.cost(each, equations.scales) for each in (x, candidate))
        if after < before:
            x, damping, decrease = candidate, damping / DAMPING_FACTOR, before - after
            equations = objective.linearize(x)
        else:  # of the quadratic model: where it is small, shorter steps do not help
            damping, rejected, decrease = damping * DAMPING_FACTOR, rejected + 1, 0.5 * float(equations.b @ delta)
        if decrease <= MIN_DECREASE * before:
            return Minimum(x, equations, step, rejected, converged=True)
    return Minimum(x, equations, iterations, rejected, converged=False)
