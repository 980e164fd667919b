"""The inertial side: buffered increments, preintegration, noise and covariance propagation."""
