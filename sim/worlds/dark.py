"""World dark: the furnished room at night with its lamps off, lit through the windows only."""

from dataclasses import replace
from functools import partial

import numpy as np

from dronevio.models.arrays import Image
from dronevio.sim.appearance import pictures
from dronevio.sim.appearance.textures import to_image
from dronevio.sim.worlds import room
from dronevio.sim.worlds.layout import Layout, WorldBuilder

ILLUMINATION = 0.025
"""Illumination relative to a well-lit room."""
_NIGHT = np.array([0.5, 0.62, 0.9], np.float32)  # red, green and blue of the outside relative to the day
_MOON_GLOW = 0.8


def layout(rng: np.random.Generator) -> Layout:
    """Draw a furnished room with its lamps off."""
    lit = room.layout(rng)
    boxes = tuple(
        replace(box, front=partial(_night_view), glow=_MOON_GLOW)
        if box.front is pictures.window_view
        else replace(box, glow=0.0)
        for box in lit.boxes
    )
    windows = tuple(light for light in lit.lights if light.normal is not None)  # lamps emit in all directions
    return replace(lit, boxes=boxes, lights=windows, illumination=ILLUMINATION)


def _night_view(rng: np.random.Generator, height: int, width: int) -> Image:
    """Return the view through a window by moonlight."""
    return to_image(pictures.window_view(rng, height, width) * _NIGHT)


DARK = WorldBuilder("the furnished room at night with 2.5 % of its illumination", layout, "hard")
"""The dark room."""
