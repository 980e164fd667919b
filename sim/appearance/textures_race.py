"""Textures of a race course: gates, flags, banners, spectators, tents.

They are (H, W, 3) uint8 RGB images drawn from a seed with row 0 at the top, as in `dronevio.sim.appearance.textures`.
Their patterns scale with the size of the image.
"""

from collections.abc import Callable

import cv2
import numpy as np

from dronevio.models.arrays import Image
from dronevio.sim.appearance.textures import Colour, grain, scaled, shade, to_image, vary
from dronevio.sim.appearance.textures_nature import periodic_noise

Random = np.random.Generator
PixelPosition = tuple[int, int]

WHITE: Colour = (236, 234, 228)
BLACK: Colour = (30, 31, 34)
PAINTS: tuple[Colour, ...] = (
    (222, 88, 30),
    (30, 104, 190),
    (214, 40, 54),
    (32, 150, 96),
    (240, 190, 36),
    (128, 60, 160),
    (20, 160, 178),
    (226, 70, 138),
)
"""Colours of high visibility."""
_WORDS = (
    "VIO",
    "APEX",
    "IMU",
    "GATE",
    "LOOP",
    "SWIFT",
    "KALMAN",
    "ROTOR",
    "FOCUS",
    "PIXEL",
    "PARALLAX",
    "DRIFT",
    "YAW",
)


def chequers(rng: Random, height: int, width: int, colour: Colour) -> Image:
    """Return a chequered band of two rows between plain edges, along the longer side."""
    tall = height > width
    long, short = (height, width) if tall else (width, height)
    image = np.empty((short, long, 3), np.uint8)
    image[:] = colour
    edge, count = short // 6, max(round(3.0 * long / short), 2)
    cuts = np.linspace(0, long, count + 1).astype(int)
    rows = (edge, short // 2, short - edge)
    for k in range(count):
        for row in range(2):
            ink = WHITE if (k + row) % 2 else BLACK
            image[rows[row] : rows[row + 1], cuts[k] : cuts[k + 1]] = ink
    return _worn(rng, image.transpose(1, 0, 2) if tall else image)


def bars(rng: Random, height: int, width: int, colour: Colour) -> Image:
    """Return slanting bars of a colour and white."""
    period = 1.5 * min(height, width)
    y, x = np.mgrid[:height, :width]
    white = (x + y) % period < 0.5 * period
    return _worn(rng, np.where(white[..., None], np.array(WHITE), np.array(colour)).astype(np.uint8))


def lettered(rng: Random, height: int, width: int, colour: Colour) -> Image:
    """Return cloth with words and marks, along the longer side."""
    tall = height > width
    long, short = (height, width) if tall else (width, height)
    image = np.empty((short, long, 3), np.uint8)
    image[:] = colour
    ink = WHITE if sum(colour) < 420 else BLACK
    x, pad = int(0.15 * short), int(0.22 * short)
    while x < long - short // 2:
        x = _word(image, _WORDS[int(rng.integers(len(_WORDS)))], (x, pad), short - 2 * pad, ink) + pad
        if rng.random() < 0.7:
            _mark(rng, image, (x + short // 3, short // 2), short // 4, ink)
            x += int(0.95 * short)
    cv2.rectangle(image, (0, 0), (long - 1, short - 1), scaled(colour, 0.55), max(short // 24, 1))
    return _worn(rng, np.rot90(image) if tall else image)


def numbered(rng: Random, height: int, width: int, colour: Colour, number: int) -> Image:
    """Return a panel with a number between chevrons."""
    image = np.empty((height, width, 3), np.uint8)
    image[:] = colour
    size = int(0.7 * height)
    step = max(int(0.7 * height), 4)
    for x in range(-height, width + height, step):
        corners = [[x, 0], [x + step // 2, 0], [x + step // 2 + height // 2, height // 2], [x + step // 2, height]]
        chevron = np.array([*corners, [x, height], [x + height // 2, height // 2]], np.int32)
        cv2.fillPoly(image, [chevron], scaled(colour, 0.6), cv2.LINE_AA)
    half = int(0.75 * height)
    cv2.rectangle(image, (width // 2 - half, 0), (width // 2 + half, height), BLACK, -1)
    _word(image, f"{number:02d}", (width // 2 - int(0.5 * half), (height - size) // 2), size, WHITE)
    return _worn(rng, image)


def banner(rng: Random, height: int, width: int) -> Image:
    """Return an advertisement at the side of a track."""
    colour = vary(rng, (*PAINTS, WHITE, WHITE)[int(rng.integers(len(PAINTS) + 2))], 0.08)
    wide = int(rng.choice([0.0, rng.uniform(0.2, 0.35)]) * width)
    image = np.concatenate([np.full((height, wide, 3), colour), lettered(rng, height, width - wide, colour)], axis=1)
    image = to_image(image)
    if wide > 0:
        other = PAINTS[int(rng.integers(len(PAINTS)))]
        corners = np.array([[0, 0], [wide, 0], [wide - height // 2, height], [0, height]], np.int32)
        cv2.fillPoly(image, [corners], other, cv2.LINE_AA)
        _mark(rng, image, (wide // 3, height // 2), height // 3, WHITE)
    return image


def crowd(rng: Random, height: int, width: int, colour: Colour) -> Image:
    """Return a row of seats with people on most of them."""
    image = shade(scaled(colour, 0.7), grain(rng, height, width, (2, 8)), 0.12)
    seat = max(int(0.62 * height), 5)
    for x in range(seat // 2, width, seat):
        cv2.rectangle(image, (x - seat // 2 + 1, height // 3), (x + seat // 2 - 1, height), colour, -1)
        if rng.random() < 0.25:
            continue
        shirt = vary(rng, (*PAINTS, WHITE, BLACK)[int(rng.integers(len(PAINTS) + 2))], 0.2)
        skin = vary(rng, ((226, 184, 152), (180, 132, 98), (112, 78, 58))[int(rng.integers(3))], 0.06)
        hair = ((44, 34, 28), (110, 80, 50), (196, 160, 100), (24, 22, 22))[int(rng.integers(4))]
        at, head = x + int(rng.uniform(-0.1, 0.1) * seat), int(0.30 * height * rng.uniform(0.85, 1.1))
        body = (max(int(0.36 * seat), 2), int(0.55 * height))
        cv2.ellipse(image, (at, height), body, 0, 180, 360, shirt, -1, cv2.LINE_AA)
        cv2.circle(image, (at, head), max(int(0.17 * height), 1), hair, -1, cv2.LINE_AA)
        cv2.circle(image, (at, head + int(0.05 * height)), max(int(0.14 * height), 1), skin, -1, cv2.LINE_AA)
    return image


def tarpaulin(rng: Random, height: int, width: int, colour: Colour) -> Image:
    """Return stretched cloth: seams, folds, a hem."""
    folds = periodic_noise(rng, height, width, (6, 30, 120))
    image = shade(colour, folds, 0.06)
    for x in range(0, width, max(width // 4, 8)):
        cv2.line(image, (x, 0), (x, height), scaled(colour, 0.75), 2)
    image[-max(height // 16, 2) :] = np.array(scaled(colour, 0.7), np.uint8)
    return image


def bale(rng: Random, height: int, width: int, colour: Colour) -> Image:
    """Return pressed straw with two cords around it."""
    image = shade(scaled(colour, 0.8), grain(rng, height, width, (1, 3, 9)), 0.2)
    for _ in range(height * width // 40):
        x, y, angle = rng.uniform(0, width), rng.uniform(0, height), rng.normal(0.0, 0.4)
        end = (int(x + 14 * np.cos(angle)), int(y + 14 * np.sin(angle)))
        cv2.line(image, (int(x), int(y)), end, vary(rng, colour, 0.2), 1)
    for share in (0.3, 0.7):
        cv2.line(image, (int(share * width), 0), (int(share * width), height), (70, 60, 110), 2)
    return image


def container(rng: Random, height: int, width: int, colour: Colour) -> Image:
    """Return the corrugated side of a shipping container, with a name, numbers and rust."""
    wave = 0.5 + 0.5 * np.cos(2.0 * np.pi * np.arange(width) / max(height / 9.0, 4.0))
    image = shade(colour, np.broadcast_to(0.9 * wave - 0.6, (height, width)).astype(np.float32), 0.3)
    size = height // 5
    _word(image, _WORDS[int(rng.integers(len(_WORDS)))], (height // 5, height // 4), size, WHITE)
    _word(image, f"{int(rng.integers(10**6)):06d}", (max(width - height, 0), height // 8), size // 2, WHITE)
    rust = np.clip(grain(rng, height, width, (2, 7, 30)) - 1.25, 0.0, 1.0)[..., None]
    image = to_image(image * (1.0 - rust) + rust * np.array([112.0, 66.0, 40.0], np.float32))
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), scaled(colour, 0.6), max(height // 24, 2))
    return image


def _word(image: Image, word: str, corner: PixelPosition, size: int, ink: Colour) -> int:
    """Write a word of a given height with its top left corner at (x, y), and return the column of its end."""
    font, thick = cv2.FONT_HERSHEY_DUPLEX, max(size // 9, 1)
    (wide, high), _ = cv2.getTextSize(word, font, 1.0, thick)
    scale = size / max(high, 1)
    cv2.putText(image, word, (corner[0], corner[1] + size), font, scale, ink, thick, cv2.LINE_AA)
    return corner[0] + int(wide * scale)


def _ring(image: Image, centre: PixelPosition, radius: int, ink: Colour) -> None:
    cv2.circle(image, centre, radius, ink, max(radius // 3, 1), cv2.LINE_AA)


def _triangle(image: Image, centre: PixelPosition, radius: int, ink: Colour) -> None:
    angle = np.radians([-90.0, 30.0, 150.0])
    corners = np.array(centre) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    cv2.fillPoly(image, [corners.astype(np.int32)], ink, cv2.LINE_AA)


def _rotors(image: Image, centre: PixelPosition, radius: int, ink: Colour) -> None:
    for x in (-1, 1):
        for y in (-1, 1):
            at = (centre[0] + int(0.62 * x * radius), centre[1] + int(0.62 * y * radius))
            cv2.line(image, centre, at, ink, max(radius // 6, 1), cv2.LINE_AA)
            cv2.circle(image, at, max(int(0.4 * radius), 1), ink, max(radius // 8, 1), cv2.LINE_AA)


_MARKS: tuple[Callable[[Image, PixelPosition, int, Colour], None], ...] = (_ring, _triangle, _rotors)


def _mark(rng: Random, image: Image, centre: PixelPosition, radius: int, ink: Colour) -> None:
    """Draw an emblem."""
    _MARKS[int(rng.integers(len(_MARKS)))](image, centre, max(radius, 2), ink)


def _worn(rng: Random, image: Image) -> Image:
    """Return a print with the unevenness of cloth and some dirt."""
    tone = 1.0 + 0.04 * grain(rng, image.shape[0], image.shape[1], (2, 9, 40))
    return to_image(image * tone[..., None])
