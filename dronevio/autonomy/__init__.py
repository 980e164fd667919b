"""Autonomy: routes through known-free space, corridors, and trajectories inside them."""

__all__: list[str] = []
