"""Pictures: textures of wall pictures, window views and the landing pad.

As in `dronevio.sim.appearance.textures`, they are (H, W, 3) uint8 RGB images drawn from a seed, with row 0 at the top.
"""

from collections.abc import Callable
from itertools import pairwise

import cv2
import numpy as np

from dronevio.models.arrays import Image
from dronevio.sim.appearance.textures import BOOK_COLOURS, grain, shade, speckle, to_image, vary

Picture = Callable[[np.random.Generator, int, int], Image]
"""Draws an image of the given height and width [px]."""


def landscape(rng: np.random.Generator, height: int, width: int) -> Image:
    """Return hills under a sky with a sun."""
    fade = np.linspace(0.0, 1.0, height, dtype=np.float32)[:, None, None]
    top, low = np.array([70, 120, 180], np.float32), np.array([236, 214, 176], np.float32)
    image = to_image(np.broadcast_to(top + fade * (low - top), (height, width, 3)).astype(np.float32))
    centre = (int(rng.uniform(0.2, 0.8) * width), int(rng.uniform(0.15, 0.4) * height))
    cv2.circle(image, centre, height // 10, (252, 240, 200), -1, cv2.LINE_AA)
    for layer in range(5):
        line = grain(rng, 1, width, (6, 25, 80))[0] * 0.035 * height + (0.4 + 0.13 * layer) * height
        ridge = np.stack([np.arange(width), line], axis=1)
        outline = np.concatenate([ridge, [[width, height], [0, height]]]).astype(np.int32)
        depth = layer / 4.0
        cv2.fillPoly(image, [outline], (118.0 - 70 * depth, 140.0 - 50 * depth, 132.0 - 90 * depth), cv2.LINE_AA)
    return speckle(rng, image, 0.25)


def composition(rng: np.random.Generator, height: int, width: int) -> Image:
    """Return an abstract of bars and blocks in primary colours."""
    image = np.empty((height, width, 3), np.uint8)
    image[:] = (236, 230, 214)
    xs, ys = (np.sort(rng.choice(np.arange(1, 12), 4, replace=False)) / 12.0 for _ in range(2))
    columns, rows = np.r_[0.0, xs, 1.0], np.r_[0.0, ys, 1.0]
    inks = ((188, 38, 34), (28, 62, 140), (232, 186, 50), (30, 30, 32), (236, 230, 214), (236, 230, 214))
    for x0, x1 in pairwise(columns):
        for y0, y1 in pairwise(rows):
            a, b = (int(x0 * width), int(y0 * height)), (int(x1 * width), int(y1 * height))
            cv2.rectangle(image, a, b, inks[int(rng.integers(len(inks)))], -1)
            cv2.rectangle(image, a, b, (24, 22, 22), max(height // 60, 3))
    return image


def circles(rng: np.random.Generator, height: int, width: int) -> Image:
    """Return an abstract of rings and lines."""
    image = shade((226, 216, 196), grain(rng, height, width, (2, 10, 60)), 0.06)
    for _ in range(16):
        centre = (int(rng.uniform(0, width)), int(rng.uniform(0, height)))
        radius = int(rng.uniform(0.03, 0.2) * height)
        for fraction in (1.0, 0.66, 0.33):
            ink = vary(rng, BOOK_COLOURS[int(rng.integers(len(BOOK_COLOURS)))], 0.1)
            cv2.circle(image, centre, max(int(fraction * radius), 1), ink, -1, cv2.LINE_AA)
    for _ in range(8):
        a, b = ((int(rng.uniform(0, width)), int(rng.uniform(0, height))) for _ in range(2))
        cv2.line(image, a, b, (30, 28, 30), max(height // 110, 1), cv2.LINE_AA)
    return image


def chart(rng: np.random.Generator, height: int, width: int) -> Image:
    """Return a map: coast, contour lines, a grid and towns."""
    field = grain(rng, height, width, (20, 60, 150))
    image = np.where(
        field[..., None] > 0.0, np.array([222, 208, 166], np.uint8), np.array([120, 164, 186], np.uint8)
    ).astype(np.uint8)
    for level, ink in ((0.0, (60, 60, 80)), (0.5, (150, 120, 80)), (0.9, (120, 84, 50))):
        outlines, _ = cv2.findContours((field > level).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(image, outlines, -1, ink, 1, cv2.LINE_AA)
    for k in range(1, 6):
        cv2.line(image, (k * width // 6, 0), (k * width // 6, height), (96, 90, 90), 1)
        cv2.line(image, (0, k * height // 6), (width, k * height // 6), (96, 90, 90), 1)
    for x, y in rng.uniform(0.05, 0.95, (22, 2)):
        cv2.circle(image, (int(x * width), int(y * height)), 3, (170, 30, 30), -1, cv2.LINE_AA)
        cv2.line(image, (int(x * width) + 6, int(y * height)), (int(x * width) + 22, int(y * height)), (40, 40, 40), 2)
    return image


PICTURES: tuple[Picture, ...] = (landscape, composition, circles, chart)
"""Pictures on walls."""


def window_view(rng: np.random.Generator, height: int, width: int) -> Image:
    """Return the view through a window: sky, hills, and the bars of the frame."""
    image = to_image(landscape(rng, height, width).astype(np.float32) * 0.8 + 75.0)
    for x in (0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0):
        cv2.line(image, (int(x * width), 0), (int(x * width), height), (240, 238, 232), 14)
        cv2.line(image, (int(x * width) + 8, 0), (int(x * width) + 8, height), (120, 116, 110), 2)
    for y in (0.0, 0.34, 1.0):
        cv2.line(image, (0, int(y * height)), (width, int(y * height)), (240, 238, 232), 14)
        cv2.line(image, (0, int(y * height) + 8), (width, int(y * height) + 8), (120, 116, 110), 2)
    return image


def landing_pad(size: int) -> Image:
    """Return the texture of the square landing pad: a ring and an H."""
    image = np.empty((size, size, 3), np.uint8)
    image[:] = (58, 62, 68)
    centre, stroke = (size // 2, size // 2), size // 16
    cv2.circle(image, centre, int(0.42 * size), (236, 228, 120), stroke, cv2.LINE_AA)
    for x in (0.36, 0.64):
        cv2.line(image, (int(x * size), int(0.3 * size)), (int(x * size), int(0.7 * size)), (240, 240, 236), stroke)
    cv2.line(image, (int(0.36 * size), size // 2), (int(0.64 * size), size // 2), (240, 240, 236), stroke)
    for x, y in ((0.06, 0.06), (0.94, 0.06), (0.06, 0.94), (0.94, 0.94)):
        cv2.circle(image, (int(x * size), int(y * size)), stroke // 2, (236, 228, 120), -1, cv2.LINE_AA)
    return image
