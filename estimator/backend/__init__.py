"""The back end: a fixed-lag smoother over keyframes and landmarks with a marginal prior."""

__all__: list[str] = []
