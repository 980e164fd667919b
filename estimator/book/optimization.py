"""Three computations on one factor graph: batch solution, incremental solution, and covariance at the solution.

The graphs of section 7.4.1 are ill-conditioned, because the standard deviations of their factors differ by a factor of
10⁶. Cholesky factorization of the normal equations AᵀA squares the condition number and fails; QR factorization of A
does not. All functions here therefore use QR.

Sources: Dellaert and Kaess, "Factor graphs for robot perception", 2017; Kaess et al., "iSAM2: incremental smoothing and
mapping using the Bayes tree", IJRR 2012.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import SupportsIndex, SupportsInt

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from dronevio.models.arrays import Array

SETTLED = 1e-12
"""Largest change of any variable at which the incremental solution is regarded as settled [rad, m, m/s]."""
MAX_UPDATES = 50
"""Largest number of additional updates of the incremental solution."""


@dataclass(frozen=True, eq=False)
class BatchSolution:
    """The solution of a graph by Levenberg-Marquardt."""

    values: gtsam.Values
    """Values of all variables."""
    iterations: int
    """Number of iterations."""


@dataclass(frozen=True, eq=False)
class IncrementalSolution:
    """The solution of a graph by iSAM2, to which the states were added one after another."""

    values: gtsam.Values
    """Values of all variables after the last update."""
    updates: int
    """Number of updates: one for each state, and those until the solution settled."""


def solve_batch(graph: gtsam.NonlinearFactorGraph, initial: gtsam.Values) -> BatchSolution:
    """Solve a graph with Levenberg-Marquardt, until the error does not decrease any more."""
    params = gtsam.LevenbergMarquardtParams()
    params.setLinearSolverType("MULTIFRONTAL_QR")
    params.setAbsoluteErrorTol(0.0)
    params.setRelativeErrorTol(0.0)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, initial, params)
    return BatchSolution(optimizer.optimize(), optimizer.iterations())


def solve_incrementally(graph: gtsam.NonlinearFactorGraph, initial: gtsam.Values) -> IncrementalSolution:
    """Solve a graph with iSAM2, state by state, and repeat the update until the solution has settled.

    All variables are relinearized in each update (threshold 0, at every update).

    Args:
        graph: The graph. A factor is added with the newest state that it connects; biases belong to the first.
        initial: Initial values of all its variables.
    """
    params = gtsam.ISAM2Params()
    params.setRelinearizeThreshold(0.0)
    params.relinearizeSkip = 1
    params.setFactorization("QR")
    params.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(0.0))
    isam = gtsam.ISAM2(params)
    factors = [graph.at(i) for i in range(graph.size())]
    states = [max(map(_state, factor.keys())) for factor in factors]
    count = max(states) + 1
    for k in range(count):
        added = gtsam.NonlinearFactorGraph()
        for factor, state in zip(factors, states, strict=True):
            if state == k:
                added.push_back(factor)
        isam.update(added, _select(initial, k))
    updates, estimate = count, isam.calculateEstimate()
    for _ in range(MAX_UPDATES):
        isam.update()
        before, estimate, updates = estimate, isam.calculateEstimate(), updates + 1
        if largest_difference(before, estimate) < SETTLED:
            break
    return IncrementalSolution(estimate, updates)


def largest_difference(one: gtsam.Values, other: gtsam.Values) -> float:
    """Return the largest coordinate of the difference of two solutions in local coordinates [rad, m, m/s]."""
    difference = one.localCoordinates(other)
    return max(float(np.abs(difference.at(key)).max()) for key in map(int, one.keys()))


@dataclass(frozen=True, eq=False)
class LinearizedGraph:
    """A linearized graph with N variables' coordinates and M residuals, as one dense matrix.

    The covariance of all variables is (AᵀA)⁻¹ = A⁺ A⁺ᵀ, where each column of the pseudoinverse A⁺ is the response of
    the solution to one whitened residual. The covariance is therefore a sum over the factors.
    """

    response: Array
    """(N, M) Pseudoinverse A⁺ of the whitened Jacobian, by QR factorization."""
    condition: float
    """Condition number of the whitened Jacobian."""
    columns: dict[int, slice]
    """Rows of ``response`` that belong to each variable, by its key."""
    residuals: tuple[slice, ...]
    """Columns of ``response`` that belong to each factor."""

    @classmethod
    def of(cls, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> "LinearizedGraph":
        """Linearize a graph at given values."""
        linear = graph.linearize(values)
        zeros, keys = values.zeroVectors(), list(map(int, values.keys()))
        columns = dict(zip(keys, _consecutive([len(zeros.at(key)) for key in keys]), strict=True))
        factors = [linear.at(i) for i in range(linear.size())]
        jacobians = [factor.jacobian()[0] for factor in factors]
        residuals = _consecutive([len(jacobian) for jacobian in jacobians])
        A = np.zeros((residuals[-1].stop, columns[keys[-1]].stop))
        for factor, jacobian, rows in zip(factors, jacobians, residuals, strict=True):
            A[rows, np.r_[tuple(columns[key] for key in map(int, factor.keys()))]] = jacobian
        Q, R = np.linalg.qr(A)
        return cls(np.linalg.solve(R, Q.T), float(np.linalg.cond(A)), columns, residuals)


def _consecutive(sizes: Sequence[int]) -> tuple[slice, ...]:
    """Return the slices of consecutive blocks of given sizes."""
    ends = np.cumsum(sizes).tolist()
    return tuple(slice(end - size, end) for size, end in zip(sizes, ends, strict=True))


def _state(key: SupportsInt | SupportsIndex) -> int:
    """Return the state that a variable belongs to; the only bias belongs to the first."""
    return int(gtsam.Symbol(int(key)).index())


def _select(values: gtsam.Values, state: int) -> gtsam.Values:
    """Return the pose, the velocity and, if there is one, the bias of a state."""
    selected = gtsam.Values()
    selected.insert(X(state), values.atPose3(X(state)))
    selected.insert(V(state), values.atVector(V(state)))
    if values.exists(B(state)):
        selected.insert(B(state), values.atConstantBias(B(state)))
    return selected
