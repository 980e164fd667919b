"""World forest: tall trees around a clearing, with boulders, bushes and logs, under a cloudy sky."""

from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np

from dronevio.models.arrays import Array, Image
from dronevio.models.rotation import rotation_z
from dronevio.sim.appearance import pictures, textures
from dronevio.sim.appearance import textures_nature as nature
from dronevio.sim.appearance.cutouts import Print
from dronevio.sim.appearance.instances import Instance
from dronevio.sim.appearance.solids import Box, Sheet, parts_of
from dronevio.sim.appearance.textures import Colour, scaled
from dronevio.sim.props import vegetation
from dronevio.sim.props.vegetation import Vegetation
from dronevio.sim.worlds import outdoors
from dronevio.sim.worlds.layout import Layout, WorldBuilder

Random = np.random.Generator

_LOW, _HIGH = np.array([-14.0, -11.0, 0.0]), np.array([14.0, 11.0, 5.0])
_FREE_BOX_M = np.array([[-2.6, -2.2, 0.0], [2.6, 2.2, 3.2]])
_ROUTE_M = np.array(
    [
        [0.0, 0.0, 1.4],
        [4.6, -2.2, 1.1],
        [9.0, -7.0, 1.6],
        [11.0, -0.6, 2.2],
        [7.2, 3.0, 1.3],
        [9.6, 7.6, 1.9],
        [2.4, 7.4, 2.6],
        [-4.4, 5.0, 1.2],
        [-10.4, 7.6, 1.8],
        [-8.0, 1.2, 2.8],
        [-11.2, -5.6, 1.5],
        [-4.8, -7.8, 1.1],
        [0.4, -5.6, 2.0],
    ]
)
_ROUTE_JITTER_M = np.array([0.7, 0.7, 0.25])
_PASSAGE_M = 1.15  # from the route to the nearest bark
_LOOSE_M = 1.0  # horizontal distance from the route to objects on the ground
_GROUND_PX_PER_M = 103.0
_WOODS_M = 25.0  # largest distance of trees from the centre
_THICKET_M = 27.0  # distance of the painted background
_THICKET_WIDTH_PX = 4096
_PAD_M = 0.9


@dataclass(frozen=True)
class Season:
    """Colours of a season."""

    litter: tuple[Colour, ...]
    """Colours of fallen leaves."""
    moss: Colour
    """Colour of the ground vegetation."""
    leaves: tuple[Colour, ...]
    """Colours of the leaves on trees, `vegetation.TONES` of them."""
    mist: Colour
    """Colour of the distant forest."""


_EARTH: tuple[Colour, ...] = ((146, 104, 64), (116, 84, 54), (164, 128, 80), (94, 70, 48), (128, 92, 62))
_SEASONS: tuple[Season, ...] = (
    Season(_EARTH, (92, 108, 54), ((88, 118, 50), (104, 128, 56), (76, 108, 52), (118, 132, 64)), (132, 148, 116)),
    Season(
        ((176, 112, 48), (150, 78, 40), (196, 146, 62), (120, 80, 44), (168, 92, 46)),
        (96, 100, 52),
        ((182, 124, 44), (164, 88, 40), (190, 150, 60), (140, 124, 56)),
        (176, 158, 124),
    ),
    Season(_EARTH, (108, 130, 58), ((126, 150, 62), (140, 160, 74), (110, 140, 60), (150, 160, 90)), (160, 174, 138)),
)
"""Summer, autumn, spring."""
_BARKS: tuple[Colour, ...] = ((124, 100, 78), (104, 90, 76), (146, 134, 120), (116, 86, 64))
_STONE: Colour = (138, 134, 126)


def layout(rng: Random, light: Random | None = None) -> Layout:
    """Draw a forest.

    Args:
        rng: Generator of everything but the light.
        light: Generator of sun and weather; the first one by default.
    """
    season, weather = _SEASONS[int(rng.integers(len(_SEASONS)))], outdoors.WEATHERS[int(rng.integers(4))]
    toward = outdoors.sun(rng)
    if light is not None:
        weather, toward = outdoors.daylight(light)
    route = _ROUTE_M + np.vstack([np.zeros(3), rng.uniform(-1.0, 1.0, (len(_ROUTE_M) - 1, 3)) * _ROUTE_JITTER_M])
    plantation = _trees(rng, route, toward)
    loose, boulders = _undergrowth(rng, route, plantation, toward)
    growing = [plant for plant, _, _ in plantation] + loose
    floor = Instance("floor")
    ground = Sheet(
        outdoors.flat((-20.0, -16.0), (20.0, 16.0), 0.0),
        partial(_floor, season=season),
        pixels_per_m=_GROUND_PX_PER_M,
        instance=floor,
    )
    beyond = Sheet(
        outdoors.flat((-32.0, -32.0), (32.0, 32.0), -0.03),
        partial(_far_floor, season=season),
        pixels_per_m=24.0,
        instance=floor,
    )
    paint = partial(nature.stone, colour=_STONE)
    stones = tuple(Sheet(grid, paint, pixels_per_m=160.0, instance=Instance("boulder")) for grid, _ in boulders)
    shade = [_shade(place, radius) for _, place, radius in plantation]
    filling = [box for plant in growing for box in plant.filling]
    for stone, (grid, box) in zip(stones, boulders, strict=True):
        filling += parts_of(stone.instance, vegetation.boulder_filling(grid, box))
    obstacles = [box for plant in growing for box in plant.obstacles] + [box for _, box in boulders]
    wood = tuple(part for plant in growing for part in plant.wood)
    leaves = tuple(part for plant in growing for part in plant.leaves)
    return Layout(
        low=_LOW.copy(),
        high=_HIGH.copy(),
        shell=(ground, beyond, outdoors.sky(weather), _thicket(rng, season), *stones),
        boxes=(),
        obstacles=tuple(obstacles),
        lights=(outdoors.sunlight(toward),),
        pad=np.zeros(3),
        free_box=_FREE_BOX_M.copy(),
        route=route,
        walled=False,
        shading=tuple(shade + [replace(box, half=0.65 * box.half) for _, box in boulders]),
        filling=tuple(filling),
        prints=(
            Print(partial(vegetation.bark_image, colours=_BARKS, sun=toward), 1400, 1536, wood),
            Print(partial(vegetation.leaf_image, colours=season.leaves), 256, 2048, leaves),
        ),
    )


def _trees(rng: Random, route: Array, toward: Array) -> list[tuple[Vegetation, Array, float]]:
    """Return the trees, each with its position (2,) and the radius of its trunk [m]."""
    girths = rng.choice([0.11, 0.15, 0.19, 0.24, 0.32], 900, p=[0.24, 0.28, 0.24, 0.16, 0.08])
    radii = girths * rng.uniform(0.9, 1.15, len(girths))
    places, radii = outdoors.scattered(rng, (-_WOODS_M,) * 2, (_WOODS_M,) * 2, len(radii), radii, 1.9)
    low, high = _FREE_BOX_M[:, :2]
    in_clearing = np.all((places > low - 0.7) & (places < high + 0.7), axis=1)
    free = outdoors.distance_to_legs(places, route) - 1.25 * radii > _PASSAGE_M
    near_border = np.any(np.abs(np.abs(places) - _HIGH[:2]) < 0.45, axis=1) & np.all(
        np.abs(places) < _HIGH[:2] + 0.45, axis=1
    )
    around = np.linalg.norm(places, axis=1) < _WOODS_M
    trees = []
    for place, radius in zip(*(v[free & around & ~in_clearing & ~near_border] for v in (places, radii)), strict=True):
        inside = bool(np.all(np.abs(place) < _HIGH[:2]))
        tall = 6.8 + 14.0 * radius + rng.uniform(0.0, 2.5)
        twigs, sides = (int(130 + 200 * radius), 8) if inside else (44, 6)
        kind = int(rng.integers(vegetation.BARKS))
        plant = vegetation.tree(rng, radius, tall, _HIGH[2] + 0.2, kind, toward, twigs, sides)
        plant = plant.moved(np.eye(3), np.array([*place, 0.0]))
        if not inside:
            plant = Vegetation(plant.wood, plant.leaves, (), ())
        trees.append((plant, place, float(radius)))
    return trees


def _undergrowth(
    rng: Random, route: Array, trees: list[tuple[Vegetation, Array, float]], toward: Array
) -> tuple[list[Vegetation], list[tuple[Array, Box]]]:
    """Return what grows and lies between the trees, and the boulders: surface and box of each."""
    radii = np.concatenate([[radius for _, _, radius in trees], np.full(420, 0.45)])
    thrown, _ = outdoors.scattered(rng, (-22.0, -20.0), (22.0, 20.0), 420, radii[-420:], 0.25)
    standing = np.array([place for _, place, _ in trees])
    clear = np.linalg.norm(thrown[:, None] - standing, axis=2).min(axis=1) > 1.0
    low, high = _FREE_BOX_M[:, :2]
    clear &= ~np.all((thrown > low - 0.8) & (thrown < high + 0.8), axis=1)
    off_route = outdoors.distance_to_legs(thrown, route)
    plants: list[Vegetation] = []
    boulders: list[tuple[Array, Box]] = []
    for place, off in zip(thrown[clear], off_route[clear], strict=True):
        inside = bool(np.all(np.abs(place) < _HIGH[:2] - 0.9))
        kind = rng.random()
        at = np.array([*place, 0.0])
        R = rotation_z(rng.uniform(0.0, 2.0 * np.pi))
        if not inside or off < _LOOSE_M + 0.8:
            if rng.random() < 0.75 and np.any(np.abs(place) > _HIGH[:2] - 2.0):
                plants.append(vegetation.fern(rng).moved(R, at))
            continue
        if kind < 0.42:
            plants.append(vegetation.bush(rng, toward).moved(R, at))
        elif kind < 0.72:
            half = rng.uniform(0.3, 0.75) * np.array([1.0, rng.uniform(0.7, 1.0), rng.uniform(0.6, 0.9)])
            grid, box = vegetation.boulder(rng, half)
            boulders.append((grid @ R.T + at, box.moved(R, at)))
        elif kind < 0.84:
            plants.append(vegetation.log(rng, rng.uniform(0.12, 0.2), rng.uniform(1.2, 1.6), 3).moved(R, at))
        else:
            plants.append(vegetation.fern(rng).moved(R, at))
    return plants, boulders


def _shade(place: Array, radius_m: float) -> Box:
    """Return the box that casts the shadow of a trunk."""
    half = np.array([0.85 * radius_m, 0.85 * radius_m, 4.0])
    return Box(np.array([*place, 4.0]), half, partial(textures.plain, colour=(0.0, 0.0, 0.0)))


def _floor(rng: Random, height: int, width: int, season: Season) -> Image:
    """Return the floor of the forest with the pad, in the light that falls through the leaves."""
    image = nature.forest_floor(rng, height, width, season.litter, season.moss, _GROUND_PX_PER_M)
    image = outdoors.dappled(rng, image, _GROUND_PX_PER_M / 9.0, 0.45)
    outdoors.lay(image, pictures.landing_pad(round(_PAD_M * _GROUND_PX_PER_M)))
    return image


def _far_floor(rng: Random, height: int, width: int, season: Season) -> Image:
    """Return the floor between the trees further away."""
    seen = [scaled(colour, 0.72) for colour in (*season.litter[:3], season.moss)]  # shadows between the leaves
    image = nature.distance(rng, height, width, tuple(seen))
    return outdoors.dappled(rng, image, 24.0 / 9.0, 0.45)


def _thicket(rng: Random, season: Season) -> Sheet:
    """Return the distant forest, painted on a wall around the world whose upper edge is the treetops."""
    columns = 240
    azimuth = np.linspace(0.0, -2.0 * np.pi, columns + 1)
    tops = nature.periodic_noise(rng, 3, columns, (2, 4, 12))[0]
    grid = np.empty((3, columns + 1, 3))
    grid[..., 0], grid[..., 1] = _THICKET_M * np.cos(azimuth), _THICKET_M * np.sin(azimuth)
    grid[0, :, 2], grid[1, :, 2], grid[2, :, 2] = 11.0 + 0.8 * tops[np.arange(columns + 1) % columns], 5.5, -0.1
    return outdoors.panorama(Instance("thicket"), grid, partial(_depths, season=season), _THICKET_WIDTH_PX)


def _depths(rng: Random, height: int, width: int, season: Season) -> Image:
    """Return trunks in layers that fade with distance, with leaves above and undergrowth below."""
    mist = np.array(season.mist)
    up = np.linspace(1.0, 0.0, height, dtype=np.float32)[:, None, None]
    image = textures.to_image(np.broadcast_to(mist * (0.8 + 0.2 * up), (height, width, 3)).astype(np.float32))
    for depth in np.linspace(0.1, 1.0, 5):
        for _ in range(int(width / (9 + 14 * depth))):
            x, wide = rng.uniform(0, width), (1.0 + 5.0 * depth) * rng.uniform(0.6, 1.4)
            bark = np.array(_BARKS[int(rng.integers(4))]) * rng.uniform(0.5, 1.0)
            ink = (mist * (1 - depth) * 0.9 + bark * (0.1 + 0.9 * depth) * 0.85).tolist()
            foot = int(height * (0.93 + 0.06 * depth))
            cv2.line(image, (int(x), foot), (int(x + rng.uniform(-5, 5)), 0), ink, max(int(wide), 1), cv2.LINE_AA)
        _dabs(rng, image, season.leaves, mist, depth, (0.0, 0.62 - 0.1 * depth), int(width * 3.0))
        _dabs(rng, image, (season.moss, *season.litter[:2]), mist, depth, (0.9 + 0.04 * depth, 1.0), int(width * 0.7))
    light = 1.0 + 0.14 * nature.periodic_noise(rng, height // 8, width // 8, (2, 5, 12))
    return nature.tinted(image, np.repeat(light[..., None], 3, axis=2))


def _dabs(
    rng: Random,
    image: Image,
    colours: tuple[Colour, ...],
    mist: Array,
    depth: float,
    band: tuple[float, float],
    count: int,
) -> None:
    """Paint leaves into a band of rows (fractions of the height), with density decreasing below its middle."""
    height, width = image.shape[:2]
    rows = (band[0] + (band[1] - band[0]) * rng.beta(1.0, 1.6, count)) * height
    for y, x, kind, tone in zip(
        rows,
        rng.uniform(0, width, count),
        rng.integers(0, len(colours), count),
        rng.uniform(0.35, 1.1, count),
        strict=True,
    ):
        ink = (mist * (1 - depth) + np.array(colours[kind]) * tone * depth * 0.9 + mist * tone * 0.1).tolist()
        size = (int(1.5 + 2.6 * depth), int(1 + 1.1 * depth))
        cv2.ellipse(image, (int(x), int(y)), size, 180 * tone * 7, 0, 360, ink, -1)


FOREST = WorldBuilder("tall trees around a clearing, with boulders, bushes and logs", layout, layout_in_daylight=layout)
"""The forest."""
