"""Textures of large buildings: painted corridors, terrazzo, ceiling panels, tiles, marble, doors, boards and signs.

They are like those of `dronevio.sim.appearance.textures`, but their resolution ``px_per_m`` is an argument, because it
depends on the size of the building.
"""

from functools import lru_cache

import cv2
import numpy as np

from dronevio.models.arrays import Image
from dronevio.sim.appearance import pictures
from dronevio.sim.appearance.textures import BOOK_COLOURS, Colour, grain, scaled, shade, speckle, to_image, vary

Random = np.random.Generator

_INK: Colour = (52, 52, 56)
_PAPERS: tuple[Colour, ...] = ((238, 236, 228), (238, 236, 228), (246, 226, 120), (180, 214, 236), (240, 180, 170))


def text(image: Image, words: str, middle: tuple[int, int], height_px: float, ink: Colour) -> None:
    """Write words in capitals of a given height on an image, centred at x, y [px]."""
    scale, stroke = height_px / 22.0, max(round(height_px / 9.0), 1)
    (width, tall), _ = cv2.getTextSize(words, cv2.FONT_HERSHEY_SIMPLEX, scale, stroke)
    corner = (middle[0] - width // 2, middle[1] + tall // 2)
    cv2.putText(image, words, corner, cv2.FONT_HERSHEY_SIMPLEX, scale, ink, stroke, cv2.LINE_AA)


# --- floors, walls, ceilings


def terrazzo(rng: Random, height: int, width: int, colour: Colour, px_per_m: float, slab_m: float = 0.9) -> Image:
    """Return terrazzo: polished slabs with chips of stone."""
    image = shade(colour, grain(rng, height, width, (2, 9, 60)), 0.04)
    for cell_m, threshold, factor in ((0.02, 1.25, 0.7), (0.016, 1.35, 1.22), (0.03, 1.7, 0.5), (0.012, 1.3, 0.8)):
        chips = grain(rng, height, width, (max(cell_m * px_per_m, 1.5),)) > threshold
        image[chips] = np.array(scaled(vary(rng, colour, 0.12), factor), np.uint8)
    slab = slab_m * px_per_m
    for k in range(1, int(width / slab) + 1):
        cv2.line(image, (int(k * slab), 0), (int(k * slab), height), scaled(colour, 0.45), 1)
    for k in range(1, int(height / slab) + 1):
        cv2.line(image, (0, int(k * slab)), (width, int(k * slab)), scaled(colour, 0.45), 1)
    return image


def painted_wall(
    rng: Random, height: int, width: int, colour: Colour, dado: Colour, px_per_m: float, dado_m: float = 1.05
) -> Image:
    """Return the wall of a public building: rough paint, a darker dado with a rail above it, a skirting, scuffs."""
    tone = grain(rng, height, width, (2, 5, 16, 70))
    image = shade(colour, tone, 0.045)
    top = height - int(dado_m * px_per_m)
    image[top:] = shade(dado, tone[top:], 0.075)
    rail, skirting = max(int(0.035 * px_per_m), 3), int(0.1 * px_per_m)
    image[top - rail : top] = shade(scaled(dado, 0.62), tone[top - rail : top], 0.05)
    image[height - skirting :] = shade(scaled(dado, 0.5), tone[height - skirting :], 0.08)
    for _ in range(int(2.0 * width / px_per_m)):  # scuff marks, mostly near the floor
        x, y = int(rng.uniform(0, width)), int(height - abs(rng.normal(0.0, 0.45)) * px_per_m - skirting)
        length, slope = rng.uniform(0.03, 0.2) * px_per_m, rng.uniform(-0.1, 0.1)
        tint = (0.7, 1.25)[int(rng.random() < 0.3)]
        end = (int(x + length), int(y + slope * length))
        cv2.line(image, (x, y), end, scaled(dado if y > top else colour, tint), 1, cv2.LINE_AA)
    return speckle(rng, image, 0.05)


def ceiling_panels(
    rng: Random, height: int, width: int, colour: Colour, px_per_m: float, panel_m: float = 0.6
) -> Image:
    """Return a suspended ceiling: square panels of pitted mineral wool between bars."""
    image = shade(colour, grain(rng, height, width, (1, 30)), 0.02)
    pits = grain(rng, height, width, (max(0.01 * px_per_m, 1.0), max(0.022 * px_per_m, 1.6))) > 1.7
    image[pits] = np.array(scaled(colour, 0.68), np.uint8)
    size = panel_m * px_per_m
    for row in range(int(height / size) + 1):
        for column in range(int(width / size) + 1):
            part = (
                slice(int(row * size), int((row + 1) * size)),
                slice(int(column * size), int((column + 1) * size)),
            )
            image[part] = to_image(image[part] * np.float32(rng.uniform(0.93, 1.03)))
            if rng.random() < 0.04:  # water stain
                centre = (int((column + rng.uniform(0.2, 0.8)) * size), int((row + rng.uniform(0.2, 0.8)) * size))
                cv2.circle(image, centre, int(rng.uniform(0.06, 0.16) * px_per_m), scaled(colour, 0.8), 2, cv2.LINE_AA)
    bar = max(round(0.022 * px_per_m), 2)
    for k in range(int(width / size) + 1):
        cv2.line(image, (int(k * size), 0), (int(k * size), height), scaled(colour, 0.66), bar)
    for k in range(int(height / size) + 1):
        cv2.line(image, (0, int(k * size)), (width, int(k * size)), scaled(colour, 0.66), bar)
    return image


@lru_cache(maxsize=8)
def _one_tile(size: int, joint: int, colour: Colour, grout: Colour) -> Image:
    """Return the glazed tile that a wall repeats: a bevelled edge, a gradient, a joint on the right and below."""
    tile = np.empty((size, size, 3), np.float32)
    tile[:] = grout
    face = size - joint
    x = np.linspace(-1.0, 1.0, face, dtype=np.float32)
    sheen = 1.0 - 0.05 * (x[None] ** 2 + x[:, None] ** 2) + 0.05 * (-x[:, None] - x[None]) / 2.0
    tile[:face, :face] = np.asarray(colour, np.float32) * sheen[..., None]
    tile[0, :face] *= 1.06
    tile[face - 1, :face] *= 0.86
    tile[:face, face - 1] *= 0.9
    return to_image(tile)


def tiles(
    rng: Random,
    height: int,
    width: int,
    colour: Colour,
    px_per_m: float,
    tile_m: float = 0.2,
    checker: Colour | None = None,
) -> Image:
    """Return identical glazed tiles; with ``checker``, of two alternating colours.

    Args:
        rng: Not used, because the texture is deterministic.
        height: Height of the image [px].
        width: Width of the image [px].
        colour: Colour of the tiles.
        px_per_m: Resolution of the image [px/m].
        tile_m: Side length of a tile with its joint [m].
        checker: Colour of every second tile.
    """
    size = round(tile_m * px_per_m)
    joint = max(round(0.008 * px_per_m), 1)
    plain = _one_tile(size, joint, colour, (118.0, 116.0, 112.0))
    other = plain if checker is None else _one_tile(size, joint, checker, (118.0, 116.0, 112.0))
    four = np.vstack([np.hstack([plain, other]), np.hstack([other, plain])])
    repeats = (-(-height // (2 * size)), -(-width // (2 * size)), 1)
    return np.ascontiguousarray(np.tile(four, repeats)[:height, :width])


def marble(rng: Random, height: int, width: int, colour: Colour, px_per_m: float, slab_m: float = 1.0) -> Image:
    """Return slabs of veined marble, each with a different pattern."""
    size = min(int(slab_m * px_per_m), 512)
    block = 3 * size
    warp = grain(rng, block, block, (12, 40, 110))
    vein = np.exp(-np.abs(grain(rng, block, block, (30, 80)) + 0.35 * warp) / 0.07)
    fine = np.exp(-np.abs(grain(rng, block, block, (14, 34)) + 0.2 * warp) / 0.05)
    tone = 0.25 * warp - 3.4 * vein - 1.5 * fine + 0.3 * grain(rng, block, block, (1, 3))
    stone = shade(colour, tone.astype(np.float32), 0.11)
    image = np.empty((height, width, 3), np.uint8)
    for top in range(0, height, size):
        for left in range(0, width, size):
            y, x = rng.integers(0, block - size, 2)
            slab = np.rot90(stone[y : y + size, x : x + size], int(rng.integers(4)))
            slab = to_image(slab.astype(np.float32) * rng.uniform(0.93, 1.05))
            slab[-1:] = slab[-1:] // 2
            slab[:, -1:] = slab[:, -1:] // 2
            image[top : top + size, left : left + size] = slab[: height - top, : width - left]
    return image


def whitewash(rng: Random, height: int, width: int, colour: Colour) -> Image:
    """Return a smooth white wall with almost no texture."""
    clouds = rng.standard_normal((max(height // 160, 2), max(width // 160, 2)), dtype=np.float32)
    return shade(colour, np.asarray(cv2.resize(clouds, (width, height)), np.float32), 0.004)


def concrete(rng: Random, height: int, width: int, colour: Colour, px_per_m: float, slab_m: float = 4.0) -> Image:
    """Return a floor of poured concrete: clouds, stains, pits, tyre marks, cracks and joints."""
    tone = grain(rng, height, width, (1, 3, 9, 30)) + 0.9 * grain(rng, height, width, (0.5 * px_per_m, 1.6 * px_per_m))
    image = shade(colour, tone, 0.055)
    area_m2 = height * width / px_per_m**2
    for _ in range(int(0.25 * area_m2)):
        centre = (int(rng.uniform(0, width)), int(rng.uniform(0, height)))
        axes = (int(rng.uniform(0.03, 0.2) * px_per_m), int(rng.uniform(0.03, 0.12) * px_per_m))
        angle, dark = rng.uniform(0, 180), rng.uniform(0.62, 0.85)
        cv2.ellipse(image, centre, axes, angle, 0, 360, scaled(colour, dark), -1, cv2.LINE_AA)
    for _ in range(int(0.12 * area_m2)):
        _crack(rng, image, scaled(colour, 0.5), px_per_m)
    skid = image.copy()
    for _ in range(int(0.03 * area_m2)):
        start, angle = rng.uniform([0, 0], [width, height]), rng.uniform(-0.2, 0.2) + rng.choice([0.0, 0.5 * np.pi])
        end = start + rng.uniform(1.0, 4.0) * px_per_m * np.array([np.cos(angle), np.sin(angle)])
        cv2.line(skid, start.astype(int).tolist(), end.astype(int).tolist(), scaled(colour, 0.5), int(0.1 * px_per_m))
    cv2.addWeighted(skid, 0.35, image, 0.65, 0.0, dst=image)
    slab = slab_m * px_per_m
    for k in range(1, int(width / slab) + 1):
        cv2.line(
            image, (int(k * slab), 0), (int(k * slab), height), scaled(colour, 0.45), max(round(0.012 * px_per_m), 1)
        )
    for k in range(1, int(height / slab) + 1):
        cv2.line(
            image, (0, int(k * slab)), (width, int(k * slab)), scaled(colour, 0.45), max(round(0.012 * px_per_m), 1)
        )
    return speckle(rng, image, 0.06)


def _crack(rng: Random, image: Image, ink: Colour, px_per_m: float) -> None:
    """Draw a crack along a random walk."""
    steps = int(rng.integers(6, 18))
    turn = np.cumsum(rng.normal(0.0, 0.35, steps)) + rng.uniform(0.0, 2.0 * np.pi)
    way = 0.07 * px_per_m * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    line = rng.uniform([0, 0], [image.shape[1], image.shape[0]]) + np.cumsum(way, axis=0)
    cv2.polylines(image, [line.astype(np.int32)], False, ink, 1, cv2.LINE_AA)


def sheet_metal(rng: Random, height: int, width: int, colour: Colour, px_per_m: float, rib_m: float = 0.3) -> Image:
    """Return profiled metal sheets: ribs, rows of screws, streaks of rain and rust."""
    x = np.arange(width, dtype=np.float32) / (rib_m * px_per_m)
    profile = np.clip(np.abs((x % 1.0) - 0.5) * 8.0 - 1.0, -1.0, 1.0)
    slope = np.gradient(profile) * rib_m * px_per_m / 8.0
    runs = cv2.resize(grain(rng, max(height // 40, 2), width, (2, 6)), (width, height), interpolation=cv2.INTER_CUBIC)
    zinc = grain(rng, height, width, (max(0.02 * px_per_m, 1.5), max(0.035 * px_per_m, 2.0)))
    tone = 0.9 * profile[None] + 1.6 * slope[None] + 0.6 * runs + 1.1 * np.clip(zinc, -1.3, 1.3)
    image = shade(colour, tone.astype(np.float32), 0.075)
    for y in np.arange(0.15 * px_per_m, height, 0.7 * px_per_m):
        for k in range(int(width / (rib_m * px_per_m)) + 1):
            centre = (int((k + 0.5) * rib_m * px_per_m), int(y))
            cv2.circle(image, centre, max(round(0.014 * px_per_m), 1), scaled(colour, 0.45), -1, cv2.LINE_AA)
    for _ in range(int(0.3 * height * width / px_per_m**2)):
        x0, y0 = int(rng.uniform(0, width)), int(rng.uniform(0, height))
        rust = (int(rng.integers(1, 3)), int(rng.uniform(0.05, 0.4) * px_per_m))
        cv2.rectangle(image, (x0, y0), (x0 + rust[0], y0 + rust[1]), vary(rng, (132, 92, 66), 0.1), -1)
    return speckle(rng, image, 0.05)


# --- furniture and equipment


def notice_board(rng: Random, height: int, width: int) -> Image:
    """Return a cork board full of papers, photographs and coloured slips under pins."""
    image = speckle(rng, shade((172, 128, 84), grain(rng, height, width, (1, 2, 5)), 0.13), 0.4)
    for _ in range(int(9.0 * width / height) + 4):
        h = int(rng.uniform(0.16, 0.42) * height)
        w = int(h * rng.uniform(0.65, 1.45))
        x, y = int(rng.uniform(0.02, 0.98) * max(width - w, 1)), int(rng.uniform(0.03, 0.97) * max(height - h, 1))
        image[y + 3 : y + h + 3, x + 3 : x + w + 3] //= 2
        sheet = _paper(rng, h, w)
        image[y : y + h, x : x + w] = sheet[: height - y, : width - x]
        pin = vary(rng, BOOK_COLOURS[int(rng.integers(len(BOOK_COLOURS)))], 0.1)
        cv2.circle(image, (x + w // 2, y + max(h // 14, 2)), max(height // 70, 2), pin, -1, cv2.LINE_AA)
    frame = max(height // 28, 3)
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), (116, 118, 122), 2 * frame)
    cv2.rectangle(image, (frame, frame), (width - 1 - frame, height - 1 - frame), _INK, 1)
    return image


def _paper(rng: Random, height: int, width: int) -> Image:
    """Return a sheet of paper with a heading and lines of text, a table, or a photograph."""
    kind = rng.random()
    if kind < 0.25:
        photo = pictures.PICTURES[int(rng.integers(len(pictures.PICTURES)))](rng, max(height, 24), max(width, 24))
        return np.asarray(cv2.resize(photo, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
    sheet = np.empty((height, width, 3), np.uint8)
    sheet[:] = vary(rng, _PAPERS[int(rng.integers(len(_PAPERS)))], 0.03)
    margin, line = max(width // 10, 2), max(height // 16, 3)
    heading = vary(rng, BOOK_COLOURS[int(rng.integers(len(BOOK_COLOURS)))], 0.2)
    cv2.rectangle(sheet, (margin, 2 * line), (int(rng.uniform(0.5, 0.9) * width), 3 * line), heading, -1)
    for y in range(5 * line, height - line, 2 * line):
        if kind < 0.5:
            cv2.rectangle(sheet, (margin, y), (width - margin, y + 2 * line), (120, 120, 124), 1)
        cv2.line(sheet, (margin, y), (int(rng.uniform(0.4, 0.92) * width), y), _INK, max(line // 3, 1))
    return sheet


def office_door(rng: Random, height: int, width: int, colour: Colour, number: str) -> Image:
    """Return the door of an office: veneer, a strip of wired glass, a plate with a number, handle and kick plate."""
    tone = cv2.resize(grain(rng, max(height // 60, 3), width, (1, 3)), (width, height), interpolation=cv2.INTER_CUBIC)
    image = shade(colour, tone + 0.4 * grain(rng, height, width, (1, 3)), 0.07)
    a, b = (int(0.62 * width), int(0.1 * height)), (int(0.84 * width), int(0.62 * height))
    glass = image[a[1] : b[1], a[0] : b[0]]
    glass[:] = (150, 172, 180)
    for k in range(-4, 14):
        y0 = k * (b[1] - a[1]) // 10
        for slope in (1, -1):
            cv2.line(glass, (0, y0), (b[0] - a[0], y0 + slope * (b[0] - a[0])), (112, 128, 134), 1, cv2.LINE_AA)
    cv2.rectangle(image, a, b, scaled(colour, 0.45), max(width // 40, 2))
    plate = ((int(0.14 * width), int(0.24 * height)), (int(0.5 * width), int(0.33 * height)))
    cv2.rectangle(image, *plate, (226, 226, 222), -1)
    cv2.rectangle(image, *plate, _INK, 1)
    middle = ((plate[0][0] + plate[1][0]) // 2, (plate[0][1] + plate[1][1]) // 2)
    text(image, number, middle, 0.045 * height, _INK)
    cv2.rectangle(image, (0, int(0.9 * height)), (width, height), (158, 160, 162), -1)
    for x in np.linspace(0.06, 0.94, 6):
        for y in (0.915, 0.985):
            cv2.circle(image, (int(x * width), int(y * height)), max(width // 70, 1), (96, 98, 100), -1, cv2.LINE_AA)
    lock = (int(0.9 * width), int(0.53 * height))
    cv2.circle(image, lock, max(width // 26, 2), (196, 196, 190), -1, cv2.LINE_AA)
    cv2.line(image, lock, (lock[0] - width // 9, lock[1]), (196, 196, 190), max(width // 36, 2), cv2.LINE_AA)
    return image


def lockers(rng: Random, height: int, width: int, colour: Colour, px_per_m: float) -> Image:
    """Return a row of lockers: two doors above each other, slots, numbers, a lock each, dents and stickers."""
    image = speckle(rng, shade(colour, grain(rng, height, width, (2, 8, 40)), 0.05), 0.06)
    columns = max(round(width / (0.32 * px_per_m)), 1)
    for column in range(columns):
        for row in range(2):
            x0, x1 = column * width // columns, (column + 1) * width // columns
            y0, y1 = row * height // 2, (row + 1) * height // 2
            cv2.rectangle(image, (x0 + 1, y0 + 1), (x1 - 2, y1 - 2), scaled(colour, 0.4), 2)
            for slot in range(4):
                y = y0 + int((0.1 + 0.035 * slot) * height)
                cv2.line(image, (x0 + (x1 - x0) // 4, y), (x1 - (x1 - x0) // 4, y), scaled(colour, 0.35), 2)
            cv2.circle(image, (x1 - (x1 - x0) // 6, (y0 + y1) // 2), 3, (210, 206, 190), -1, cv2.LINE_AA)
            text(image, f"{2 * column + row + 1:02d}", ((x0 + x1) // 2, y0 + int(0.3 * height)), 0.028 * height, _INK)
            if rng.random() < 0.4:
                side = int(rng.uniform(0.06, 0.12) * px_per_m)
                left, top = x0 + 6, y1 - side - int(rng.uniform(0.02, 0.1) * px_per_m) - 4
                image[top : top + side, left : left + side] = _paper(rng, side, side)[:, : width - left]
    return image


def vending_machine(rng: Random, height: int, width: int, colour: Colour) -> Image:
    """Return the front of a vending machine: lit shelves of cans and packets, a keypad, a flap."""
    image = shade(colour, grain(rng, height, width, (4, 40)), 0.03)
    x0, x1, y0, y1 = int(0.07 * width), int(0.72 * width), int(0.06 * height), int(0.76 * height)
    cv2.rectangle(image, (x0, y0), (x1, y1), (236, 240, 240), -1)
    shelf = (y1 - y0) // 6
    for row in range(6):
        base = y0 + (row + 1) * shelf
        step = (x1 - x0) // 7
        for column in range(7):
            goods = vary(rng, BOOK_COLOURS[int(rng.integers(len(BOOK_COLOURS)))], 0.2)
            left, tall = x0 + column * step + 2, int(rng.uniform(0.5, 0.82) * shelf)
            cv2.rectangle(image, (left, base - tall - 3), (left + step - 5, base - 3), goods, -1)
            cv2.rectangle(image, (left, base - tall // 2), (left + step - 5, base - tall // 3), (240, 236, 226), -1)
        cv2.line(image, (x0, base), (x1, base), _INK, 2)
    cv2.rectangle(image, (x0, y0), (x1, y1), _INK, 3)
    for row in range(4):
        for column in range(3):
            key = (int((0.8 + 0.05 * column) * width), int((0.4 + 0.03 * row) * height))
            cv2.circle(image, key, max(width // 60, 2), (232, 232, 226), -1, cv2.LINE_AA)
    cv2.rectangle(
        image, (int(0.78 * width), int(0.26 * height)), (int(0.94 * width), int(0.34 * height)), (30, 60, 40), -1
    )
    cv2.rectangle(image, (x0, int(0.82 * height)), (x1, int(0.94 * height)), (26, 26, 30), -1)
    return image


def exit_sign(rng: Random, height: int, width: int) -> Image:
    """Return an illuminated exit sign."""
    image = np.empty((height, width, 3), np.uint8)
    image[:] = (20, 132, 70)
    white, side = (244.0, 248.0, 244.0), 1 if rng.random() < 0.5 else -1
    text(image, "EXIT", (width // 2 - side * width // 6, height // 2), 0.42 * height, white)
    tail, head = width // 2 + side * width // 5, width // 2 + side * int(0.42 * width)
    cv2.arrowedLine(
        image, (tail, height // 2), (head, height // 2), white, max(height // 9, 2), cv2.LINE_AA, tipLength=0.4
    )
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), white, max(height // 24, 1))
    return image


def lamp_panel(rng: Random, height: int, width: int, colour: Colour) -> Image:
    """Return a lit ceiling lamp behind a grid of blades."""
    image = shade(colour, grain(rng, height, width, (3, 20)), 0.01)
    pitch = max(min(height, width) // 6, 4)
    for x in range(0, width, pitch):
        cv2.line(image, (x, 0), (x, height), scaled(colour, 0.8), 1)
    for y in range(0, height, pitch):
        cv2.line(image, (0, y), (width, y), scaled(colour, 0.8), 1)
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), scaled(colour, 0.55), max(pitch // 3, 2))
    return image


def hydrant_box(rng: Random, height: int, width: int) -> Image:
    """Return the red cabinet of a fire hose."""
    red = (184.0, 36.0, 30.0)
    image = speckle(rng, shade(red, grain(rng, height, width, (2, 12, 50)), 0.05), 0.05)
    cv2.rectangle(image, (3, 3), (width - 4, height - 4), scaled(red, 0.5), 2)
    centre, radius = (width // 2, int(0.45 * height)), int(0.3 * min(height, width))
    for k in range(5):
        cv2.circle(image, centre, radius * (5 - k) // 5, ((236, 230, 220), scaled(red, 0.7))[k % 2], 3, cv2.LINE_AA)
    text(image, "FIRE", (width // 2, int(0.88 * height)), 0.09 * height, (244, 240, 232))
    return image
