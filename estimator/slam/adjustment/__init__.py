"""Bundle adjustment of the map, and whether its result agrees with the odometry."""

__all__: list[str] = []
