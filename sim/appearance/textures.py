"""Textures of rooms and furniture: wood, brick, fabric, books and others, all drawn from a seed.

Every texture is an (H, W, 3) uint8 RGB image with row 0 at the top and `PIXELS_PER_M`, one pixel per image pixel at a
distance of 1.8 m. Real surfaces have structure at every scale, on which visual estimators depend: each texture combines
edges, varied elements (so that repetition is never exact) and fractal noise.
"""

from itertools import pairwise
from typing import Protocol

import cv2
import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Image

Field = npt.NDArray[np.float32]
Colour = tuple[float, float, float]


class Pattern(Protocol):
    """Interface of functions that draw a texture of a given colour."""

    def __call__(self, rng: np.random.Generator, height: int, width: int, colour: Colour) -> Image:
        """Return an image of the given height and width [px]."""


PIXELS_PER_M = 256
"""Resolution of the textures [px/m]."""


def grain(rng: np.random.Generator, height: int, width: int, cells_px: tuple[float, ...] = (1, 3, 9, 27)) -> Field:
    """Return fractal noise (height, width) of zero mean and about unit variance; each cell size adds one octave."""
    total = np.zeros((height, width), np.float32)
    for cell in cells_px:
        coarse = rng.standard_normal((int(height / cell) + 2, int(width / cell) + 2), dtype=np.float32)
        total += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC if cell > 1 else cv2.INTER_AREA)
    return np.asarray(total / np.sqrt(len(cells_px)))


def streaks(rng: np.random.Generator, height: int, width: int, length_px: float = 90.0) -> Field:
    """Return noise (height, width) stretched along the rows, like the grain of wood."""
    fine = grain(rng, height, max(int(width / length_px), 2), (1, 4))
    waves = cv2.resize(fine, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.asarray(waves + 0.35 * grain(rng, height, width, (1, 2)))


def scaled(colour: Colour, factor: float) -> Colour:
    """Return a colour with its brightness multiplied by a factor."""
    r, g, b = (min(factor * c, 255.0) for c in colour)
    return r, g, b


def shade(colour: Colour, tone: Field, contrast: float) -> Image:
    """Return a colour modulated by a tone field (H, W): 0 leaves it, ±1 changes it by ``contrast`` (relative)."""
    factor = 1.0 + contrast * tone
    image = np.empty((*tone.shape, 3), np.uint8)
    for channel, level in enumerate(np.asarray(colour, np.float32)):  # faster than all channels at once
        image[..., channel] = np.clip(level * factor, 0.0, 255.0)
    return image


def to_image(values: npt.NDArray[np.float32]) -> Image:
    """Return float grey levels or colours, clipped to 0–255, as bytes."""
    return np.ascontiguousarray(np.clip(values, 0.0, 255.0), dtype=np.uint8)


def vary(rng: np.random.Generator, colour: Colour, amount: float) -> Colour:
    """Return a colour of slightly different brightness and hue."""
    factors = (1.0 + amount * rng.standard_normal()) * (1.0 + 0.16 * amount * rng.standard_normal(3))
    r, g, b = np.clip(np.asarray(colour) * factors, 8.0, 245.0)
    return float(r), float(g), float(b)


# --- floors and walls


def planks(
    rng: np.random.Generator, height: int, width: int, colour: Colour, plank_m: float = 0.14, contrast: float = 0.16
) -> Image:
    """Return wooden boards along the rows, each with its own tone, grain and end joints."""
    rows = max(round(height / (plank_m * PIXELS_PER_M)), 1)
    edges = np.linspace(0, height, rows + 1).astype(int)
    image = np.empty((height, width, 3), np.uint8)
    texture = streaks(rng, height, width)
    for top, bottom in pairwise(edges):
        left = -int(rng.uniform(0.0, 1.2) * PIXELS_PER_M)
        while left < width:
            right = left + int(rng.uniform(0.7, 1.7) * PIXELS_PER_M)
            part = (slice(top, bottom), slice(max(left, 0), max(min(right, width), 0)))
            shift = int(rng.integers(width))
            image[part] = shade(vary(rng, colour, 0.13), np.roll(texture[part], shift, axis=1), contrast)
            if 0 < right < width:
                image[top:bottom, right - 1 : right + 1] = image[top:bottom, right - 1 : right + 1] // 3
            left = right
        image[top : top + 2] = image[top : top + 2] // 3
    return image


def parquet(rng: np.random.Generator, height: int, width: int, colour: Colour, block_m: float = 0.36) -> Image:
    """Return a parquet of square blocks, four staves each, laid crosswise in turn."""
    size = int(block_m * PIXELS_PER_M)
    texture = streaks(rng, size * 8, size * 8)
    image = np.empty((height, width, 3), np.uint8)
    for row, top in enumerate(range(0, height, size)):
        for column, left in enumerate(range(0, width, size)):
            block = np.empty((size, size, 3), np.uint8)
            for stave in range(4):
                lines = slice(stave * size // 4, (stave + 1) * size // 4)
                y, x = rng.integers(0, size * 7, 2)
                block[lines] = shade(vary(rng, colour, 0.11), texture[y : y + size, x : x + size][lines], 0.14)
                block[lines.start : lines.start + 2] //= 2
            if (row + column) % 2:
                block = block.transpose(1, 0, 2)
            image[top : top + size, left : left + size] = block[: height - top, : width - left]
    return image


def bricks(rng: np.random.Generator, height: int, width: int, colour: Colour) -> Image:
    """Return a brick wall in running bond with light joints."""
    course, length, joint = int(0.085 * PIXELS_PER_M), int(0.26 * PIXELS_PER_M), 3
    texture = grain(rng, height, width, (1, 2, 6, 40))
    image = shade((186, 180, 168), texture, 0.06)
    for row, top in enumerate(range(0, height, course)):
        for left in range(-(row % 2) * length // 2, width, length):
            x0, x1, y1 = max(left, 0), left + length - joint, min(top + course - joint, height)
            image[top:y1, x0:x1] = shade(vary(rng, colour, 0.16), texture[top:y1, x0:x1], 0.10)
    return image


def wallpaper(rng: np.random.Generator, height: int, width: int, colour: Colour) -> Image:
    """Return plaster under a print of leaves, buds and dots on a loose grid."""
    image = shade(colour, grain(rng, height, width, (1, 3, 12, 60)), 0.045)
    ink = [vary(rng, tuple(np.asarray(colour) * f), 0.08) for f in (0.55, 0.7, 1.25)]
    pitch = 0.16 * PIXELS_PER_M
    for row in range(int(height / pitch) + 1):
        for column in range(int(width / pitch) + 1):
            x = (column + 0.5 * (row % 2) + rng.uniform(-0.22, 0.22)) * pitch
            y = (row + rng.uniform(-0.22, 0.22)) * pitch
            angle, size = rng.uniform(0, 360), rng.uniform(0.16, 0.33) * pitch
            pick = ink[int(rng.integers(len(ink)))]
            cv2.ellipse(image, (int(x), int(y)), (int(size), int(0.4 * size)), angle, 0, 360, pick, -1, cv2.LINE_AA)
            if rng.random() < 0.5:
                other = (int(x + 1.3 * size), int(y - 0.6 * size))
                cv2.circle(image, other, max(int(0.3 * size), 2), ink[int(rng.integers(len(ink)))], -1, cv2.LINE_AA)
    return image


def stripes(rng: np.random.Generator, height: int, width: int, colour: Colour) -> Image:
    """Return plaster with painted vertical stripes of several widths."""
    tone = grain(rng, height, width, (1, 3, 12, 60))
    image = shade(colour, tone, 0.05)
    left = 0
    while left < width:
        stripe, gap = (int(v * PIXELS_PER_M) for v in (rng.uniform(0.03, 0.12), rng.uniform(0.04, 0.14)))
        part = (slice(None), slice(left, left + stripe))
        image[part] = shade(vary(rng, tuple(np.asarray(colour) * 0.78), 0.07), tone[part], 0.05)
        left += stripe + gap
    return speckle(rng, image, 0.05)


def plaster(rng: np.random.Generator, height: int, width: int, colour: Colour) -> Image:
    """Return rough plaster: trowel marks, stains and pits."""
    tone = grain(rng, height, width, (1, 4, 14, 45, 120)) + 0.5 * streaks(rng, height, width, 40.0)
    return speckle(rng, shade(colour, tone, 0.075), 0.12)


def speckle(rng: np.random.Generator, image: Image, share_per_cell: float) -> Image:
    """Return the image with small darker and lighter marks, ``share_per_cell`` of them in each 4 × 4 cm."""
    height, width = image.shape[:2]
    count = int(share_per_cell * height * width / (0.04 * PIXELS_PER_M) ** 2)
    marked = image.copy()
    for x, y, r, tone in zip(
        rng.integers(0, width, count),
        rng.integers(0, height, count),
        rng.integers(1, 4, count),
        rng.choice([0.68, 0.8, 1.16], count),
        strict=True,
    ):
        mark = np.clip(marked[y, x] * tone, 0, 255)
        cv2.circle(marked, (int(x), int(y)), int(r), tuple(float(c) for c in mark), -1, cv2.LINE_AA)
    return marked


def rug(rng: np.random.Generator, height: int, width: int, colour: Colour) -> Image:
    """Return a woven rug: borders, a field of diamonds and a medallion."""
    palette = [vary(rng, tuple(np.asarray(colour) * f), 0.1) for f in (0.45, 0.75, 1.15)] + [(222.0, 205.0, 170.0)]
    image = np.empty((height, width, 3), np.uint8)
    image[:] = palette[0]
    for inset, ink in ((0.03, 3), (0.05, 1), (0.14, 3), (0.155, 0)):
        border = int(inset * height)
        cv2.rectangle(image, (border, border), (width - border, height - border), palette[ink], -1)
    step = max(int(0.095 * height), 4)
    for y in range(int(0.21 * height), int(0.82 * height), step):
        for x in range(int(0.21 * height), width - int(0.2 * height), step):
            outer, core = (palette[int(i)] for i in rng.choice([1, 2, 3], 2, replace=False))
            _diamond(image, x, y, int(0.44 * step), outer)
            _diamond(image, x, y, int(0.2 * step), core)
    for radius, shade_of in ((0.2, 3), (0.17, 0), (0.12, 2), (0.06, 3)):
        _diamond(image, width // 2, height // 2, int(radius * height), palette[shade_of])
    for x in range(int(0.055 * height), width - int(0.05 * height), step // 2):
        for y in (int(0.1 * height), int(0.9 * height)):
            _diamond(image, x, y, step // 5, palette[int(rng.choice([0, 2, 3]))])
    weave = grain(rng, height, width, (1, 2, 30))
    return to_image(image * (1.0 + 0.09 * weave[..., None]))


def _diamond(image: Image, x: int, y: int, radius: int, colour: Colour) -> None:
    corners = np.array([[x - radius, y], [x, y - radius], [x + radius, y], [x, y + radius]], np.int32)
    cv2.fillConvexPoly(image, corners, colour, cv2.LINE_AA)


# --- furniture


def wood(rng: np.random.Generator, height: int, width: int, colour: Colour) -> Image:
    """Return one piece of wood, its grain along the longer side."""
    tall = height > width
    tone = streaks(rng, *((width, height) if tall else (height, width)))
    image = shade(colour, tone.T if tall else tone, 0.13)
    return speckle(rng, image, 0.02)


def fabric(rng: np.random.Generator, height: int, width: int, colour: Colour) -> Image:
    """Return woven cloth with a loose check."""
    tone = grain(rng, height, width, (1, 2, 5))
    for axis, size in ((0, height), (1, width)):
        phase = rng.uniform(0.0, 2.0 * np.pi)
        wave = np.sign(np.sin(2.0 * np.pi * np.arange(size) / (0.07 * PIXELS_PER_M) + phase))
        tone += 0.8 * np.expand_dims(wave, 1 - axis).astype(np.float32)
    return shade(colour, tone, 0.10)


def plain(rng: np.random.Generator, height: int, width: int, colour: Colour) -> Image:
    """Return a painted or plastic surface with the wear of use."""
    return speckle(rng, shade(colour, grain(rng, height, width, (2, 8, 30)), 0.04), 0.03)


def foliage(rng: np.random.Generator, height: int, width: int, colour: Colour) -> Image:
    """Return the skin of a leaf: a light midrib and veins along the longer side."""
    image = shade(colour, grain(rng, height, width, (2, 6, 20)), 0.14)
    tall = height > width
    canvas = np.ascontiguousarray(image.transpose(1, 0, 2)) if tall else image
    long, short = canvas.shape[1], canvas.shape[0]
    light = tuple(float(min(1.5 * c + 25.0, 255.0)) for c in colour)
    cv2.line(canvas, (0, short // 2), (long, short // 2), light, max(short // 14, 1), cv2.LINE_AA)
    for x in range(0, long, max(long // 7, 4)):
        for tip in (0, short):
            cv2.line(canvas, (x, short // 2), (x + short // 2, tip), light, 1, cv2.LINE_AA)
    return np.ascontiguousarray(canvas.transpose(1, 0, 2)) if tall else canvas


def cardboard(rng: np.random.Generator, height: int, width: int, colour: Colour) -> Image:
    """Return the side of a carton: tape, a label and printed marks."""
    image = shade(colour, grain(rng, height, width, (1, 3, 20)), 0.06)
    tape = tuple(float(min(1.25 * c, 250.0)) for c in colour)
    middle = height // 2
    cv2.rectangle(image, (0, middle - 6), (width, middle + 6), tape, -1)
    x, y = (int(rng.uniform(0.08, 0.5) * v) for v in (width, height))
    w, h = int(0.36 * width), int(0.26 * height)
    cv2.rectangle(image, (x, y), (x + w, y + h), (236, 234, 226), -1)
    for line in range(y + 5, y + h - 4, 6):
        cv2.line(image, (x + 4, line), (x + int(w * rng.uniform(0.4, 0.92)), line), (60, 58, 56), 2)
    for k in range(2):
        left = int((0.62 + 0.16 * k) * width)
        arrow = ((left, int(0.92 * height)), (left, int(0.68 * height)))
        cv2.arrowedLine(image, *arrow, (70, 50, 36), 3, cv2.LINE_AA, tipLength=0.4)
    return image


def books(rng: np.random.Generator, height: int, width: int) -> Image:
    """Return the spines of a row of books, with titles and bands."""
    image = np.zeros((height, width, 3), np.uint8)
    image[:] = (34, 26, 20)
    left = 0
    while left < width:
        thick = int(rng.uniform(0.018, 0.05) * PIXELS_PER_M)
        top = int(rng.uniform(0.0, 0.22) * height)
        cover = vary(rng, BOOK_COLOURS[int(rng.integers(len(BOOK_COLOURS)))], 0.12)
        cv2.rectangle(image, (left, top), (left + thick - 2, height), cover, -1)
        ink = (238.0, 226.0, 190.0) if sum(cover) < 380 else (40.0, 30.0, 30.0)
        for _ in range(int(rng.integers(1, 4))):
            y, h = int(rng.uniform(top, height)), int(rng.integers(2, 6))
            cv2.rectangle(image, (left + 1, y), (left + thick - 3, y + h), ink, -1)
        x, y = left + thick // 2, int(rng.uniform(top + 0.1 * height, 0.5 * height))
        cv2.line(image, (x, y), (x, y + int(0.3 * height)), ink, max(thick // 4, 1))
        left += thick
    return to_image(image * (1.0 + 0.05 * grain(rng, height, width, (1, 4))[..., None]))


BOOK_COLOURS: tuple[Colour, ...] = (
    (150, 40, 36),
    (34, 70, 120),
    (40, 96, 66),
    (196, 160, 70),
    (226, 218, 200),
    (88, 50, 86),
    (60, 60, 66),
    (190, 104, 50),
    (120, 150, 170),
)


def drawers(rng: np.random.Generator, height: int, width: int, colour: Colour) -> Image:
    """Return the front of a chest: panels with bevelled edges and knobs."""
    image = wood(rng, height, width, colour)
    rows, columns = max(round(height / (0.26 * PIXELS_PER_M)), 1), max(round(width / (0.5 * PIXELS_PER_M)), 1)
    dark, light = (tuple(float(min(f * c, 250.0)) for c in colour) for f in (0.45, 1.3))
    for row in range(rows):
        for column in range(columns):
            x0, x1 = (int((column + f) * width / columns) for f in (0.05, 0.95))
            y0, y1 = (int((row + f) * height / rows) for f in (0.09, 0.91))
            cv2.rectangle(image, (x0, y0), (x1, y1), dark, 2, cv2.LINE_AA)
            cv2.rectangle(image, (x0 + 4, y0 + 4), (x1 - 4, y1 - 4), light, 1, cv2.LINE_AA)
            for knob in (0.35, 0.65):
                centre = (int(x0 + knob * (x1 - x0)), (y0 + y1) // 2)
                cv2.circle(image, centre, 5, (205, 190, 140), -1, cv2.LINE_AA)
                cv2.circle(image, centre, 5, (60, 50, 40), 1, cv2.LINE_AA)
    return image


def door(rng: np.random.Generator, height: int, width: int, colour: Colour) -> Image:
    """Return a panelled door with a handle."""
    image = wood(rng, height, width, colour)
    dark, light = (tuple(float(min(f * c, 250.0)) for c in colour) for f in (0.5, 1.25))
    for y0, y1 in ((0.06, 0.3), (0.35, 0.6), (0.66, 0.94)):
        for x0, x1 in ((0.12, 0.46), (0.54, 0.88)):
            a, b = (int(x0 * width), int(y0 * height)), (int(x1 * width), int(y1 * height))
            cv2.rectangle(image, a, b, dark, 3, cv2.LINE_AA)
            cv2.rectangle(image, (a[0] + 6, a[1] + 6), (b[0] - 6, b[1] - 6), light, 2, cv2.LINE_AA)
    handle = (int(0.93 * width), int(0.52 * height))
    cv2.circle(image, handle, 7, (210, 196, 150), -1, cv2.LINE_AA)
    cv2.line(image, handle, (handle[0] - 26, handle[1]), (210, 196, 150), 6, cv2.LINE_AA)
    return image


def radiator(rng: np.random.Generator, height: int, width: int, colour: Colour) -> Image:
    """Return the fins of a radiator."""
    image = plain(rng, height, width, colour)
    for x in range(0, width, 16):
        image[:, x : x + 4] = image[:, x : x + 4] // 2
    image[: height // 14] = image[: height // 14] // 2 + 90
    return image


def lampshade(rng: np.random.Generator, height: int, width: int, colour: Colour) -> Image:
    """Return pleated cloth lit from within."""
    tone = 0.5 * np.sin(2.0 * np.pi * np.arange(width, dtype=np.float32) / 9.0)[None] + grain(
        rng, height, width, (2, 9)
    )
    image = shade(colour, tone, 0.05)
    image[: max(height // 12, 2)] = image[: max(height // 12, 2)] // 2
    image[-max(height // 12, 2) :] = image[-max(height // 12, 2) :] // 2
    return image


def screen(rng: np.random.Generator, height: int, width: int, colour: Colour) -> Image:
    """Return a computer's screen: windows with lines of text and a chart."""
    image = shade(colour, grain(rng, height, width, (20, 60)), 0.1)
    for _ in range(3):
        x, y = (int(rng.uniform(0.03, 0.5) * v) for v in (width, height))
        w, h = (int(rng.uniform(0.3, 0.48) * v) for v in (width, height))
        cv2.rectangle(image, (x, y), (x + w, y + h), (232, 234, 238), -1)
        cv2.rectangle(image, (x, y), (x + w, y + 7), (70, 90, 140), -1)
        for line in range(y + 13, y + h - 4, 6):
            cv2.line(image, (x + 5, line), (x + int(w * rng.uniform(0.3, 0.95)), line), (60, 66, 80), 2)
    bezel = max(height // 30, 2)
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), (22, 22, 24), 2 * bezel)
    return image
