"""Other light in the same world: geometry and textures stay, lamps, windows, sun and sky change.

Indoors, the power of every lamp and window is multiplied by a random factor, and so is the illumination of the whole
world, which darkens the images of a camera with fixed exposure. The light maps with their shadows are computed again.
Outdoors, the direction of the sun and the weather are drawn anew, with the shadows on the ground and on trunks.
The brightness of surfaces that emit light, such as the covers of lamps, stays.
"""

from dataclasses import replace

import numpy as np

from dronevio.sim.worlds.layout import Layout, WorldBuilder

_POWER_SIGMA = 0.7  # standard deviation of the logarithm of the power of a light: a factor of 0.5 to 2 in two of three
_DIMMEST, _BRIGHTEST = 0.6, 1.0  # illumination, relative to that of the world: brighter images would saturate


def drawn_layout(builder: WorldBuilder, rng: np.random.Generator, light: np.random.Generator | None = None) -> Layout:
    """Draw the layout of a world, optionally under other light.

    Args:
        builder: The world.
        rng: Generator of the layout.
        light: Generator of the light; None for the light that belongs to the layout.
    """
    if light is None:
        return builder.layout(rng)
    if builder.layout_in_daylight is not None:
        return builder.layout_in_daylight(rng, light)
    return relit(builder.layout(rng), light)


def relit(layout: Layout, light: np.random.Generator) -> Layout:
    """Return a layout with other powers of its lights and another illumination.

    Args:
        layout: A layout with lamps or windows.
        light: Generator of the light.
    """
    factors = np.exp(light.normal(0.0, _POWER_SIGMA, len(layout.lights))).tolist()
    lights = [replace(lamp, power=factor * lamp.power) for lamp, factor in zip(layout.lights, factors, strict=True)]
    illumination = layout.illumination * light.uniform(_DIMMEST, _BRIGHTEST)
    return replace(layout, lights=tuple(lights), illumination=illumination)
