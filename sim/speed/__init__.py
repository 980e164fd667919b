"""Speed of the simulator: figures of the processor time that it takes."""

__all__: list[str] = []
