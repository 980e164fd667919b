"""Patterns of the outdoors: sky, grass, leaf litter, bark, foliage, stone, all drawn from a seed.

Like `dronevio.sim.textures`, but for things of any size: the resolution is an argument. Where a surface is large, a small
tile carries what is fine and a coarse field, unique everywhere, what is large: millions of pixels in tenths of a second.
"""

from itertools import pairwise

import cv2
import numpy as np
import numpy.typing as npt

from dronevio.sim.textures import Colour, Field, Image, grain, shade, to_image, vary

Random = np.random.Generator
Indices = npt.NDArray[np.intp]

_TILE_PX = 1024


def tiled(tile: Image, height: int, width: int) -> Image:
    """Return a tile repeated over (height, width) px."""
    times = (-(-height // tile.shape[0]), -(-width // tile.shape[1]), 1)
    return np.ascontiguousarray(np.tile(tile, times)[:height, :width])


def closing_grain(rng: Random, height: int, width: int, cells_px: tuple[int, ...]) -> Field:
    """Return fractal noise (height, width) whose opposite borders fit; zero mean, about unit variance."""
    total = np.zeros((height, width), np.float32)
    for cell in cells_px:
        shape = (max(round(height / cell), 3), max(round(width / cell), 3))
        coarse = np.pad(rng.standard_normal(shape, dtype=np.float32), 2, mode="wrap")
        x = (np.arange(width, dtype=np.float32) + 0.5) * (shape[1] / width) + 1.5
        y = (np.arange(height, dtype=np.float32) + 0.5) * (shape[0] / height) + 1.5
        total += cv2.remap(coarse, *np.meshgrid(x, y), cv2.INTER_CUBIC)
    return np.asarray(total / np.float32(np.sqrt(len(cells_px))))


def _on_torus(places: npt.NDArray[np.float64], size: int, reach: int) -> tuple[Indices, npt.NDArray[np.float64]]:
    """Return indices (M,) and places (M, 2) of what is to be drawn on a tile, again where it crosses a border."""
    shifts = np.array([[x, y] for x in (0, size, -size) for y in (0, size, -size)], dtype=np.float64)
    all_places = places[:, None] + shifts
    index, copy = np.nonzero(np.all((all_places > -reach) & (all_places < size + reach), axis=2))
    return index, all_places[index, copy]


def tinted(image: Image, tint: Field) -> Image:
    """Return an image (H, W, 3) multiplied by a coarse field of colours (h, w, 3), interpolated."""
    fine = cv2.resize(tint, (image.shape[1], image.shape[0]), interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.multiply(image, fine, dtype=cv2.CV_8U), dtype=np.uint8)


def mixed(a: Image, b: Image, share: Field) -> Image:
    """Return two images (H, W, 3) mixed by a coarse field (h, w): 0 shows the first, 1 the second."""
    coarse = np.clip(share, 0.0, 1.0).astype(np.float32)
    fine = cv2.resize(coarse, (a.shape[1], a.shape[0]), interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.blendLinear(a, b, 1.0 - fine, fine), dtype=np.uint8)


def grass_tile(rng: Random, colour: Colour, blades: int = 24000, size: int = _TILE_PX) -> Image:
    """Return a square of grass from above: blades of many greens, some dry, over dark earth; it repeats."""
    image = shade(tuple(0.5 * c for c in colour), closing_grain(rng, size, size, (2, 8, 32)), 0.2)
    which, roots = _on_torus(rng.uniform(0, size, (blades, 2)), size, 14)
    angle, length = rng.uniform(0, 2 * np.pi, blades), rng.uniform(4.0, 13.0, blades)
    tips = roots + (length * np.stack([np.cos(angle), np.sin(angle)])).T[which]
    tone = rng.uniform(0.55, 1.3, (blades, 1)) * np.array(colour)
    tone[rng.random(blades) < 0.12] *= [1.35, 1.12, 1.0]  # dry
    inks = np.clip(tone, 0, 255)[which].tolist()
    for root, tip, ink in zip(roots.astype(int).tolist(), tips.astype(int).tolist(), inks, strict=True):
        cv2.line(image, root, tip, ink, 2)
    return image


def litter_tile(rng: Random, colours: tuple[Colour, ...], leaves: int = 6500, size: int = _TILE_PX) -> Image:
    """Return a square of forest floor: fallen leaves over each other, twigs, earth between them; it repeats."""
    image = shade((62, 48, 34), closing_grain(rng, size, size, (2, 8, 32)), 0.25)
    which, places = _on_torus(rng.uniform(0, size, (leaves, 2)), size, 15)
    angles, lengths, tones = rng.uniform(0, 360, leaves), rng.uniform(5, 13, leaves), rng.uniform(0.45, 1.12, leaves)
    inks = np.minimum(tones[:, None] * np.array(colours)[rng.integers(0, len(colours), leaves)], 255.0)
    tips = lengths * np.stack([np.cos(np.radians(angles)), np.sin(np.radians(angles))])
    for i, (x, y) in zip(which.tolist(), places.astype(int).tolist(), strict=True):
        shape = (int(lengths[i]), int(0.48 * lengths[i]))
        cv2.ellipse(image, (x + 1, y + 2), shape, angles[i], 0, 360, (34, 27, 20), -1)
        cv2.ellipse(image, (x, y), shape, angles[i], 0, 360, inks[i].tolist(), -1)
        cv2.line(image, (x, y), (int(x + tips[0, i]), int(y + tips[1, i])), (0.7 * inks[i]).tolist(), 1)
    twigs = leaves // 60
    which, places = _on_torus(rng.uniform(0, size, (twigs, 2)), size, 60)
    angles, lengths = rng.uniform(0, 2 * np.pi, twigs), rng.uniform(15, 60, twigs)
    ends = places + (lengths * np.stack([np.cos(angles), np.sin(angles)])).T[which]
    for (x, y), (u, v) in zip(places.astype(int).tolist(), ends.astype(int).tolist(), strict=True):
        cv2.line(image, (x, y + 2), (u, v + 2), (32, 26, 20), 3)
        cv2.line(image, (x, y), (u, v), (118, 96, 72), 2)
    return image


def forest_floor(rng: Random, height: int, width: int, colours: tuple[Colour, ...], moss: Colour, ppm: float) -> Image:
    """Return leaf litter with patches of moss and grass, and tones that change from place to place."""
    ground = tiled(litter_tile(rng, colours), height, width)
    cell = ppm / 4.0  # the coarse fields have four cells a metre
    coarse = (int(height / cell) + 1, int(width / cell) + 1)
    patches = grain(rng, *coarse, (4, 10, 24))
    green = tiled(grass_tile(rng, moss), height, width)
    ground = mixed(ground, green, 2.2 * (patches - 0.75))
    tone = 1.0 + 0.16 * grain(rng, *coarse, (1, 3, 8, 20))
    hue = 0.05 * grain(rng, *coarse, (3, 9))
    return tinted(ground, np.stack([tone + hue, tone, tone - hue], axis=2).astype(np.float32))


def meadow(rng: Random, height: int, width: int, colour: Colour, ppm: float, mown_m: float = 0.0) -> Image:
    """Return grass with clover, bare and dry patches; with ``mown_m`` in stripes of that width along the columns."""
    ground = tiled(grass_tile(rng, colour), height, width)
    cell = ppm / 4.0
    coarse = (int(height / cell) + 1, int(width / cell) + 1)
    dry = tiled(grass_tile(rng, (168, 150, 92), blades=14000), height, width)
    ground = mixed(ground, dry, 1.6 * (grain(rng, *coarse, (2, 6, 16)) - 0.9))
    tone = 1.0 + 0.11 * grain(rng, *coarse, (1, 3, 8, 20))
    if mown_m > 0.0:
        tone = tone + 0.09 * np.sign(np.sin(np.pi * np.arange(coarse[1]) / (4.0 * mown_m)))
    hue = 0.05 * grain(rng, *coarse, (2, 9))
    return tinted(ground, np.stack([tone + hue, tone, tone - hue], axis=2).astype(np.float32))


def bark(rng: Random, height: int, width: int, colour: Colour) -> Image:
    """Return the bark around a trunk: ridges and fissures upward, knots, lichen, moss near the ground; it closes."""
    tall = cv2.resize(np.abs(closing_grain(rng, height // 12, width, (3, 8))), (width, height))
    warp = cv2.resize(closing_grain(rng, height // 16, width, (8, 24)), (width, height))
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    fissures = cv2.remap(tall, x + 6.0 * warp, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    tone = 1.1 * np.minimum(fissures, 1.3) - 0.75 + 0.3 * closing_grain(rng, height, width, (1, 3, 9, 60))
    image = shade(colour, tone, 0.5)
    lichen = closing_grain(rng, height, width, (4, 14, 50)) > 1.3
    image[lichen] = to_image(0.5 * image[lichen] + 0.5 * np.array([150.0, 160.0, 130.0], np.float32))
    for _ in range(max(height * width // 60000, 2)):
        centre = (int(rng.uniform(0.1, 0.9) * width), int(rng.uniform(0, 0.8) * height))
        wide = rng.uniform(7, 16)
        for radius, f in ((1.0, 0.75), (0.7, 0.3), (0.4, 0.6)):
            axes = (max(int(radius * wide), 1), max(int(1.3 * radius * wide), 1))
            cv2.ellipse(image, centre, axes, 0, 0, 360, tuple(f * c for c in colour), -1, cv2.LINE_AA)
    low = np.linspace(0.0, 1.0, height, dtype=np.float32)[:, None]
    moss = np.clip(6.0 * (low - 0.9) + 0.5 * closing_grain(rng, height, width, (2, 8, 30)), 0.0, 1.0) * (low > 0.75)
    return to_image(image * (1.0 - 0.7 * moss[..., None]) + 0.7 * moss[..., None] * np.array([70.0, 92.0, 44.0]))


def leaves(rng: Random, height: int, width: int, colour: Colour, count: int = 260) -> Image:
    """Return a dense spray of leaves, those behind in the shade of those in front."""
    image = shade(tuple(0.28 * c for c in colour), grain(rng, height, width, (3, 12)), 0.3)
    for depth in np.linspace(0.0, 1.0, count):
        x, y = rng.uniform(0, width), rng.uniform(0, height)
        length, angle = rng.uniform(0.035, 0.06) * width, rng.uniform(0, 360)
        ink = vary(rng, tuple((0.45 + 0.7 * depth) * c for c in colour), 0.14)
        shape = (max(int(length), 2), max(int(0.45 * length), 1))
        cv2.ellipse(image, (int(x), int(y)), shape, angle, 0, 360, ink, -1, cv2.LINE_AA)
        c, s = length * np.cos(np.radians(angle)), length * np.sin(np.radians(angle))
        light = tuple(min(1.25 * v, 255.0) for v in ink)
        cv2.line(image, (int(x - c), int(y - s)), (int(x + c), int(y + s)), light, 1, cv2.LINE_AA)
    return image


def stone(rng: Random, height: int, width: int, colour: Colour) -> Image:
    """Return weathered stone: strata, cracks, lichen and moss."""
    strata = cv2.resize(grain(rng, height, max(width // 12, 2), (2,)), (width, height))
    tone = grain(rng, height, width, (1, 3, 9, 27)) + 0.5 * strata
    image = shade(colour, tone.astype(np.float32), 0.16)
    for _ in range(max(height * width // 9000, 3)):
        x, y, angle = rng.uniform(0, width), rng.uniform(0, height), rng.uniform(0, 2 * np.pi)
        points = [(x, y)]
        for _ in range(6):
            angle += rng.uniform(-0.7, 0.7)
            x, y = x + 9 * np.cos(angle), y + 9 * np.sin(angle)
            points.append((x, y))
        cv2.polylines(image, [np.array(points, np.int32)], False, tuple(0.45 * c for c in colour), 1, cv2.LINE_AA)
    grown = np.clip(grain(rng, height, width, (3, 10, 40)) - 0.9, 0.0, 0.8)[..., None]
    return to_image(image * (1.0 - grown) + grown * np.array([104.0, 122.0, 70.0], np.float32))


def sky(rng: Random, height: int, width: int, zenith: Colour, horizon: Colour, cover: float) -> Image:
    """Return the sky all around: rows from the zenith down to 10° below the horizon, columns once around; it closes.

    Args:
        rng: Draws the clouds.
        height: Rows [px].
        width: Columns [px].
        zenith: Colour overhead.
        horizon: Colour of the haze at the horizon.
        cover: How much of the sky is clouds, 0 to 1.
    """
    elevation = np.linspace(90.0, -10.0, height, dtype=np.float32)
    haze = np.exp(-np.maximum(elevation, 0.0) / 16.0)[:, None, None]
    image = np.asarray(zenith, np.float32) * (1.0 - haze) + np.asarray(horizon, np.float32) * haze
    # clouds lie in a plane overhead: far ones are small and flat
    size = 2048
    plane = grain(rng, size, size, (3, 8, 20, 45, 110, 250)) * 1.25
    edge = (0.62 - cover) * 2.4  # of a normal distribution
    azimuth = np.linspace(0.0, 2.0 * np.pi, width, dtype=np.float32)
    reach = 1.0 / np.tan(np.radians(np.maximum(elevation, 3.5)) * 0.9 + 0.06)
    x = (0.5 + 0.03 * reach[:, None] * np.cos(azimuth)) * size
    y = (0.5 + 0.03 * reach[:, None] * np.sin(azimuth)) * size
    thick = cv2.remap(plane, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)
    lit = cv2.remap(np.roll(plane, (14, 14), (0, 1)), x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)
    share = np.clip(1.3 * (thick - edge), 0.0, 1.0)[..., None] * np.clip((elevation - 4.0) / 8.0, 0.0, 1.0)[:, None, None]
    shadow = np.clip(0.90 + 0.10 * (thick - lit) - 0.10 * np.clip(thick - edge - 0.7, 0.0, 1.0), 0.62, 1.0)[..., None]
    cloud = shadow * np.array([250.0, 249.0, 246.0], np.float32)
    return to_image(image * (1.0 - share) + cloud * share)


def ridges(rng: Random, image: Image, far: Colour, near: Colour, horizon: float, layers: int = 4) -> Image:
    """Return a sky's image with wooded hills along the horizon.

    Args:
        rng: Draws the hills.
        image: (H, W, 3), as `sky` returns it.
        far: Colour of the furthest hills, in the haze.
        near: Colour of the nearest.
        horizon: Row of the horizon, as a fraction of the height.
        layers: How many hills are behind each other.
    """
    height, width = image.shape[:2]
    shown = image.copy()
    for depth in np.linspace(0.0, 1.0, layers):
        half = grain(rng, 1, width // 2, (40, 130, 400))[0] * (1.2 - 0.6 * depth)
        line = np.concatenate([half, half[::-1]]) * 0.012 * height
        line += (horizon - 0.035 + 0.034 * depth) * height
        line -= np.abs(grain(rng, 1, len(line), (2, 5))[0]) * (0.001 + 0.005 * depth) * height  # tree tops
        ink = np.asarray(far) + depth * (np.asarray(near) - np.asarray(far))
        tone = shade(tuple(ink), grain(rng, height, width, (2, 4, 12)), 0.05 + 0.15 * depth)
        covered = np.arange(height)[:, None] > line[None]
        columns = min(width, len(line))
        shown[:, :columns][covered[:, :columns]] = tone[:, :columns][covered[:, :columns]]
    return shown


def stripes_of(colours: tuple[Colour, ...], height: int, width: int) -> Image:
    """Return vertical bands of equal width, one a colour."""
    image = np.empty((height, width, 3), np.uint8)
    edges = np.linspace(0, width, len(colours) + 1).astype(int)
    for (left, right), colour in zip(pairwise(edges), colours, strict=True):
        image[:, left:right] = colour
    return image
