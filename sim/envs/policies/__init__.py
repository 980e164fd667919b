"""Policies in the simulator: a built-in one, conversion of trained ones, and their flights as scenarios."""

__all__: list[str] = []
