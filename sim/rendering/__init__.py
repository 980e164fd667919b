"""Rendering of the frames of a flight: of a recording by several processes, or one at a time as it goes on."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.sim.rendering.live_cameras import LiveCameras
    from dronevio.sim.rendering.render import render_frames
    from dronevio.sim.rendering.render_job import RenderJob

__all__ = [
    "LiveCameras",
    "RenderJob",
    "render_frames",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.sim.rendering.live_cameras": ("LiveCameras",),
        "dronevio.sim.rendering.render": ("render_frames",),
        "dronevio.sim.rendering.render_job": ("RenderJob",),
    },
)
