"""What the measurements say about the estimate and about themselves: health, consistency, and errors of sensors."""

__all__: list[str] = []
