"""Dense linear algebra of the smoother: Cholesky factorization and the Schur complement."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from dronevio.models.arrays import Array

RELATIVE_DAMPING = 1e-12
"""Addition to the unit diagonal of a scaled information matrix, so that rounding errors do not make it indefinite."""


class SingularError(RuntimeError):
    """The linear system has no unique solution."""


class CholeskyFactor:
    """Cholesky factorization of a symmetric positive definite matrix that is scaled to a unit diagonal."""

    def __init__(self, H: Array) -> None:
        """Factorize a matrix.

        Args:
            H: (n, n) Symmetric matrix.

        Raises:
            SingularError: The matrix is not positive definite, or not finite.
        """
        diagonal = np.diag(H)
        if not np.isfinite(H).all():
            raise SingularError("the linear system is not finite")
        if not np.all(diagonal > 0.0):
            raise SingularError("a variable is unconstrained")
        self._scale = 1.0 / np.sqrt(diagonal)
        scaled = H * self._scale[:, None] * self._scale
        scaled[np.diag_indices_from(scaled)] += RELATIVE_DAMPING
        try:
            self._factor = cho_factor(scaled, lower=True, overwrite_a=True, check_finite=False)
        except LinAlgError as error:
            raise SingularError("the linear system is indefinite") from error

    def solve(self, b: Array) -> Array:
        """Return H⁻¹ b for b of shape (n,) or (n, m)."""
        scale = self._scale if b.ndim == 1 else self._scale[:, None]
        return np.asarray(scale * cho_solve(self._factor, scale * b, check_finite=False))

    def inverse_block(self, columns: npt.NDArray[np.int64]) -> Array:
        """Return the block of H⁻¹ at some rows and columns, the marginal covariance of these variables.

        Args:
            columns: (m,) Indices of the rows and columns.

        Returns:
            The block (m, m), exactly symmetric.
        """
        unit = np.zeros((len(self._scale), len(columns)))
        unit[columns, np.arange(len(columns))] = 1.0
        block = self.solve(unit)[columns]
        return np.asarray(0.5 * (block + block.T))


@dataclass(frozen=True, eq=False)
class LeastNormFactor:
    """A symmetric matrix that may be singular; solutions are those of the least norm."""

    H: Array
    """(n, n) Matrix of the linear system."""

    def solve(self, b: Array) -> Array:
        """Return H⁺ b for b of shape (n,)."""
        return np.asarray(np.linalg.lstsq(self.H, b, rcond=None)[0])


@dataclass(frozen=True, eq=False)
class LUFactor:
    """A matrix that is regular but need not be positive definite."""

    H: Array
    """(n, n) Matrix of the linear system."""

    def solve(self, b: Array) -> Array:
        """Return H⁻¹ b for b of shape (n,).

        Raises:
            SingularError: The matrix is singular.
        """
        try:
            return np.asarray(np.linalg.solve(self.H, b))
        except np.linalg.LinAlgError as error:
            raise SingularError("the linear system is singular") from error


def schur_complement(H: Array, b: Array, eliminated: npt.NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return the linear system that remains when some of n variables are marginalized.

    With s the variables that stay and m those that are eliminated, it is H_ss − H_sm H_mm⁻¹ H_ms and
    b_s − H_sm H_mm⁻¹ b_m.

    Args:
        H: (n, n) Information matrix.
        b: (n,) Right-hand side of H δ = b.
        eliminated: (n,) Whether a variable is marginalized.

    Returns:
        The information matrix and the right-hand side of the variables that stay.

    Raises:
        SingularError: The information on the eliminated variables is not positive definite.
    """
    kept = ~eliminated
    H_sm = H[np.ix_(kept, eliminated)]
    gain = CholeskyFactor(H[np.ix_(eliminated, eliminated)]).solve(H_sm.T).T
    reduced = H[np.ix_(kept, kept)] - gain @ H_sm.T
    return np.asarray(0.5 * (reduced + reduced.T)), np.asarray(b[kept] - gain @ b[eliminated])
