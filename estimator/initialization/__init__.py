"""Initialization: gravity, velocity and biases from a static interval or from motion."""

__all__: list[str] = []
