"""Losses, linear fits, Gauss-Newton and Levenberg-Marquardt, on problems of known solutions."""

from dataclasses import dataclass

import numpy as np
import pytest

from dronevio.estimator.optimization.gauss_newton import gauss_newton
from dronevio.estimator.optimization.levenberg_marquardt import levenberg_marquardt
from dronevio.estimator.optimization.linalg import CholeskyFactor, LeastNormFactor, LUFactor, SingularError
from dronevio.estimator.optimization.linear_fit import median, robust_linear_fit
from dronevio.estimator.optimization.robust import (
    cauchy_inflation,
    cauchy_loss,
    geman_mcclure_loss,
    geman_mcclure_weight,
)
from dronevio.models.arrays import Array

SQUARED = np.array([0.0, 0.5, 4.0, 100.0])


@pytest.mark.parametrize("threshold2", [0.3, 4.0])
def test_weights_are_derivatives_of_losses(threshold2: float) -> None:
    h = 1e-6
    cauchy = (cauchy_loss(SQUARED + h, threshold2) - cauchy_loss(SQUARED, threshold2)) / h
    np.testing.assert_allclose(cauchy, 1.0 / cauchy_inflation(SQUARED, threshold2), rtol=1e-4)
    geman = (geman_mcclure_loss(SQUARED + h, threshold2) - geman_mcclure_loss(SQUARED, threshold2)) / h
    np.testing.assert_allclose(geman, geman_mcclure_weight(SQUARED, threshold2), rtol=1e-3, atol=1e-8)


def test_losses_by_hand() -> None:
    assert cauchy_inflation(4.0, 4.0) == 2.0
    assert cauchy_loss(4.0, 4.0) == pytest.approx(4.0 * np.log(2.0))
    np.testing.assert_allclose(geman_mcclure_weight(np.array([4.0]), 4.0), 0.25)
    np.testing.assert_allclose(geman_mcclure_loss(np.array([4.0]), 4.0), 2.0)


@dataclass(frozen=True, eq=False)
class Equations:
    """Normal equations of a vector."""

    H: Array
    b: Array
    x: Array
    scales: float

    def retract(self, delta: Array) -> Array:
        """Return the vector after a step."""
        return self.x + delta


class Valley:
    """Rosenbrock's valley: residuals 10 (y − x²) and 1 − x, whose minimum is at (1, 1)."""

    def __init__(self) -> None:
        self.compared: list[tuple[float, float]] = []
        """The abscissa of the linearization, as the scale, and that of each cost."""

    def linearize(self, x: Array) -> Equations:
        """Return the normal equations at a point; its scale tells where they come from."""
        J, r = np.array([[-20.0 * x[0], 10.0], [-1.0, 0.0]]), self.residual(x)
        return Equations(J.T @ J, -J.T @ r, x, float(x[0]))

    def residual(self, x: Array) -> Array:
        """Return both residuals."""
        return np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])

    def cost(self, x: Array, scales: float) -> float:
        """Return half of the squared residuals."""
        self.compared.append((scales, float(x[0])))
        return 0.5 * float(self.residual(x) @ self.residual(x))


START = np.array([-1.2, 1.0])


def test_gauss_newton_ends_after_a_short_step() -> None:
    """The residuals are linear but for x²: the second step leads to the minimum, and the third one is short."""
    whole = gauss_newton(Valley(), START, CholeskyFactor, 10, is_last=lambda step: step.decrement < 1e-9)
    np.testing.assert_allclose(whole.x, [1.0, 1.0])
    assert whole.decrement < 1e-9
    one = gauss_newton(Valley(), START, LUFactor, 1)
    assert np.abs(one.x - 1.0).max() > 1.0
    assert one.decrement == pytest.approx(one.delta @ Valley().linearize(START).H @ one.delta)
    np.testing.assert_allclose(gauss_newton(Valley(), START, LeastNormFactor, 1).x, one.x, rtol=1e-9)


def test_levenberg_marquardt_goes_down_a_curved_valley() -> None:
    """The first Gauss-Newton step would raise the cost from 12 to some thousand; such steps are rejected."""
    problem = Valley()
    found = levenberg_marquardt(problem, START, CholeskyFactor, 100)
    np.testing.assert_allclose(found.x, [1.0, 1.0], atol=1e-3)
    assert found.converged and 0 < found.rejected < found.steps < 100
    np.testing.assert_array_equal(found.equations.b, problem.linearize(found.x).b)


def test_both_costs_are_at_the_scales_of_the_linearization() -> None:
    problem = Valley()
    levenberg_marquardt(problem, START, CholeskyFactor, 20)
    before, after = problem.compared[::2], problem.compared[1::2]
    assert all(scale == at for scale, at in before)
    assert [scale for scale, _ in before] == [scale for scale, _ in after]


def test_iterations_are_limited() -> None:
    found = levenberg_marquardt(Valley(), START, CholeskyFactor, 3)
    assert found.steps == 3 and not found.converged


def test_singular_matrices_are_errors() -> None:
    with pytest.raises(SingularError, match="singular"):
        LUFactor(np.zeros((2, 2))).solve(np.ones(2))
    np.testing.assert_allclose(LeastNormFactor(np.diag([2.0, 0.0])).solve(np.ones(2)), [0.5, 0.0])


def test_a_linear_fit_by_hand() -> None:
    """Equal measurements have equal weights: those of the residuals of the first fit."""
    A, measured = np.ones((1, 2, 1)), np.full((1, 2), 3.0)
    variance, information = 4.0, 0.5

    def fit(square: float) -> tuple[float, float]:
        of_points = 2.0 / (variance * (1.0 + square / (square + variance)))
        return 3.0 * of_points / (of_points + information), of_points + information

    first, _ = fit(2.0 * 3.0**2)
    solution, total = fit(2.0 * (3.0 - first) ** 2)
    found = robust_linear_fit(A, measured, variance, np.array([[information]]))
    np.testing.assert_allclose(found.solution, solution)
    np.testing.assert_allclose(found.covariance, 1.0 / total)


def test_outliers_hardly_change_a_linear_fit() -> None:
    rng = np.random.default_rng(0)
    A, x = rng.normal(size=(80, 2, 3)), np.array([1.0, -2.0, 0.5])
    measured = A @ x + 0.01 * rng.normal(size=(80, 2))
    measured[:10] += 5.0
    found = robust_linear_fit(A, measured, 1e-4, 1e-6 * np.eye(3))
    assert np.abs(found.solution - x).max() < 0.05
    assert median(np.array([4.0, 1.0, 3.0, 2.0])) == 3.0
