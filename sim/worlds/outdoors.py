"""Common parts of outdoor worlds: sky, sun, ground, shadows, and random placement."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array, Image
from dronevio.sim.appearance import textures_nature as nature
from dronevio.sim.appearance.instances import Instance
from dronevio.sim.appearance.lightmap import AreaLight
from dronevio.sim.appearance.solids import Box, Paint, Sheet
from dronevio.sim.appearance.textures import Colour

Random = np.random.Generator

_SKY_M = 80.0  # far enough for negligible parallax
_SUN_M = 150.0  # rays are parallel within a few degrees over a world
_SKY_WIDTH_PX = 2560  # full circle, about the resolution of a typical camera
_DOWN_RAD = np.radians(10.0)  # `textures_nature.sky` ends so far below the horizon

_SHADOW = 0.58  # relative light of the sky in shadow


@dataclass(frozen=True)
class Weather:
    """Colours and clouds of the sky."""

    zenith: Colour
    """Colour of the sky overhead."""
    horizon: Colour
    """Colour of the haze at the horizon."""
    cover: float
    """Fraction of the sky covered by clouds, 0 to 1."""
    hills: Colour
    """Colour of the nearest hills."""


WEATHERS: tuple[Weather, ...] = (
    Weather((72, 122, 188), (202, 214, 222), 0.42, (70, 88, 60)),
    Weather((94, 140, 190), (214, 214, 206), 0.30, (84, 94, 62)),
    Weather((120, 144, 168), (208, 210, 210), 0.62, (78, 88, 74)),
    Weather((86, 116, 164), (232, 208, 178), 0.46, (92, 84, 60)),
)
"""Fair weather at different hours."""


def sun(rng: Random) -> Array:
    """Return a unit vector (3,) toward the sun, 35° to 55° above the horizon."""
    azimuth, height = rng.uniform(0.0, 2.0 * np.pi), np.radians(rng.uniform(35.0, 55.0))
    return np.array([np.cos(azimuth) * np.cos(height), np.sin(azimuth) * np.cos(height), np.sin(height)])


def daylight(rng: Random) -> tuple[Weather, Array]:
    """Return the weather and the unit vector (3,) toward the sun at another time."""
    return WEATHERS[int(rng.integers(len(WEATHERS)))], sun(rng)


def sunlight(toward: Array) -> AreaLight:
    """Return the area light of a sun in a direction (3,)."""
    return AreaLight(_SUN_M * toward[None], 1.0 * _SUN_M**2)


def sky(weather: Weather, radius_m: float = _SKY_M) -> Sheet:
    """Return the sky, with hills at the horizon, seen from inside."""
    elevation = np.linspace(0.5 * np.pi, -_DOWN_RAD, 21)
    azimuth = np.linspace(0.0, -2.0 * np.pi, 49)  # from inside, right is clockwise
    ring = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    grid = np.empty((len(elevation), len(azimuth), 3))
    grid[..., :2] = radius_m * np.cos(elevation)[:, None, None] * ring
    grid[..., 2] = radius_m * np.sin(elevation)[:, None]
    return panorama(Instance("sky"), grid, partial(_painted_sky, weather=weather), _SKY_WIDTH_PX)


def panorama(thing: Instance, grid: Array, paint: Paint, width_px: int) -> Sheet:
    """Return a surface (R + 1, C + 1, 3) with emission and a texture of a given width."""
    around = float(np.linalg.norm(np.diff(grid, axis=1), axis=2).sum(axis=1).mean())
    return Sheet(grid, paint, 1.0, width_px / around, thing)


def _painted_sky(rng: Random, height: int, width: int, weather: Weather) -> Image:
    """Return the sky's image."""
    image = nature.sky(rng, height, width, weather.zenith, weather.horizon, weather.cover)
    far = tuple(0.6 * h + 0.4 * n for h, n in zip(weather.horizon, weather.hills, strict=True))
    return nature.ridges(rng, image, (far[0], far[1], far[2]), weather.hills, 0.9)


def dappled(rng: Random, image: Image, cells: float, depth: float) -> Image:
    """Return ground under trees: patches of sunlight between the shadows of leaves.

    Args:
        rng: Draws the patches.
        image: (H, W, 3) The ground.
        cells: Pixels of the image per coarse cell.
        depth: How much darker the shadows are, relative.
    """
    shape = (int(image.shape[0] / cells), int(image.shape[1] / cells))
    light = nature.periodic_noise(rng, *shape, (3, 6, 14))
    light = cv2.GaussianBlur(np.clip(2.2 * (light + 0.15), -1.0, 1.0), (0, 0), 0.8)
    return nature.tinted(image, np.repeat((1.3 - depth * (0.5 - 0.5 * light))[..., None], 3, axis=2))


def lay(image: Image, patch: Image) -> None:
    """Paste a patch onto the centre of an image."""
    top, left = (image.shape[0] - patch.shape[0]) // 2, (image.shape[1] - patch.shape[1]) // 2
    image[top : top + patch.shape[0], left : left + patch.shape[1]] = patch


def flat(low: tuple[float, float], high: tuple[float, float], z: float) -> Array:
    """Return a horizontal rectangle as a grid (2, 2, 3) seen from above, with rows along −y [m]."""
    (x0, y0), (x1, y1) = low, high
    return np.array([[[x0, y1, z], [x1, y1, z]], [[x0, y0, z], [x1, y0, z]]])


def distance_to_legs(points: Array, route: Array) -> Array:
    """Return the horizontal distances of points (N, 2) from the legs of a closed route (R, 2 or 3) [m]."""
    start, way = route[:, :2], np.roll(route, -1, axis=0)[:, :2] - route[:, :2]
    offset = points[:, None] - start
    share = np.clip(np.sum(offset * way, axis=2) / np.maximum(np.sum(way * way, axis=1), 1e-12), 0.0, 1.0)
    return np.asarray(np.linalg.norm(offset - share[..., None] * way, axis=2).min(axis=1))


def scattered(
    rng: Random, low: npt.ArrayLike, high: npt.ArrayLike, tries: int, radii: Array, apart_m: float
) -> tuple[Array, Array]:
    """Place discs at random with at least ``apart_m`` between them.

    Args:
        rng: Draws the places.
        low: (2,) Least corner of where they may be [m].
        high: (2,) Greatest corner [m].
        tries: How many are thrown; those that come too close to an earlier one are dropped.
        radii: (tries,) Their radii [m].
        apart_m: Least gap between two [m].

    Returns:
        Centres (K, 2) and radii (K,).
    """
    thrown = rng.uniform(np.asarray(low), np.asarray(high), (tries, 2))
    kept: list[int] = []
    for k in range(tries):
        gaps = np.linalg.norm(thrown[kept] - thrown[k], axis=1) - radii[kept] - radii[k]
        if np.all(gaps > apart_m):
            kept.append(k)
    return thrown[kept], radii[kept]


def on_ground(image: Image, ppm: float, points: Array) -> Array:
    """Return the positions of points (…, 3) on the texture of a ground around the origin, x along its columns [px]."""
    height, width = image.shape[:2]
    return np.asarray(points[..., :2] * [ppm, -ppm] + [0.5 * width, 0.5 * height])


def shadowed(image: Image, ppm: float, casting: Sequence[Box], toward: Array) -> Image:
    """Return the texture of a ground around the origin with the shadows of boxes.

    Args:
        image: (H, W, 3) The ground.
        ppm: Its resolution [px/m].
        casting: What casts shadows.
        toward: (3,) Unit vector toward the sun.
    """
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
    light = np.ones((image.shape[0] // 2, image.shape[1] // 2), np.float32)
    for box in casting:
        corners = box.centre + (signs * box.half) @ box.R.T
        shade = corners - np.maximum(corners[:, 2:], 0.0) * toward / toward[2]
        outline = cv2.convexHull((0.5 * on_ground(image, ppm, shade)).astype(np.int32))
        cv2.fillConvexPoly(light, outline, _SHADOW)
    light = cv2.GaussianBlur(light, (0, 0), 0.02 * ppm)
    return nature.tinted(image, np.repeat(light[..., None], 3, axis=2))
