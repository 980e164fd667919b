"""Robust nonlinear least squares on manifolds: one problem statement, two methods."""
