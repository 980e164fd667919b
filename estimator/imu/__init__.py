"""The inertial side: buffered increments, preintegration, noise and covariance propagation."""

__all__: list[str] = []
