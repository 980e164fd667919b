"""Textures of a machine hall: worn concrete, masonry, sheet metal, machines, tanks, pipes, crates.

They are like those of `dronevio.sim.appearance.textures`, but their resolution is an argument, as in
`dronevio.sim.appearance.textures_nature`.
"""

from itertools import pairwise

import cv2
import numpy as np

from dronevio.models.arrays import Image
from dronevio.sim.appearance.textures import Colour, Field, grain, scaled, shade, speckle, to_image, vary
from dronevio.sim.appearance.textures_nature import periodic_noise, tiled, tinted

Random = np.random.Generator

YELLOW: Colour = (226, 178, 36)
BLACK: Colour = (36, 36, 38)
WHITE: Colour = (226, 224, 216)
RED: Colour = (188, 44, 36)
_RUST = np.array([120.0, 70.0, 42.0], np.float32)


def concrete_floor(rng: Random, height: int, width: int, colour: Colour, ppm: float) -> Image:
    """Return a floor poured in slabs: pits, cracks, stains of oil, tracks of wheels."""
    size = 1024
    tile = shade(colour, periodic_noise(rng, size, size, (1, 2, 6, 24)), 0.07)
    _dots(rng, tile, 1800, 0.75)
    image = tiled(tile, height, width)
    coarse = (int(8 * height / ppm) + 1, int(8 * width / ppm) + 1)
    tone = 1.0 + 0.07 * periodic_noise(rng, *coarse, (2, 8, 30, 70))
    tone -= 0.5 * np.clip(periodic_noise(rng, *coarse, (3, 6, 12)) - 1.6, 0.0, 0.9)  # oil
    for _ in range(7):
        _track(rng, tone)
    hue = 0.03 * periodic_noise(rng, *coarse, (10, 40))
    image = tinted(image, np.stack([tone + hue, tone, tone - hue], axis=2).astype(np.float32))
    for axis, length in ((0, height), (1, width)):
        for at in np.arange(4.0 * ppm, length - ppm, 4.0 * ppm).astype(int):
            lines = image[at - 1 : at + 2] if axis == 0 else image[:, at - 1 : at + 2]
            lines[:] = lines // 2
    for _ in range(int(height * width / ppm**2 / 8)):
        _crack(rng, image, ppm)
    return image


def _dots(rng: Random, image: Image, count: int, factor: float) -> None:
    """Put small pits and pebbles into an image."""
    height, width = image.shape[:2]
    for x, y, r, dark in zip(
        rng.integers(0, width, count),
        rng.integers(0, height, count),
        rng.integers(1, 4, count),
        rng.random(count) < 0.6,
        strict=True,
    ):
        ink = image[y, x] * (factor if dark else 1.0 / (factor + 0.1))
        cv2.circle(image, (int(x), int(y)), int(r), np.clip(ink, 0, 255).tolist(), -1, cv2.LINE_AA)


def _track(rng: Random, tone: Field) -> None:
    """Darken the track of a truck's wheels in a coarse field."""
    height, width = tone.shape
    shadow = np.zeros((height, width), np.float32)
    y, slope = rng.uniform(0.1, 0.9) * height, rng.uniform(-0.2, 0.2)
    x = np.linspace(0, width, 30)
    path = y + slope * (x - 0.5 * width) + 0.05 * height * np.sin(x / width * rng.uniform(3, 9) + rng.uniform(0, 6))
    for offset in (-4.0, 4.0):
        cv2.polylines(shadow, [np.stack([x, path + offset], axis=1).astype(np.int32)], False, 0.13, 2, cv2.LINE_AA)
    tone -= shadow * rng.uniform(0.5, 1.0)


def _crack(rng: Random, image: Image, ppm: float) -> None:
    """Draw a crack."""
    height, width = image.shape[:2]
    steps = int(rng.integers(5, 16))
    angle = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0.0, 0.5, steps))
    path = rng.uniform(0, 1, 2) * [width, height] + np.cumsum(
        0.09 * ppm * np.stack([np.cos(angle), np.sin(angle)], axis=1), axis=0
    )
    cv2.polylines(image, [path.astype(np.int32)], False, (58, 56, 54), 1, cv2.LINE_AA)


def masonry(rng: Random, height: int, width: int, colour: Colour, dado: Colour, ppm: float) -> Image:
    """Return a wall of bricks, painted up to eye height, with soot above."""
    course, length = 0.085 * ppm, 0.26 * ppm
    rows, columns = int(height / course) + 1, int(width / length) + 2
    tone = 1.0 + 0.16 * rng.standard_normal((rows, columns, 1)).astype(np.float32)
    tone = tone * (1.0 + 0.05 * rng.standard_normal((rows, columns, 3)).astype(np.float32))
    wall = np.empty((height, width, 3), np.float32)
    cuts = (np.arange(rows + 1) * course).astype(int)
    for row, (top, bottom) in enumerate(pairwise(cuts)):
        at = ((np.arange(width) + 0.5 * length * (row % 2)) / length).astype(int)
        wall[top:bottom] = (tone[row] * colour)[at]
        joints = np.flatnonzero(np.diff(at)) + 1
        wall[top:bottom, joints] = (150, 144, 134)
        wall[top : top + 1] = (150, 144, 134)
    image = to_image(wall)
    painted = max(height - int(1.7 * ppm), 0)
    image[painted:] = to_image(0.35 * image[painted:] + 0.65 * np.array(dado, np.float32))
    image[painted : painted + max(int(0.07 * ppm), 1)] = scaled(dado, 0.6)
    coarse = (max(int(4 * height / ppm), 3), max(int(4 * width / ppm), 3))
    soot = 1.0 + 0.09 * periodic_noise(rng, *coarse, (1, 3, 9, 20))
    return tinted(image, np.repeat(soot[..., None], 3, axis=2).astype(np.float32))


def profiled_roof(rng: Random, height: int, width: int, colour: Colour, ppm: float) -> Image:
    """Return the roof from below: profiled sheets across, strips of translucent ones between them."""
    x = np.arange(width, dtype=np.float32) / (0.28 * ppm)
    rib = np.broadcast_to(np.abs((x % 1.0) - 0.5) * 2.0 - 0.5, (height, width))
    image = shade(colour, (rib + 0.4 * grain(rng, height, width, (2, 8, 40))).astype(np.float32), 0.3)
    pitch = 4.6 * ppm
    for left in np.arange(0.5 * pitch, width, pitch):
        part = image[int(0.12 * height) : int(0.88 * height), int(left - 0.5 * ppm) : int(left + 0.5 * ppm)]
        part[:] = to_image(0.25 * part + 0.75 * np.array([236.0, 242.0, 244.0], np.float32))
    for y in np.arange(0, height, 1.6 * ppm).astype(int):
        image[y : y + 2] = image[y : y + 2] // 2
    return image


def panes(rng: Random, height: int, width: int) -> Image:
    """Return a factory window: small panes of different tones, some dim, some open, with bars between them."""
    image = np.empty((height, width, 3), np.uint8)
    rows, columns = max(round(height / 26), 2), max(round(width / 30), 2)
    ys, xs = np.linspace(0, height, rows + 1).astype(int), np.linspace(0, width, columns + 1).astype(int)
    for row, (top, bottom) in enumerate(pairwise(ys)):
        for left, right in pairwise(xs):
            daylight: Colour = (214 + 18 * row / rows, 226, 236)
            glass = vary(rng, daylight, 0.05 if rng.random() < 0.8 else 0.22)
            tone = grain(rng, bottom - top, right - left, (3, 12)) + np.linspace(0.8, -0.8, bottom - top)[:, None]
            image[top:bottom, left:right] = shade(glass, tone.astype(np.float32), 0.045)
    for y in ys:
        cv2.line(image, (0, int(y)), (width, int(y)), (70, 78, 76), 3)
    for x in xs:
        cv2.line(image, (int(x), 0), (int(x), height), (70, 78, 76), 3)
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), (58, 66, 64), 6)
    return image


def casing(rng: Random, height: int, width: int, colour: Colour, ppm: float) -> Image:
    """Return the side of a machine: panels with bolts, louvres, hatches, gauges, plates, runs of oil."""
    image = shade(colour, grain(rng, height, width, (1, 4, 16, 60)), 0.055)
    rows, columns = max(round(height / (0.9 * ppm)), 1), max(round(width / (0.8 * ppm)), 1)
    ys, xs = np.linspace(0, height, rows + 1).astype(int), np.linspace(0, width, columns + 1).astype(int)
    for top, bottom in pairwise(ys):
        for left, right in pairwise(xs):
            _panel(rng, image[top:bottom, left:right], colour, ppm)
    return rusty(rng, image, 0.5, ppm)


def _panel(rng: Random, image: Image, colour: Colour, ppm: float) -> None:
    """Draw one panel of a casing."""
    height, width = image.shape[:2]
    tint = vary(rng, (1.0 * 128, 128, 128), 0.07)
    image[:] = to_image(image * (np.array(tint, np.float32) / 128.0))
    dark, light = scaled(colour, 0.45), scaled(colour, 1.35)
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), dark, max(int(0.012 * ppm), 1))
    inset = max(int(0.045 * ppm), 3)
    for x in np.linspace(inset, max(width - inset, inset), max(int(width / (0.2 * ppm)), 2)).astype(int):
        for y in (inset, height - inset):
            cv2.circle(image, (int(x), y), max(int(0.011 * ppm), 1), light, -1, cv2.LINE_AA)
            cv2.circle(image, (int(x) + 1, y + 1), max(int(0.011 * ppm), 1), dark, 1, cv2.LINE_AA)
    if min(height, width) < 0.3 * ppm:
        return
    a, b = (int(0.2 * width), int(0.22 * height)), (int(0.8 * width), int(0.74 * height))
    kind = rng.random()
    if kind < 0.28:
        for y in range(a[1], b[1], max(int(0.05 * ppm), 3)):
            cv2.line(image, (a[0], y), (b[0], y), scaled(colour, 0.3), max(int(0.02 * ppm), 1))
            cv2.line(image, (a[0], y + 2), (b[0], y + 2), light, 1)
    elif kind < 0.5:
        cv2.rectangle(image, a, b, dark, max(int(0.02 * ppm), 1))
        cv2.rectangle(image, (b[0] - 12, (a[1] + b[1]) // 2 - 8), (b[0] - 6, (a[1] + b[1]) // 2 + 8), BLACK, -1)
    elif kind < 0.66:
        for k in range(int(rng.integers(1, 4))):
            gauge(rng, image, (a[0] + int((k + 0.5) * 0.22 * ppm), a[1] + int(0.14 * ppm)), int(0.085 * ppm))
    elif kind < 0.8:
        _plate(rng, image, a, (int(0.34 * ppm), int(0.2 * ppm)))
    elif kind < 0.9:
        _warning(image, ((a[0] + b[0]) // 2, (a[1] + b[1]) // 2), int(0.16 * ppm))


def gauge(rng: Random, image: Image, centre: tuple[int, int], radius: int) -> None:
    """Draw a round instrument."""
    cv2.circle(image, centre, radius, BLACK, -1, cv2.LINE_AA)
    cv2.circle(image, centre, max(int(0.84 * radius), 1), WHITE, -1, cv2.LINE_AA)
    for angle in np.radians(np.arange(-210.0, 31.0, 30.0)):
        way = np.array([np.cos(angle), np.sin(angle)])
        p, q = ((np.array(centre) + f * radius * way).astype(int).tolist() for f in (0.6, 0.76))
        cv2.line(image, p, q, BLACK, 1, cv2.LINE_AA)
    angle = np.radians(rng.uniform(-200.0, 20.0))
    tip = (np.array(centre) + 0.62 * radius * np.array([np.cos(angle), np.sin(angle)])).astype(int).tolist()
    cv2.line(image, centre, tip, RED, max(radius // 9, 1), cv2.LINE_AA)


def _plate(rng: Random, image: Image, corner: tuple[int, int], size: tuple[int, int]) -> None:
    """Draw a maker's plate."""
    (x, y), (w, h) = corner, size
    cv2.rectangle(image, (x, y), (x + w, y + h), (206, 204, 196), -1)
    cv2.rectangle(image, (x, y), (x + w, y + h), BLACK, 1)
    for line in range(y + 4, y + h - 3, 5):
        cv2.line(image, (x + 4, line), (x + int(w * rng.uniform(0.4, 0.92)), line), BLACK, 2)


def _warning(image: Image, centre: tuple[int, int], radius: int) -> None:
    """Draw a warning triangle."""
    angle = np.radians([-90.0, 30.0, 150.0])
    for share, ink in ((1.0, BLACK), (0.8, YELLOW)):
        corners = np.array(centre) + share * radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        cv2.fillPoly(image, [corners.astype(np.int32)], ink, cv2.LINE_AA)
    x, y = centre
    cv2.line(image, (x, y - radius // 3), (x, y + radius // 10), BLACK, max(radius // 8, 1))
    cv2.circle(image, (x, y + radius // 3), max(radius // 12, 1), BLACK, -1)


def rusty(rng: Random, image: Image, amount: float, ppm: float) -> Image:
    """Return a metal surface with spots of rust and dark runs below them."""
    height, width = image.shape[:2]
    spots = np.clip(grain(rng, height, width, (2, 7, 25)) - 2.0 + amount, 0.0, 1.0)[..., None]
    image = to_image(image * (1.0 - spots) + spots * _RUST)
    for _ in range(int(amount * height * width / ppm**2 * 3) + 1):
        x, y = int(rng.uniform(0, width)), int(rng.uniform(0, 0.8) * height)
        run = image[y : y + int(rng.uniform(0.1, 0.6) * ppm), x : x + max(int(0.015 * ppm), 1)]
        run[:] = to_image(run * 0.72)
    return image


def console(rng: Random, height: int, width: int, colour: Colour, ppm: float) -> Image:
    """Return the front of a control cabinet: screens, gauges, rows of lamps and switches, a door below."""
    image = casing_plain(rng, height, width, colour)
    y = int(0.06 * height)
    cv2.rectangle(image, (int(0.08 * width), y), (int(0.55 * width), y + int(0.2 * height)), (24, 40, 46), -1)
    for line in range(y + 6, y + int(0.19 * height), 7):
        end = int((0.1 + 0.42 * rng.random()) * width)
        cv2.line(image, (int(0.1 * width), line), (end, line), (96, 206, 150), 2)
    for k in range(3):
        centre = (int((0.66 + 0.12 * k) * width), y + int(0.08 * height))
        gauge(rng, image, centre, max(int(0.05 * width), 4))
    inks = ((210, 40, 36), (40, 170, 80), (232, 190, 40), (224, 224, 220), (50, 110, 200))
    pitch = max(int(0.085 * ppm), 5)
    for row in range(4):
        for x in range(int(0.1 * width), int(0.92 * width), pitch):
            ink = inks[int(rng.integers(5))]
            cv2.circle(image, (x, int(0.33 * height) + row * pitch), max(int(0.022 * ppm), 2), ink, -1, cv2.LINE_AA)
            cv2.circle(image, (x, int(0.33 * height) + row * pitch), max(int(0.026 * ppm), 2), BLACK, 1, cv2.LINE_AA)
    top = int(0.36 * height) + 4 * pitch
    for k in range(2):
        a, b = (int((0.06 + 0.45 * k) * width), top), (int((0.49 + 0.45 * k) * width), int(0.95 * height))
        cv2.rectangle(image, a, b, scaled(colour, 0.5), 2)
        _warning(image, ((a[0] + b[0]) // 2, a[1] + (b[1] - a[1]) // 3), int(0.1 * ppm))
    return image


def casing_plain(rng: Random, height: int, width: int, colour: Colour) -> Image:
    """Return painted sheet metal with chips and a darker edge."""
    image = speckle(rng, shade(colour, grain(rng, height, width, (1, 4, 16, 60)), 0.05), 0.04)
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), scaled(colour, 0.55), max(min(height, width) // 40, 1))
    return image


def tank_side(rng: Random, height: int, width: int, colour: Colour, ppm: float, number: int) -> Image:
    """Return the lateral surface of a tank: welds, rivets, a number on every side, a scale, runs of rust."""
    image = shade(colour, grain(rng, height, width, (1, 4, 16, 60)), 0.05)
    for share in np.linspace(0.0, 1.0, max(round(height / (1.1 * ppm)), 1) + 1):
        y = int(np.clip(share * height, 0.03 * ppm, height - 0.03 * ppm))
        cv2.rectangle(image, (0, y - int(0.035 * ppm)), (width, y + int(0.035 * ppm)), scaled(colour, 0.8), -1)
        for x in range(0, width, max(int(0.075 * ppm), 4)):
            cv2.circle(image, (x, y), max(int(0.012 * ppm), 1), scaled(colour, 1.3), -1, cv2.LINE_AA)
            cv2.circle(image, (x + 1, y + 1), max(int(0.012 * ppm), 1), scaled(colour, 0.45), 1, cv2.LINE_AA)
    for x in np.linspace(0, width, 5)[:-1]:
        cv2.line(image, (int(x), 0), (int(x), height), scaled(colour, 0.6), 1)
        size = int(0.42 * ppm)
        at = (int(x + 0.09 * width), int(0.42 * height))
        cv2.putText(
            image, f"B{number}", at, cv2.FONT_HERSHEY_DUPLEX, size / 22.0, WHITE, max(size // 8, 1), cv2.LINE_AA
        )
        for y in range(int(0.2 * height), int(0.9 * height), max(int(0.1 * ppm), 4)):
            cv2.line(image, (int(x) + 6, y), (int(x) + 6 + int(0.08 * ppm), y), BLACK, 1)
        _warning(image, (int(x + 0.17 * width), int(0.62 * height)), int(0.15 * ppm))
    return rusty(rng, image, 0.55, ppm)


def pipe(rng: Random, height: int, width: int, colour: Colour, ppm: float) -> Image:
    """Return the lateral surface of a pipe, along its columns: flanges, coloured rings, arrows of flow."""
    image = shade(colour, grain(rng, height, width, (1, 3, 12, 40)), 0.06)
    band = max(int(0.05 * ppm), 2)
    for y in np.arange(rng.uniform(0.2, 0.8) * ppm, height, 1.5 * ppm).astype(int):
        image[y : y + band] = scaled(colour, 0.55)
        image[y + band : y + 2 * band] = scaled(colour, 1.25)
        for x in range(0, width, max(int(0.06 * ppm), 3)):
            cv2.circle(image, (x, y + band // 2), max(band // 4, 1), scaled(colour, 1.4), -1)
        ring = ((230, 228, 220), RED, YELLOW, (40, 96, 170))[int(rng.integers(4))]
        image[y + 5 * band : y + 7 * band] = ring
        arrow = (width // 2, y + 9 * band)
        if y + 13 * band < height:
            cv2.arrowedLine(image, arrow, (width // 2, y + 13 * band), WHITE, max(band // 3, 1), tipLength=0.5)
    return rusty(rng, image, 0.4, ppm)


def hazard(rng: Random, height: int, width: int) -> Image:
    """Return slanting bars of yellow and black, chipped."""
    period = max(2.2 * min(height, width), 8.0)
    y, x = np.mgrid[:height, :width]
    yellow = (x + y) % period < 0.5 * period
    image = np.where(yellow[..., None], np.array(YELLOW), np.array(BLACK)).astype(np.uint8)
    return speckle(rng, to_image(image * (1.0 + 0.06 * grain(rng, height, width, (1, 4, 20))[..., None])), 0.06)


def grating(rng: Random, height: int, width: int, colour: Colour, ppm: float) -> Image:
    """Return a walkway of chequer plate: raised lozenges, worn bright in the middle."""
    image = shade(colour, grain(rng, height, width, (1, 5, 30)), 0.08)
    pitch = max(int(0.07 * ppm), 5)
    for row, y in enumerate(range(0, height, pitch)):
        for column, x in enumerate(range(0, width, pitch)):
            s = (pitch // 3) * (1 if (row + column) % 2 else -1)
            ink = scaled(colour, rng.uniform(1.15, 1.5))
            cv2.line(image, (x - s, y - pitch // 3), (x + s, y + pitch // 3), ink, max(pitch // 5, 1), cv2.LINE_AA)
    return image


def crate(rng: Random, height: int, width: int, colour: Colour, ppm: float) -> Image:
    """Return the side of a wooden crate: boards in a frame, nails, a stencilled number."""
    image = np.empty((height, width, 3), np.uint8)
    boards = np.linspace(0, height, max(round(height / (0.14 * ppm)), 2) + 1).astype(int)
    tone = np.asarray(cv2.resize(grain(rng, height, max(width // 24, 2), (1, 3)), (width, height)), np.float32)
    for top, bottom in pairwise(boards):
        image[top:bottom] = shade(vary(rng, colour, 0.1), np.roll(tone, int(rng.integers(99)), 0)[top:bottom], 0.14)
        image[top : top + 2] = image[top : top + 2] // 3
    frame = max(int(0.09 * ppm), 3)
    dark = scaled(colour, 0.4)
    slat = max(frame, 2)
    cv2.line(image, (0, height), (width, 0), scaled(colour, 0.86), slat)
    for a, b in (((0, 0), (width, frame)), ((0, height - frame), (width, height))):
        cv2.rectangle(image, a, b, vary(rng, colour, 0.08), -1)
        cv2.rectangle(image, a, b, dark, 1)
    for a, b in (((0, 0), (frame, height)), ((width - frame, 0), (width, height))):
        cv2.rectangle(image, a, b, vary(rng, colour, 0.08), -1)
        cv2.rectangle(image, a, b, dark, 1)
    for x in (frame // 2, width - frame // 2):
        for y in boards[:-1] + frame // 2:
            cv2.circle(image, (x, int(y)), 2, (40, 36, 32), -1)
    size = 0.2 * min(height, ppm)
    word = f"{rng.choice(['MH', 'KR', 'NO', 'LOT'])} {int(rng.integers(10, 1000))}"
    at = (int(0.2 * width), int(0.55 * height))
    cv2.putText(
        image, word, at, cv2.FONT_HERSHEY_SIMPLEX, size / 22.0, (44, 38, 34), max(int(size / 9), 1), cv2.LINE_AA
    )
    return to_image(image * (1.0 + 0.05 * grain(rng, height, width, (1, 3, 20))[..., None]))


def drum(rng: Random, height: int, width: int, colour: Colour, ppm: float) -> Image:
    """Return the lateral surface of a steel drum: hoops, a label, dents."""
    image = shade(colour, grain(rng, height, width, (1, 4, 16)), 0.07)
    for share in (0.02, 0.34, 0.66, 0.97):
        y = int(share * height)
        cv2.rectangle(image, (0, y - 3), (width, y + 3), scaled(colour, 1.3), -1)
        cv2.rectangle(image, (0, y + 3), (width, y + 5), scaled(colour, 0.5), -1)
    for x in (int(0.15 * width), int(0.65 * width)):
        _plate(rng, image, (x, int(0.4 * height)), (int(0.24 * ppm), int(0.2 * ppm)))
    return rusty(rng, image, 0.6, ppm)


def roller_door(rng: Random, height: int, width: int, colour: Colour, ppm: float) -> Image:
    """Return a large door of slats, windows in some, a hazard stripe at its foot."""
    image = shade(colour, grain(rng, height, width, (1, 4, 20, 80)), 0.06)
    slat = max(int(0.4 * ppm), 6)
    for row, y in enumerate(range(0, height, slat)):
        image[y : y + 2] = image[y : y + 2] // 2
        image[y + 2 : y + 4] = to_image(image[y + 2 : y + 4] * 1.2)
        if row in (4, 5):
            for x in np.linspace(0.08, 0.8, 6):
                a = (int(x * width), y + slat // 5)
                cv2.rectangle(image, a, (a[0] + int(0.1 * width), y + 4 * slat // 5), (196, 210, 218), -1)
                cv2.rectangle(image, a, (a[0] + int(0.1 * width), y + 4 * slat // 5), BLACK, 2)
    foot = min(max(int(0.25 * ppm), 4), height)
    image[-foot:] = hazard(rng, foot, width)
    size = int(0.9 * ppm)
    at = (int(0.4 * width), int(0.35 * height))
    number = str(int(rng.integers(1, 10)))
    cv2.putText(image, number, at, cv2.FONT_HERSHEY_DUPLEX, size / 22.0, WHITE, max(size // 9, 1), cv2.LINE_AA)
    return rusty(rng, image, 0.45, ppm)


def sign(rng: Random, height: int, width: int, colour: Colour, words: str) -> Image:
    """Return an enamel sign with words, a rim, chips of rust."""
    image = shade(colour, grain(rng, height, width, (2, 9, 50)), 0.04)
    rim, stroke = max(height // 14, 2), max(height // 16, 1)
    cv2.rectangle(image, (rim, rim), (width - rim, height - rim), WHITE, max(rim // 2, 1))
    (wide, high), _ = cv2.getTextSize(words, cv2.FONT_HERSHEY_DUPLEX, 1.0, stroke)
    scale = min(0.5 * height / high, 0.82 * width / wide)
    at = (int(0.5 * (width - scale * wide)), int(0.5 * (height + scale * high)))
    cv2.putText(image, words, at, cv2.FONT_HERSHEY_DUPLEX, scale, WHITE, stroke, cv2.LINE_AA)
    return rusty(rng, image, 0.5, height / 1.2)


def fan(rng: Random, height: int, width: int, colour: Colour) -> Image:
    """Return a fan in its frame: blades behind a grid."""
    image = casing_plain(rng, height, width, colour)
    centre, radius = (width // 2, height // 2), int(0.42 * min(height, width))
    cv2.circle(image, centre, radius, (28, 30, 32), -1, cv2.LINE_AA)
    for angle in np.arange(0.0, 360.0, 60.0) + rng.uniform(0.0, 60.0):
        cv2.ellipse(image, centre, (int(0.9 * radius),) * 2, angle, 0, 34, scaled(colour, 0.8), -1, cv2.LINE_AA)
    for share in (1.0, 0.75, 0.5, 0.25):
        cv2.circle(image, centre, int(share * radius), (170, 172, 170), max(radius // 40, 1), cv2.LINE_AA)
    for angle in np.radians(np.arange(0.0, 180.0, 45.0)):
        way = (radius * np.array([np.cos(angle), np.sin(angle)])).astype(int)
        a, b = ((np.array(centre) + k * way).tolist() for k in (-1, 1))
        cv2.line(image, a, b, (170, 172, 170), max(radius // 40, 1), cv2.LINE_AA)
    cv2.circle(image, centre, radius // 6, scaled(colour, 0.6), -1, cv2.LINE_AA)
    return image
