"""The worlds: one module each, with a function that draws a `dronevio.sim.worlds.layout.Layout` from a generator."""

__all__: list[str] = []
