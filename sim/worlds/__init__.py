"""The worlds, a module each: a function that draws a `dronevio.sim.layout.Layout` from random numbers."""
