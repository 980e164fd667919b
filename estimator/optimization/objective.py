"""A robust nonlinear least-squares problem on a manifold.

The cost of variables x is Σ ρ(‖r(x)‖²; s) / 2, where ρ is a robust loss and s are its scales: variances, thresholds,
and which observations count. The scales may follow from the residuals, as with a threshold that grows with their
median. Then they are data of the linearization, not variables: costs are only comparable at the same scales, and the
right-hand side b of the normal equations H δ = b is the negative gradient of the cost at fixed scales.

References:
    Triggs, McLauchlan, Hartley, Fitzgibbon, "Bundle adjustment: a modern synthesis", 2000, sections 3 and 4.
"""

from typing import Protocol, TypeVar

from dronevio.models.arrays import Array

X = TypeVar("X")
X_co = TypeVar("X_co", covariant=True)
S = TypeVar("S")
S_co = TypeVar("S_co", covariant=True)


class Linearized(Protocol[X_co, S_co]):
    """The normal equations H δ = b of a problem at some value of its variables."""

    @property
    def H(self) -> Array:
        """(n, n) Information matrix: JᵀWJ."""

    @property
    def b(self) -> Array:
        """(n,) Right-hand side: −JᵀWr, the negative gradient of the cost at `scales`."""

    @property
    def scales(self) -> S_co:
        """Scales of the robust loss that the weights W belong to."""

    def retract(self, delta: Array) -> X_co:
        """Return the variables after a step (n,), those included that were eliminated from the equations."""


class Objective(Protocol[X, S]):
    """What is minimized."""

    def linearize(self, x: X, /) -> Linearized[X, S]:
        """Return the normal equations at some variables, with the scales that belong to them."""

    def cost(self, x: X, scales: S, /) -> float:
        """Return the negative logarithm of the density of some variables at given scales, up to a constant."""
