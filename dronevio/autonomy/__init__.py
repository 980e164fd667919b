"""Autonomy: routes and trajectories through known-free space."""

__all__: list[str] = []
