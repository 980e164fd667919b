"""Planning: routes, corridors of free boxes, and minimum-snap trajectories inside them."""

__all__: list[str] = []
