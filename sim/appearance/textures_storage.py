"""Textures of a warehouse: stacks of cartons, sacks, crates, film, pallets, racks, roller doors, hazard stripes."""

from collections.abc import Callable
from itertools import pairwise

import cv2
import numpy as np

from dronevio.models.arrays import Image
from dronevio.sim.appearance.textures import Colour, cardboard, grain, scaled, shade, speckle, to_image, vary
from dronevio.sim.appearance.textures_building import text

Random = np.random.Generator
Load = Callable[[Random, int, int], Image]
"""Function that draws the side of a load with a given height and width [px]."""

_KRAFT: Colour = (182, 144, 100)
_BRANDS: tuple[Colour, ...] = ((40, 80, 140), (170, 50, 40), (44, 110, 70), (60, 60, 66), (200, 130, 40))
_SACKS: tuple[Colour, ...] = ((214, 206, 188), (190, 160, 120), (178, 190, 200))
_INK: Colour = (40, 40, 44)


def cartons(rng: Random, height: int, width: int) -> Image:
    """Return a stack of printed cartons of one size, each with its own shade, label and dents."""
    image = np.empty((height, width, 3), np.uint8)
    rows, columns = int(rng.integers(2, 5)), int(rng.integers(2, 5))
    kraft = vary(rng, _KRAFT, 0.1) if rng.random() < 0.75 else (222.0, 220.0, 212.0)
    brand = vary(rng, _BRANDS[int(rng.integers(len(_BRANDS)))], 0.1)
    mark = int(rng.integers(3))
    ys, xs = (np.linspace(0, v, n + 1).astype(int) for v, n in ((height, rows), (width, columns)))
    for row in range(rows):
        for column in range(columns):
            y0, y1, x0, x1 = ys[row], ys[row + 1], xs[column], xs[column + 1]
            side = shade(vary(rng, kraft, 0.05), grain(rng, y1 - y0, x1 - x0, (1, 4, 20)), 0.05)
            _print(rng, side, brand, mark)
            side[:1] //= 2
            side[:, :1] //= 2
            side[-1:] = side[-1:] // 3
            side[:, -1:] = side[:, -1:] // 3
            image[y0:y1, x0:x1] = side
    return image


def _print(rng: Random, side: Image, brand: Colour, mark: int) -> None:
    """Print a band, a disc or a block of a brand's colour on a carton, tape it, and stick a label on it."""
    height, width = side.shape[:2]
    cv2.rectangle(side, (0, int(0.46 * height)), (width, int(0.54 * height)), scaled(_KRAFT, 1.14), -1)
    if mark == 0:
        cv2.rectangle(side, (0, int(0.72 * height)), (width, int(0.86 * height)), brand, -1)
    elif mark == 1:
        cv2.circle(side, (int(0.28 * width), int(0.28 * height)), max(int(0.16 * height), 2), brand, -1, cv2.LINE_AA)
    else:
        cv2.rectangle(side, (int(0.1 * width), int(0.12 * height)), (int(0.5 * width), int(0.38 * height)), brand, -1)
    x, y = (int(rng.uniform(0.5, 0.66) * width), int(rng.uniform(0.1, 0.6) * height))
    w, h = int(0.28 * width), int(0.24 * height)
    cv2.rectangle(side, (x, y), (x + w, y + h), (238, 236, 230), -1)
    for bar in range(x + 2, x + w - 1, 2):
        if rng.random() < 0.6:
            cv2.line(side, (bar, y + 2), (bar, y + int(0.6 * h)), _INK, 1)
    cv2.line(side, (x + 2, y + int(0.8 * h)), (x + int(0.7 * w), y + int(0.8 * h)), _INK, 1)


def one_carton(rng: Random, height: int, width: int) -> Image:
    """Return the side of one big carton."""
    return cardboard(rng, height, width, vary(rng, _KRAFT, 0.1))


def wrapped(rng: Random, height: int, width: int) -> Image:
    """Return a stack of cartons in stretched film: paler, with glossy folds across."""
    image = cartons(rng, height, width).astype(np.float32) * 0.72 + 52.0
    for _ in range(14):
        y, slope = rng.uniform(0, height), rng.uniform(-0.25, 0.25) * height
        gloss = rng.uniform(0.86, 1.22)
        band = np.zeros((height, width), np.uint8)
        cv2.line(band, (0, int(y)), (width, int(y + slope)), 255, int(rng.integers(1, 4)), cv2.LINE_AA)
        image *= 1.0 + (gloss - 1.0) * band[..., None].astype(np.float32) / 255.0
    return to_image(image)


def sacks(rng: Random, height: int, width: int) -> Image:
    """Return layers of filled sacks, printed with a ring."""
    image = np.empty((height, width, 3), np.uint8)
    image[:] = (48, 44, 40)
    paper = vary(rng, _SACKS[int(rng.integers(len(_SACKS)))], 0.06)
    ink = vary(rng, _BRANDS[int(rng.integers(len(_BRANDS)))], 0.1)
    rows = max(round(height / 26), 2)
    for row in range(rows):
        y = (row + 0.5) * height / rows
        left = -rng.uniform(0.0, 0.4) * width * (row % 2)
        while left < width:
            length = rng.uniform(0.42, 0.52) * width
            centre, axes = (int(left + 0.5 * length), int(y)), (int(0.5 * length), int(0.56 * height / rows))
            cv2.ellipse(image, centre, axes, rng.uniform(-3, 3), 0, 360, vary(rng, paper, 0.07), -1, cv2.LINE_AA)
            cv2.ellipse(image, centre, axes, 0, 20, 160, scaled(paper, 0.62), 2, cv2.LINE_AA)
            cv2.circle(image, centre, int(0.28 * height / rows), ink, 2, cv2.LINE_AA)
            left += length
    return to_image(image * (1.0 + 0.06 * grain(rng, height, width, (1, 3, 8))[..., None]))


def crate(rng: Random, height: int, width: int) -> Image:
    """Return a wooden crate: boards, a frame and diagonal braces, stencilled letters."""
    image = np.empty((height, width, 3), np.uint8)
    board = vary(rng, (176, 140, 92), 0.08)
    count = max(round(height / 18), 3)
    edges = np.linspace(0, height, count + 1).astype(int)
    for top, bottom in pairwise(edges):
        image[top:bottom] = shade(vary(rng, board, 0.08), grain(rng, bottom - top, width, (1, 3, 9)), 0.08)
        image[top] //= 3
    frame, dark = max(height // 9, 4), scaled(board, 0.5)
    for a, b in (((0, 0), (width, height)), ((0, height), (width, 0))):
        cv2.line(image, a, b, dark, frame + 2, cv2.LINE_AA)
        cv2.line(image, a, b, scaled(board, 1.08), frame - 2, cv2.LINE_AA)
    for a, b in (((0, 0), (width - 1, frame)), ((0, height - frame), (width - 1, height - 1))):
        cv2.rectangle(image, a, b, scaled(board, 1.05), -1)
        cv2.rectangle(image, a, b, dark, 1)
    for x in (0, width - frame):
        cv2.rectangle(image, (x, 0), (x + frame, height - 1), scaled(board, 1.02), -1)
        cv2.rectangle(image, (x, 0), (x + frame, height - 1), dark, 1)
    for y in (frame // 2, height - frame // 2):
        for x in np.linspace(0.05, 0.95, 7):
            cv2.circle(image, (int(x * width), y), 1, _INK, -1)
    text(image, f"{int(rng.integers(10, 99))}", (width // 2, int(0.26 * height)), 0.13 * height, _INK)
    return image


LOADS: tuple[Load, ...] = (cartons, wrapped, cartons, sacks, crate, one_carton, cartons)
"""Kinds of loads of pallets; frequent ones are listed more than once."""


def pallet(rng: Random, height: int, width: int) -> Image:
    """Return the side of a pallet: two boards with three blocks between them."""
    image = np.empty((height, width, 3), np.uint8)
    image[:] = (30, 24, 18)
    wood = vary(rng, (170, 136, 94), 0.1)
    tone = grain(rng, height, width, (1, 3))
    for top, bottom in ((0, 0.26), (0.8, 1.0)):
        part = slice(int(top * height), max(int(bottom * height), 1))
        image[part] = shade(wood, tone[part], 0.1)
    for x in (0.0, 0.43, 0.86):
        gap = (slice(int(0.26 * height), int(0.8 * height)), slice(int(x * width), int((x + 0.14) * width)))
        image[gap] = shade(scaled(wood, 0.8), tone[gap], 0.1)
    return image


def beam(rng: Random, height: int, width: int, colour: Colour) -> Image:
    """Return a rack's beam: orange steel with a label at each place."""
    image = speckle(rng, shade(colour, grain(rng, height, width, (2, 12)), 0.05), 0.1)
    image[:1], image[-1:] = image[:1] // 2, image[-1:] // 2
    for x in (0.12, 0.37, 0.62, 0.87):
        x0, w = int((x - 0.05) * width), int(0.1 * width)
        cv2.rectangle(image, (x0, height // 5), (x0 + w, 4 * height // 5), (236, 236, 230), -1)
        for bar in range(x0 + 2, x0 + w - 1, 2):
            if rng.random() < 0.6:
                cv2.line(image, (bar, height // 4), (bar, 3 * height // 4), _INK, 1)
    return image


def upright(rng: Random, height: int, width: int, colour: Colour, px_per_m: float) -> Image:
    """Return a rack's upright: steel with two rows of slots."""
    image = shade(colour, grain(rng, height, width, (2, 15)), 0.06)
    pitch = max(int(0.075 * px_per_m), 3)
    for y in range(0, height, pitch):
        for x in (0.3, 0.7):
            place = (int(x * width), y + pitch // 2)
            cv2.rectangle(image, place, (place[0] + max(width // 8, 1), place[1] + pitch // 2), scaled(colour, 0.3), -1)
    return image


def hazard(rng: Random, height: int, width: int) -> Image:
    """Return yellow and black stripes, worn."""
    y, x = np.mgrid[0:height, 0:width]
    pitch = max(min(height, width), 6)
    dark = ((x + y) // pitch) % 2 == 0
    image = np.where(dark[..., None], np.array([34, 34, 34], np.uint8), np.array([226, 184, 40], np.uint8))
    return speckle(rng, to_image(image * (1.0 + 0.08 * grain(rng, height, width, (1, 4, 12))[..., None])), 0.1)


def roller_door(rng: Random, height: int, width: int, colour: Colour, number: str) -> Image:
    """Return a roller door: slats, two windows, a big number, a dirty lower edge."""
    slat = max(height // 22, 4)
    tone = (np.arange(height, dtype=np.float32) % slat / slat - 0.5)[:, None] + 0.6 * grain(
        rng, height, width, (1, 4, 25)
    )
    image = shade(colour, tone, 0.1)
    image[::slat] = image[::slat] // 2
    for x in (0.2, 0.58):
        a, b = (int(x * width), int(0.36 * height)), (int((x + 0.22) * width), int(0.46 * height))
        cv2.rectangle(image, a, b, (196, 214, 222), -1)
        cv2.rectangle(image, a, b, _INK, 2)
    text(image, number, (width // 2, int(0.17 * height)), 0.15 * height, _INK)
    edge = int(0.95 * height)
    image[edge:] = hazard(rng, height - edge, width)
    return speckle(rng, image, 0.08)


def aisle_sign(rng: Random, height: int, width: int, letter: str) -> Image:
    """Return the sign with the name of an aisle."""
    image = speckle(rng, shade((28, 70, 130), grain(rng, height, width, (3, 20)), 0.04), 0.02)
    text(image, letter, (width // 2, height // 2), 0.6 * height, (244, 244, 240))
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), (244, 244, 240), max(height // 24, 2))
    return image
