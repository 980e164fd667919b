"""The marginal prior: what keyframes and landmarks that left the window still say of those that stay.

It is a Gaussian about the values at which its variables were first linearized (Sibley, Matthies, Sukhatme, "Sliding
window filter with application to planetary landing", JFR 2010; Leutenegger et al., IJRR 2015).
"""

import numpy as np
import numpy.typing as npt
from scipy.linalg import LinAlgError, cho_factor, cho_solve

Array = npt.NDArray[np.float64]

RELATIVE_DAMPING = 1e-12
"""What is added to a scaled information matrix, whose diagonal is 1: rounding errors must not make it indefinite."""


class SingularError(RuntimeError):
    """The linear system has no unique solution."""


class CholeskyFactor:
    """A symmetric positive definite matrix, scaled to a diagonal of ones and factorized."""

    def __init__(self, H: Array) -> None:
        """Factorize H (n, n).

        Raises:
            SingularError: It is not positive definite.
        """
        diagonal = np.diag(H)
        if not np.all(diagonal > 0.0) or not np.isfinite(H).all():
            raise SingularError("a variable that nothing holds")
        self._scale = 1.0 / np.sqrt(diagonal)
        scaled = H * self._scale[:, None] * self._scale
        scaled[np.diag_indices_from(scaled)] += RELATIVE_DAMPING
        try:
            self._factor = cho_factor(scaled, lower=True, overwrite_a=True, check_finite=False)
        except LinAlgError as error:
            raise SingularError("an indefinite linear system") from error

    def solve(self, b: Array) -> Array:
        """Return H⁻¹ b for b (n,) or (n, m)."""
        scale = self._scale if b.ndim == 1 else self._scale[:, None]
        return np.asarray(scale * cho_solve(self._factor, scale * b, check_finite=False))

    def inverse_block(self, columns: npt.NDArray[np.int64]) -> Array:
        """Return the block of H⁻¹ at some rows and columns: their covariance."""
        unit = np.zeros((len(self._scale), len(columns)))
        unit[columns, np.arange(len(columns))] = 1.0
        block = self.solve(unit)[columns]
        return np.asarray(0.5 * (block + block.T))


def schur_complement(H: Array, b: Array, leaving: npt.NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return the information and right side that are left when some of n variables are marginalized.

    Args:
        H: (n, n) Information.
        b: (n,) Right side of H δ = b.
        leaving: (n,) Whose variables go.

    Raises:
        SingularError: Those that leave are not determined.
    """
    stays = ~leaving
    across = H[np.ix_(stays, leaving)]
    gain = CholeskyFactor(H[np.ix_(leaving, leaving)]).solve(across.T).T
    rest = H[np.ix_(stays, stays)] - gain @ across.T
    return np.asarray(0.5 * (rest + rest.T)), np.asarray(b[stays] - gain @ b[leaving])
