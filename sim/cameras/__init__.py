"""Camera models and image sensors: rendering, shutter, exposure, noise and frame times."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.sim.cameras.camera import OffscreenCamera
    from dronevio.sim.cameras.gl import probe_gl, require_gl
    from dronevio.sim.cameras.imaging import Imaging

__all__ = [
    "Imaging",
    "OffscreenCamera",
    "probe_gl",
    "require_gl",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.sim.cameras.camera": ("OffscreenCamera",),
        "dronevio.sim.cameras.gl": ("probe_gl", "require_gl"),
        "dronevio.sim.cameras.imaging": ("Imaging",),
    },
)
