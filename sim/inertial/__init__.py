"""IMU errors: biases, noise, vibration and output limits."""

__all__: list[str] = []
