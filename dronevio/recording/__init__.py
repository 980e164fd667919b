"""Recordings that the application makes: simulated flights, excerpts, and videos with an unknown IMU rotation."""

__all__: list[str] = []
