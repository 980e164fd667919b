"""Policies in the simulator: a built-in one, conversion of trained ones, environments, and flights as scenarios."""

__all__: list[str] = []
