"""Outdoor textures: sky, grass, leaf litter, bark, foliage, stone, all drawn from a seed.

They are like those of `dronevio.sim.appearance.textures`, but for objects of any size: the resolution is an argument.
The texture of a large surface is a periodic tile of fine structure, modulated by a coarse field that does not repeat,
which draws millions of pixels in some tenths of a second.
"""

import cv2
import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Image
from dronevio.sim.appearance.textures import Colour, Field, grain, scaled, shade, to_image, vary

Random = np.random.Generator
Indices = npt.NDArray[np.intp]

_TILE_PX = 1024


def tiled(tile: Image, height: int, width: int) -> Image:
    """Return a tile repeated over (height, width) px."""
    times = (-(-height // tile.shape[0]), -(-width // tile.shape[1]), 1)
    return np.ascontiguousarray(np.tile(tile, times)[:height, :width])


def periodic_noise(rng: Random, height: int, width: int, cells_px: tuple[int, ...]) -> Field:
    """Return periodic fractal noise (height, width) of zero mean and about unit variance."""
    total = np.zeros((height, width), np.float32)
    for cell in cells_px:
        shape = (max(round(height / cell), 3), max(round(width / cell), 3))
        coarse = np.pad(rng.standard_normal(shape, dtype=np.float32), 2, mode="wrap")
        x = (np.arange(width, dtype=np.float32) + 0.5) * (shape[1] / width) + 1.5
        y = (np.arange(height, dtype=np.float32) + 0.5) * (shape[0] / height) + 1.5
        columns, rows = np.meshgrid(x, y)
        total += cv2.remap(coarse, columns, rows, cv2.INTER_CUBIC)
    return np.asarray(total / np.float32(np.sqrt(len(cells_px))))


def _on_torus(places: npt.NDArray[np.float64], size: int, reach: int) -> tuple[Indices, npt.NDArray[np.float64]]:
    """Return indices (M,) and positions (M, 2) of objects on a periodic tile, repeated where they cross a border."""
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


def grass_tile(rng: Random, colour: Colour, blades: int = 30000, size: int = _TILE_PX) -> Image:
    """Return a periodic tile of grass from above: blades in many greens, some dry, over dark soil."""
    image = shade(scaled(colour, 0.72), periodic_noise(rng, size, size, (1, 2, 8, 32)), 0.2)
    which, roots = _on_torus(rng.uniform(0, size, (blades, 2)), size, 14)
    angle, length = rng.uniform(0, 2 * np.pi, blades), rng.uniform(4.0, 11.0, blades)
    tips = roots + (length * np.stack([np.cos(angle), np.sin(angle)])).T[which]
    tone = rng.uniform(0.55, 1.3, (blades, 1)) * np.array(colour)
    tone[rng.random(blades) < 0.12] *= [1.35, 1.12, 1.0]  # dry
    inks = np.clip(tone, 0, 255)[which].tolist()
    for root, tip, ink in zip(roots.astype(int).tolist(), tips.astype(int).tolist(), inks, strict=True):
        cv2.line(image, root, tip, ink, 1)
    return image


def litter_tile(rng: Random, colours: tuple[Colour, ...], leaves: int = 15000, size: int = _TILE_PX) -> Image:
    """Return a periodic tile of forest floor: overlapping fallen leaves, twigs, and soil between them."""
    image = shade((84, 66, 48), periodic_noise(rng, size, size, (1, 2, 8, 32)), 0.25)
    which, places = _on_torus(rng.uniform(0, size, (leaves, 2)), size, 15)
    angles, lengths, tones = rng.uniform(0, 360, leaves), rng.uniform(3, 7, leaves), rng.uniform(0.55, 1.25, leaves)
    inks = np.minimum(tones[:, None] * np.array(colours)[rng.integers(0, len(colours), leaves)], 255.0)
    tips = lengths * np.stack([np.cos(np.radians(angles)), np.sin(np.radians(angles))])
    for i, (x, y) in zip(which.tolist(), places.astype(int).tolist(), strict=True):
        shape = (int(lengths[i]), max(int(0.5 * lengths[i]), 1))
        cv2.ellipse(image, (x + 1, y + 1), shape, angles[i], 0, 360, (46, 37, 28), -1)
        cv2.ellipse(image, (x, y), shape, angles[i], 0, 360, inks[i].tolist(), -1)
        cv2.line(image, (x, y), (int(x + tips[0, i]), int(y + tips[1, i])), (0.7 * inks[i]).tolist(), 1)
    twigs = leaves // 100
    which, places = _on_torus(rng.uniform(0, size, (twigs, 2)), size, 45)
    angles, lengths = rng.uniform(0, 2 * np.pi, twigs), rng.uniform(8, 45, twigs)
    ends = places + (lengths * np.stack([np.cos(angles), np.sin(angles)])).T[which]
    for (x, y), (u, v) in zip(places.astype(int).tolist(), ends.astype(int).tolist(), strict=True):
        cv2.line(image, (x, y + 2), (u, v + 2), (46, 38, 30), 2)
        cv2.line(image, (x, y), (u, v), (132, 110, 84), 1)
    return image


def forest_floor(rng: Random, height: int, width: int, colours: tuple[Colour, ...], moss: Colour, ppm: float) -> Image:
    """Return leaf litter with patches of moss and grass and spatially varying tones."""
    ground = tiled(litter_tile(rng, colours), height, width)
    return _varied(rng, ground, tiled(grass_tile(rng, moss), height, width), ppm, (4, 10, 24), 0.75, 0.16)


def _varied(
    rng: Random, image: Image, patches: Image, ppm: float, cells: tuple[int, ...], rarity: float, contrast: float
) -> Image:
    """Return ground with patches of other ground and spatially varying tone and hue.

    Args:
        rng: Source of the patches and tones.
        image: (H, W, 3) The ground.
        patches: (H, W, 3) The other ground.
        ppm: Resolution [px/m].
        cells: Sizes of the patches [0.25 m].
        rarity: Threshold of the noise above which there is a patch, in standard deviations.
        contrast: Relative variation of the tone.
    """
    coarse = (int(4 * image.shape[0] / ppm) + 1, int(4 * image.shape[1] / ppm) + 1)
    ground = mixed(image, patches, 2.0 * (periodic_noise(rng, *coarse, cells) - rarity))
    tone = 1.0 + contrast * periodic_noise(rng, *coarse, (1, 3, 8, 20))
    hue = 0.05 * periodic_noise(rng, *coarse, (2, 9))
    return tinted(ground, np.stack([tone + hue, tone, tone - hue], axis=2))


def meadow(rng: Random, height: int, width: int, colour: Colour, ppm: float) -> Image:
    """Return grass with bare and dry patches."""
    dry = tiled(grass_tile(rng, (168, 150, 92), blades=20000), height, width)
    return _varied(rng, tiled(grass_tile(rng, colour), height, width), dry, ppm, (2, 6, 16), 0.9, 0.11)


def mown(image: Image, stripe_px: float) -> Image:
    """Return grass mown in alternating lighter and darker stripes along its columns."""
    wave = np.sin(np.pi * (np.arange(image.shape[1]) + 0.5) / stripe_px)
    tone = (1.0 + 0.08 * np.tanh(6.0 * wave)).astype(np.float32)
    return np.asarray(
        cv2.multiply(image, np.broadcast_to(tone[None, :, None], image.shape).copy(), dtype=cv2.CV_8U), dtype=np.uint8
    )


def distance(rng: Random, height: int, width: int, colours: tuple[Colour, ...]) -> Image:
    """Return distant ground: patches of some colours."""
    r, g, b = np.mean(colours, axis=0).tolist()
    image = shade((r, g, b), periodic_noise(rng, height, width, (1, 2, 5, 20)), 0.16)
    for colour in colours:
        other = shade(colour, periodic_noise(rng, height, width, (1, 2, 5)), 0.16)
        image = mixed(image, other, periodic_noise(rng, height // 4 + 1, width // 4 + 1, (3, 8, 20)) - 0.3)
    return image


def bark(rng: Random, height: int, width: int, colour: Colour) -> Image:
    """Return the periodic bark of a trunk: vertical ridges and fissures, knots, lichen, moss near the ground."""
    tall = cv2.resize(np.abs(periodic_noise(rng, max(height // 12, 1), width, (3, 8))), (width, height))
    warp = cv2.resize(periodic_noise(rng, max(height // 16, 1), width, (8, 24)), (width, height))
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    fissures = cv2.remap(tall, x + 6.0 * warp, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    tone = 1.1 * np.minimum(fissures, 1.3) - 0.75 + 0.3 * periodic_noise(rng, height, width, (1, 3, 9, 60))
    image = shade(colour, tone, 0.5)
    lichen = periodic_noise(rng, height, width, (4, 14, 50)) > 1.3
    image[lichen] = to_image(0.5 * image[lichen] + 0.5 * np.array([150.0, 160.0, 130.0], np.float32))
    for _ in range(max(height * width // 60000, 2)):
        centre = (int(rng.uniform(0.1, 0.9) * width), int(rng.uniform(0, 0.8) * height))
        wide = rng.uniform(7, 16)
        for radius, f in ((1.0, 0.75), (0.7, 0.3), (0.4, 0.6)):
            axes = (max(int(radius * wide), 1), max(int(1.3 * radius * wide), 1))
            cv2.ellipse(image, centre, axes, 0, 0, 360, scaled(colour, f), -1, cv2.LINE_AA)
    low = np.linspace(0.0, 1.0, height, dtype=np.float32)[:, None]
    moss = np.clip(6.0 * (low - 0.9) + 0.5 * periodic_noise(rng, height, width, (2, 8, 30)), 0.0, 1.0) * (low > 0.75)
    return to_image(image * (1.0 - 0.7 * moss[..., None]) + 0.7 * moss[..., None] * np.array([70.0, 92.0, 44.0]))


def leaves(rng: Random, height: int, width: int, colour: Colour, count: int = 260) -> Image:
    """Return a dense layer of leaves, darker where others occlude them."""
    image = shade(scaled(colour, 0.28), grain(rng, height, width, (3, 12)), 0.3)
    for depth in np.linspace(0.0, 1.0, count):
        x, y = rng.uniform(0, width), rng.uniform(0, height)
        length, angle = rng.uniform(0.035, 0.06) * width, rng.uniform(0, 360)
        ink = vary(rng, scaled(colour, 0.45 + 0.7 * depth), 0.14)
        shape = (max(int(length), 2), max(int(0.45 * length), 1))
        cv2.ellipse(image, (int(x), int(y)), shape, angle, 0, 360, ink, -1, cv2.LINE_AA)
        c, s = length * np.cos(np.radians(angle)), length * np.sin(np.radians(angle))
        light = scaled(ink, 1.25)
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
        cv2.polylines(image, [np.array(points, np.int32)], False, scaled(colour, 0.45), 1, cv2.LINE_AA)
    grown = np.clip(grain(rng, height, width, (3, 10, 40)) - 0.9, 0.0, 0.8)[..., None]
    return to_image(image * (1.0 - grown) + grown * np.array([104.0, 122.0, 70.0], np.float32))


def sky(rng: Random, height: int, width: int, zenith: Colour, horizon: Colour, cover: float) -> Image:
    """Return the panorama of the sky: rows from the zenith to 10° below the horizon, periodic columns.

    Args:
        rng: Source of the clouds.
        height: Number of rows [px].
        width: Number of columns [px].
        zenith: Colour of the sky overhead.
        horizon: Colour of the haze at the horizon.
        cover: Fraction of the sky covered by clouds, 0 to 1.
    """
    elevation = np.linspace(90.0, -10.0, height, dtype=np.float32)
    haze = np.exp(-np.maximum(elevation, 0.0) / 16.0)[:, None, None]
    image = np.asarray(zenith, np.float32) * (1.0 - haze) + np.asarray(horizon, np.float32) * haze
    # clouds lie in a horizontal plane; they are soft, so half the resolution is enough
    size = 1024
    plane = periodic_noise(rng, size, size, (3, 7, 16, 40, 60, 125)) * np.float32(1.25)
    edge = (0.62 - cover) * 2.4  # quantile of a normal distribution
    coarse = elevation[::2]
    azimuth = np.linspace(0.0, 2.0 * np.pi, width // 2, dtype=np.float32)
    reach = 0.03 * size / np.tan(np.radians(np.maximum(coarse, 3.5)) * 0.9 + 0.06)
    x = (0.5 * size + reach[:, None] * np.cos(azimuth)).astype(np.float32)
    y = (0.5 * size + reach[:, None] * np.sin(azimuth)).astype(np.float32)
    thick, toward_light = (cv2.remap(plane, x + d, y + d, cv2.INTER_LINEAR) for d in (0.0, 7.0))
    share = np.clip(1.3 * (thick - edge), 0.0, 1.0) * np.clip((coarse - 4.0) / 8.0, 0.0, 1.0)[:, None]
    dark = np.clip(0.90 + 0.10 * (thick - toward_light) - 0.10 * np.clip(thick - edge - 0.7, 0.0, 1.0), 0.62, 1.0)
    share, dark = (cv2.resize(field, (width, height))[..., None] for field in (share, dark))
    return to_image(image + share * (dark * np.array([250.0, 249.0, 246.0], np.float32) - image))


def ridges(rng: Random, image: Image, far: Colour, near: Colour, horizon: float, layers: int = 4) -> Image:
    """Return a sky's image with wooded hills along the horizon.

    Args:
        rng: Source of the hills.
        image: (H, W, 3) Image of the sky, as `sky` returns it.
        far: Colour of the furthest hills, in the haze.
        near: Colour of the nearest hills.
        horizon: Row of the horizon, as a fraction of the height.
        layers: Number of layers of hills.
    """
    height, width = image.shape[:2]
    shown = image.copy()
    low = shown[int((horizon - 0.12) * height) :]
    for depth in np.linspace(0.0, 1.0, layers):
        line = periodic_noise(rng, 3, width, (40, 130, 400))[1] * (1.2 - 0.6 * depth) * 0.012
        line -= np.abs(periodic_noise(rng, 3, width, (2, 5))[1]) * (0.001 + 0.005 * depth)  # treetops
        top = (line + 0.085 + 0.034 * depth) * height
        r, g, b = (a + depth * (z - a) for a, z in zip(far, near, strict=True))
        tone = periodic_noise(rng, low.shape[0], width, (2, 4, 12))
        covered = np.arange(low.shape[0])[:, None] > top[None]
        low[covered] = shade((r, g, b), tone, 0.05 + 0.15 * depth)[covered]
    return shown
