"""Camera models and image sensors: rendering, shutter, exposure, noise and frame times."""

__all__: list[str] = []
