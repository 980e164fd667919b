"""The mapper behind the odometry: in the same process, or in one of its own."""

__all__: list[str] = []
