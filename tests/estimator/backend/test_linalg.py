"""The linear algebra under the smoother, against dense linear algebra that does it the long way."""

import numpy as np
import pytest

from dronevio.estimator.backend.linalg import CholeskyFactor, SingularError, schur_complement


def system(seed: int, n: int = 12, spread: float = 4.0) -> tuple[np.ndarray, np.ndarray]:
    """Return a positive definite matrix whose variables have very different units, and a right side."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(2 * n, n)) * 10.0 ** rng.uniform(-spread, spread, n)
    return A.T @ A, A.T @ rng.normal(size=2 * n)


@pytest.mark.parametrize("seed", range(5))
def test_solves_whatever_the_units(seed: int) -> None:
    H, b = system(seed)
    solver = CholeskyFactor(H)
    np.testing.assert_allclose(H @ solver.solve(b), b, rtol=1e-6)
    scale = np.sqrt(np.diag(H))
    columns = np.array([2, 7])
    expected = np.linalg.inv(H / np.outer(scale, scale)) / np.outer(scale, scale)
    np.testing.assert_allclose(solver.inverse_block(columns), expected[np.ix_(columns, columns)], rtol=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_what_is_left_has_the_same_solution_and_covariance(seed: int) -> None:
    H, b = system(seed, spread=1.0)
    leaving = np.random.default_rng(seed).random(12) < 0.4
    rest, rest_b = schur_complement(H, b, leaving)
    np.testing.assert_allclose(np.linalg.solve(rest, rest_b), np.linalg.solve(H, b)[~leaving], rtol=1e-6)
    np.testing.assert_allclose(np.linalg.inv(rest), np.linalg.inv(H)[np.ix_(~leaving, ~leaving)], rtol=1e-6)
    np.testing.assert_array_equal(rest, rest.T)


@pytest.mark.parametrize("H", [np.diag([1.0, 0.0]), np.array([[1.0, 2.0], [2.0, 1.0]]), np.diag([1.0, np.nan])])
def test_what_has_no_unique_solution_is_told(H: np.ndarray) -> None:
    with pytest.raises(SingularError):
        CholeskyFactor(H)
