"""World repetitive: a tiled underground station with identical tiles, columns and lamps."""

from functools import partial

import numpy as np

from dronevio.models.arrays import Array, Image
from dronevio.sim.appearance import textures_building
from dronevio.sim.appearance.instances import Instance
from dronevio.sim.appearance.solids import Box
from dronevio.sim.appearance.textures import Colour
from dronevio.sim.props.building import ceiling_lamp, hall_faces, landing_mat
from dronevio.sim.worlds.layout import Layout, WorldBuilder

Random = np.random.Generator

LOW_M, HIGH_M = np.array([-8.0, -4.8, 0.0]), np.array([8.0, 4.8, 4.2])
"""Corners of the station [m]: whole tiles."""
_PITCH_M, _COLUMN_M, _COLUMN_Y_M = 3.2, 0.6, 2.4
_TILE_M, _SLAB_M, _PANEL_M, _PX_PER_M = 0.2, 0.4, 0.4, 160.0
_BANDS_M = ((1.0, 1.4), (3.0, 3.2))  # heights of coloured tiles
_GLAZES: tuple[Colour, ...] = ((46, 96, 84), (52, 74, 120), (134, 50, 46), (150, 108, 40))
_WHITE: Colour = (206, 204, 194)


def layout(rng: Random) -> Layout:
    """Draw a station; the seed determines a colour only."""
    glaze = _GLAZES[int(rng.integers(len(_GLAZES)))]
    wall = partial(_tiled, glaze=glaze)
    slabs = partial(textures_building.tiles, px_per_m=_PX_PER_M)
    floor = partial(slabs, colour=(152, 150, 144), tile_m=_SLAB_M, checker=(112, 112, 110))
    ceiling = partial(slabs, colour=(196, 196, 190), tile_m=_PANEL_M)
    xs = np.arange(-2, 3) * _PITCH_M
    half = np.array([0.5 * _COLUMN_M, 0.5 * _COLUMN_M, 0.5 * HIGH_M[2]])
    columns = tuple(
        Box(np.array([x, s * _COLUMN_Y_M, half[2]]), half, wall, pixels_per_m=_PX_PER_M, instance=Instance("column"))
        for x in xs
        for s in (-1, 1)
    )
    lamps = [
        ceiling_lamp(np.array([x, y, HIGH_M[2]]), (1.2, 0.4), 1.0)
        for x in (np.arange(-2, 2) + 0.5) * _PITCH_M
        for y in (-3.6, 0.0, 3.6)
    ]
    return Layout(
        low=LOW_M.copy(),
        high=HIGH_M.copy(),
        shell=hall_faces(LOW_M, HIGH_M, floor, ceiling, [wall] * 4, (_PX_PER_M,) * 3),
        boxes=(*columns, *(box for lamp in lamps for box in lamp.boxes), landing_mat(np.zeros(3))),
        obstacles=columns,
        lights=tuple(light for lamp in lamps for light in lamp.lights),
        pad=np.zeros(3),
        free_box=np.array([[-6.8, -1.6, 0.0], [6.8, 1.6, 3.2]]),
        route=_route(),
    )


def _route() -> Array:
    """Return a tour up one side of the station and down the other, between the columns."""
    x, y = 0.5 * (2.0 * _PITCH_M + 0.5 * _COLUMN_M + HIGH_M[0]), 0.5 * (_COLUMN_Y_M + 0.5 * _COLUMN_M + HIGH_M[1])
    tour = [(0.0, 0.0, 1.3), (x, 0.0, 1.6), (x, y, 1.2), (0.0, y, 2.0), (-x, y, 1.5)]
    tour += [(-x, -y, 1.2), (0.0, -y, 1.9), (x, -y, 1.4), (x, 0.0, 2.2)]
    return np.array(tour)


def _tiled(rng: Random, height: int, width: int, glaze: Colour) -> Image:
    """Return a wall of white tiles with bands of coloured ones, counted from its foot."""
    tiled = partial(textures_building.tiles, rng, height, width, px_per_m=_PX_PER_M, tile_m=_TILE_M)
    image, coloured = tiled(_WHITE), tiled(glaze)
    for low, high in _BANDS_M:
        rows = slice(height - round(high * _PX_PER_M), height - round(low * _PX_PER_M))
        image[rows] = coloured[rows]
    return image


REPETITIVE = WorldBuilder("a tiled underground station with repetitive texture", layout, "hard")
"""The station."""
