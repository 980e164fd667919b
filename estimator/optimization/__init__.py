"""Robust nonlinear least squares on manifolds: one problem statement, two methods."""

__all__: list[str] = []
