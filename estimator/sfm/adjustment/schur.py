"""The normal equations of a bundle adjustment, whose points are eliminated by the Schur complement.

With poses and intrinsics c and points p,

    | U   W | |δc|   |b_c|
    | Wᵀ  V | |δp| = |b_p|     (U − W V⁻¹ Wᵀ) δc = b_c − W V⁻¹ b_p,

where V is block diagonal (Triggs et al., "Bundle adjustment: a modern synthesis", 2000, section 6). W and the reduced
matrix are sparse, in blocks: a point couples only the images that observe it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.sparse import bsr_array, csr_array
from scipy.sparse.linalg import splu

from dronevio.estimator.optimization.linalg import RELATIVE_DAMPING, SingularError
from dronevio.estimator.sfm.adjustment.reprojection import BLOCK
from dronevio.models.arrays import Array

Indices = npt.NDArray[np.int64]
Solver: TypeAlias = Callable[[Array], Array]
"""Function that returns H⁻¹ b for b (n,) or (n, m)."""

DIAGONAL_BOUNDS = 1e-6, 1e32
"""Bounds of the diagonal elements by which the steps are damped."""
DENSE_SHARE = 0.2
"""Share of the blocks above which the reduced matrix is factorized as a dense one."""
DENSE_BLOCKS = 100
"""Number of blocks of rows below which it is, in any case."""


class Groups:
    """Sums of rows over the groups that they belong to."""

    def __init__(self, group: Indices, count: int) -> None:
        """Take the group (N,) of each row, and the number of groups."""
        self._sum = csr_array((np.ones(len(group)), (group, np.arange(len(group)))), shape=(count, len(group)))
        self._count = count

    def sums(self, values: Array) -> Array:
        """Return the sums (G, …) of values (N, …)."""
        return np.asarray(self._sum @ values.reshape(len(values), -1)).reshape(self._count, *values.shape[1:])


@dataclass(frozen=True, eq=False)
class Blocks:
    """N blocks of a matrix; blocks at the same place are added."""

    rows: Indices
    """(N,) Block row of each."""
    columns: Indices
    """(N,) Block column of each."""
    values: Array
    """(N, R, C) The blocks."""

    def matrix(self, rows: int, columns: int) -> bsr_array:
        """Return the matrix with a number of block rows and block columns."""
        places, place = np.unique(self.rows * columns + self.columns, return_inverse=True)
        values = self.values if len(places) == len(place) else Groups(place, len(places)).sums(self.values)
        if len(places) == len(place):
            ordered = np.empty_like(values)
            ordered[place] = values
            values = ordered
        starts = np.searchsorted(places, columns * np.arange(rows + 1))
        _, height, width = self.values.shape
        return bsr_array((values, places % columns, starts), shape=(rows * height, columns * width))


def joined(blocks: Sequence[Blocks]) -> Blocks:
    """Return blocks of one size together."""
    return Blocks(*(np.concatenate([getattr(b, name) for b in blocks]) for name in ("rows", "columns", "values")))


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Normal equations with B blocks of poses and intrinsics, and T points."""

    U: bsr_array
    """(6 B, 6 B) Information on poses and intrinsics."""
    W: bsr_array
    """(6 B, 3 T) Their coupling to the points."""
    V: Array
    """(T, 3, 3) Information on the points."""
    b_blocks: Array
    """(6 B,) Right-hand side of poses and intrinsics."""
    b_points: Array
    """(T, 3) Right-hand side of the points."""

    def step(self, damping: float) -> tuple[Array, Array, float]:
        """Return a damped step: of the blocks (B, 6), of the points (T, 3), and the decrease that the model predicts.

        Raises:
            SingularError: The damped equations have no unique solution.
        """
        diagonal = np.clip(self.U.diagonal(), *DIAGONAL_BOUNDS)
        diagonal_V = np.clip(np.einsum("nii->ni", self.V), *DIAGONAL_BOUNDS)
        V = self.V.copy()
        np.einsum("nii->ni", V)[:] += damping * diagonal_V
        solve, inverse = self._reduced(damping * diagonal, V)
        along = np.einsum("nij,nj->ni", inverse, self.b_points)
        delta = solve(self.b_blocks - self.W @ along.ravel())
        points = along - np.einsum("nij,nj->ni", inverse, (self.W.T @ delta).reshape(-1, 3))
        # ½ δᵀ (λ D δ + b) is the decrease of the quadratic model (Madsen, Nielsen and Tingleff 2004, eq. 3.14).
        gain = delta @ (damping * diagonal * delta + self.b_blocks)
        gain += np.sum(points * (damping * diagonal_V * points + self.b_points))
        return delta.reshape(-1, BLOCK), points, 0.5 * float(gain)

    def covariance(self, blocks: Indices) -> Array:
        """Return the covariance (N, 6, 6) of some blocks, all others marginalized.

        Raises:
            SingularError: The equations have no unique solution.
        """
        solve, _ = self._reduced(np.zeros(len(self.b_blocks)), self.V)
        result = np.empty((len(blocks), BLOCK, BLOCK))
        for n, block in enumerate(blocks.tolist()):
            rows = np.arange(BLOCK * block, BLOCK * (block + 1))
            unit = np.zeros((len(self.b_blocks), BLOCK))
            unit[rows, np.arange(BLOCK)] = 1.0
            result[n] = solve(unit)[rows]
        return result

    def _reduced(self, damping: Array, V: Array) -> tuple[Solver, Array]:
        """Return the solver of the reduced equations, and the inverses (T, 3, 3) of the information on the points."""
        try:
            inverse = np.asarray(np.linalg.inv(V), np.float64)
        except np.linalg.LinAlgError as error:
            raise SingularError("a point is not determined") from error
        starts, columns = self.W.indptr, self.W.indices
        scaled = bsr_array((self.W.data @ inverse[columns], columns, starts), shape=self.W.shape)
        S = bsr_array(self.U - scaled @ self.W.T)
        blocks = S.shape[0] // BLOCK
        is_dense = blocks <= DENSE_BLOCKS or len(S.data) > DENSE_SHARE * blocks**2
        return (_dense_solver if is_dense else _sparse_solver)(S, damping), inverse


def _dense_solver(S: bsr_array, damping: Array) -> Solver:
    """Return the solver of a symmetric matrix with an addition to its diagonal, by Cholesky's factorization in place.

    Raises:
        SingularError: The matrix is not positive definite.
    """
    H = S.toarray()
    diagonal = np.diag(H) + damping
    if not np.all(diagonal > 0.0):  # also if it is not finite
        raise SingularError("a variable is not determined")
    scale = 1.0 / np.sqrt(diagonal)
    H *= scale[:, None]
    H *= scale
    H[np.diag_indices_from(H)] = 1.0 + RELATIVE_DAMPING
    try:
        factor = cho_factor(H.T, lower=True, overwrite_a=True, check_finite=False)
    except LinAlgError as error:
        raise SingularError("the linear system is indefinite") from error

    def solve(b: Array) -> Array:
        by = scale if b.ndim == 1 else scale[:, None]
        return np.asarray(by * cho_solve(factor, by * b, check_finite=False))

    return solve


def _sparse_solver(S: bsr_array, damping: Array) -> Solver:
    """Return the solver of a symmetric matrix with an addition to its diagonal, by a sparse factorization.

    Raises:
        SingularError: The matrix is singular.
    """
    H = S.tocsc()
    H.setdiag(H.diagonal() + damping)
    try:
        factor = splu(H, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    except RuntimeError as error:
        raise SingularError("the linear system is singular") from error
    return lambda b: np.asarray(factor.solve(b))
