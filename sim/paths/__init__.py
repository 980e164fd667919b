"""Path planning: shapes, minimum-snap trajectories within limits and clear of obstacles, and recorded trajectories."""

__all__: list[str] = []
