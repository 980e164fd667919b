"""Rendering of the frames of a recording by several processes."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.sim.rendering.render import render_frames
    from dronevio.sim.rendering.render_job import RenderJob

__all__ = [
    "RenderJob",
    "render_frames",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.sim.rendering.render": ("render_frames",),
        "dronevio.sim.rendering.render_job": ("RenderJob",),
    },
)
