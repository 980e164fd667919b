"""Cholesky factorization and Schur complement against dense inverses."""

import numpy as np
import pytest

from dronevio.estimator.optimization.linalg import CholeskyFactor, SingularError, schur_complement
from dronevio.models.arrays import Array


def system(seed: int, n: int = 12, decades: float = 4.0) -> tuple[Array, Array]:
    """Return a positive definite matrix whose variables differ by orders of magnitude in scale, and a right side."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(2 * n, n)) * 10.0 ** rng.uniform(-decades, decades, n)
    return A.T @ A, A.T @ rng.normal(size=2 * n)


@pytest.mark.parametrize("seed", range(5))
def test_solution_is_accurate_at_any_scale(seed: int) -> None:
    H, b = system(seed)
    solver = CholeskyFactor(H)
    np.testing.assert_allclose(H @ solver.solve(b), b, rtol=1e-6)
    scale = np.sqrt(np.diag(H))
    columns = np.array([2, 7])
    expected = np.linalg.inv(H / np.outer(scale, scale)) / np.outer(scale, scale)
    np.testing.assert_allclose(solver.inverse_block(columns), expected[np.ix_(columns, columns)], rtol=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_schur_complement_keeps_solution_and_covariance(seed: int) -> None:
    H, b = system(seed, decades=1.0)
    eliminated = np.random.default_rng(seed).random(12) < 0.4
    H_reduced, b_reduced = schur_complement(H, b, eliminated)
    kept = ~eliminated
    np.testing.assert_allclose(np.linalg.solve(H_reduced, b_reduced), np.linalg.solve(H, b)[kept], rtol=1e-6)
    np.testing.assert_allclose(np.linalg.inv(H_reduced), np.linalg.inv(H)[np.ix_(kept, kept)], rtol=1e-6)
    np.testing.assert_array_equal(H_reduced, H_reduced.T)


@pytest.mark.parametrize(
    ("H", "message"),
    [
        (np.diag([1.0, 0.0]), "unconstrained"),
        (np.diag([1.0, np.nan]), "not finite"),
        (np.array([[1.0, np.inf], [np.inf, 1.0]]), "not finite"),
        (np.array([[1.0, 2.0], [2.0, 1.0]]), "indefinite"),
    ],
)
def test_singular_systems_are_refused(H: Array, message: str) -> None:
    with pytest.raises(SingularError, match=message):
        CholeskyFactor(H)
