"""The map: keyframes, the odometry's factors between them, pose graphs, and the covariance of their poses."""

__all__: list[str] = []
