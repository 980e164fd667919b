"""Robust nonlinear least squares on manifolds: one problem statement, two methods."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.estimator.optimization.objective import Linearized, Objective

__all__ = ["Linearized", "Objective"]

__getattr__, __dir__ = attach(__name__, {"dronevio.estimator.optimization.objective": ("Linearized", "Objective")})
