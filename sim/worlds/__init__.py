"""The worlds, a module each: a function that draws a `dronevio.sim.worlds.layout.Layout` from random numbers."""

__all__: list[str] = []
