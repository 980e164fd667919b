"""Policies in the simulator: a built-in one, conversion of trained ones, their environments, and their flights as scenarios."""

__all__: list[str] = []
