"""Other light in the same world: geometry and textures stay, lamps, windows, sun and sky change.

Indoors, a part of the lamps and windows is off, the power of the others is multiplied by random factors, and there is
less scattered light, so that shadows are deeper. The light maps are computed again. The illumination of the whole world
decreases by a random factor, too, which darkens the images of a camera with fixed exposure.
Outdoors, the direction of the sun and the weather are drawn anew, with the shadows on the ground and on trunks.
The brightness of surfaces that emit light, such as the covers of lamps, stays.
"""

from dataclasses import replace

import numpy as np

from dronevio.sim.worlds.layout import Layout, WorldBuilder

_POWER_SIGMA = (
    1.0  # standard deviation of the logarithm of the power of a light: a factor of 0.4 to 2.7 in two of three
)
_OFF_CHANCE = 0.3  # of each light
_SCATTERED = (0.25, 0.75)  # range of the scattered light, relative to that of the world
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
    """Return a layout with other powers of its lights, other scattered light and another illumination.

    Args:
        layout: A layout with lamps or windows.
        light: Generator of the light.
    """
    count = len(layout.lights)
    factors, on = np.exp(light.normal(0.0, _POWER_SIGMA, count)), light.random(count) >= _OFF_CHANCE
    on[light.integers(count)] = True  # one at least
    powers = (factors * on).tolist()
    lights = [replace(lamp, power=power * lamp.power) for lamp, power in zip(layout.lights, powers, strict=True)]
    illumination = layout.illumination * light.uniform(_DIMMEST, _BRIGHTEST)
    scattered = layout.scattered * light.uniform(*_SCATTERED)
    return replace(layout, lights=tuple(lights), illumination=illumination, scattered=scattered)
