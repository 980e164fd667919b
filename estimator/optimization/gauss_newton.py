"""Gauss-Newton steps: the minimum of the cost's quadratic model, taken without a test."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from dronevio.estimator.optimization.objective import Linearized, Objective, S, X
from dronevio.models.arrays import Array


class Factor(Protocol):
    """A factorization of the information matrix."""

    def solve(self, b: Array, /) -> Array:
        """Return H⁻¹ b."""


F = TypeVar("F", bound=Factor)


@dataclass(frozen=True, eq=False)
class Step(Generic[X, F]):
    """A Gauss-Newton step."""

    x: X
    """Variables after the step."""
    delta: Array
    """(n,) Step in the tangent space."""
    decrement: float
    """Squared length of the step in standard deviations, δᵀHδ: twice the decrease that the quadratic model predicts."""
    factor: F
    """Factorization of the information matrix before the step."""


def gauss_newton_step(equations: Linearized[X, S], factorize: Callable[[Array], F]) -> Step[X, F]:
    """Return one Gauss-Newton step.

    Args:
        equations: The normal equations at the variables before the step.
        factorize: Factorizes the information matrix.

    Raises:
        SingularError: The information matrix is singular, by the factorization.
    """
    factor = factorize(equations.H)
    delta = factor.solve(equations.b)
    return Step(equations.retract(delta), delta, float(equations.b @ delta), factor)


def gauss_newton(
    objective: Objective[X, S],
    x: X,
    factorize: Callable[[Array], F],
    iterations: int,
    is_last: Callable[[Step[X, F]], bool] = lambda step: False,
) -> Step[X, F]:
    """Return the last of several Gauss-Newton steps.

    Args:
        objective: What is minimized.
        x: Initial variables.
        factorize: Factorizes the information matrix.
        iterations: Largest number of steps, at least 1.
        is_last: Whether no step is needed after a given one.

    Raises:
        SingularError: An information matrix is singular, by the factorization.
    """
    step = gauss_newton_step(objective.linearize(x), factorize)
    for _ in range(iterations - 1):
        if is_last(step):
            break
        step = gauss_newton_step(objective.linearize(step.x), factorize)
    return step
