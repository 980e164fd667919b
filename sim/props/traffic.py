"""Moving objects of a concourse: people, carts and banners, and their motions."""

from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from dronevio.models.arrays import Array, Image
from dronevio.models.rotation import pose_matrix, rotation_z
from dronevio.sim.appearance import pictures, textures, textures_storage
from dronevio.sim.appearance.solids import Box
from dronevio.sim.appearance.textures import Colour
from dronevio.sim.props.furniture import METAL, block, pick

Random = np.random.Generator

_SKINS: tuple[Colour, ...] = ((222, 178, 148), (188, 138, 104), (134, 92, 66), (236, 200, 172))
_HAIRS: tuple[Colour, ...] = ((50, 36, 28), (96, 66, 38), (150, 116, 66), (120, 120, 122))
_SHIRTS: tuple[Colour, ...] = (
    (160, 52, 48),
    (50, 84, 140),
    (70, 116, 78),
    (206, 166, 64),
    (200, 196, 188),
    (106, 66, 120),
)
_TROUSERS: tuple[Colour, ...] = ((52, 62, 88), (70, 66, 60), (120, 104, 80), (40, 42, 46))
_STEP_S, _BOB_M, _SWAY_RAD = 0.55, 0.02, 0.06  # of a walking person


@dataclass(frozen=True)
class Lap:
    """Laps around a rectangle with rounded corners at constant speed."""

    half_m: tuple[float, float]
    """Half extents of the rectangle along x and y [m]."""
    radius_m: float
    """Radius of the corners [m]."""
    start: float
    """Initial position as a fraction of a lap."""
    speed_m_s: float
    """Speed along the lap, positive anticlockwise as seen from above [m/s]."""
    bob_m: float = 0.0
    """Height of the vertical oscillation of each step [m]."""

    @property
    def length_m(self) -> float:
        """Length of a lap [m]."""
        return 4.0 * (sum(self.half_m) - 2.0 * self.radius_m) + 2.0 * np.pi * self.radius_m

    def __call__(self, times_s: Array) -> Array:
        """Return poses (M, 4, 4) at times (M,) [s]; y is the direction of motion."""
        times_s = np.asarray(times_s, dtype=np.float64)
        r, (a, b) = self.radius_m, (v - self.radius_m for v in self.half_m)
        arc = 0.5 * np.pi * r
        lengths = np.array([2.0 * b, arc, 2.0 * a, arc, 2.0 * b, arc, 2.0 * a, arc])
        ends = np.concatenate([[0.0], np.cumsum(lengths)])
        s = np.mod(self.start * ends[-1] + self.speed_m_s * times_s, ends[-1])
        part = np.clip(np.searchsorted(ends, s, side="right") - 1, 0, 7)
        side, along = part // 2, s - ends[part]
        turned = np.where(part % 2 == 1, along / r, 0.0)
        # Each quarter in its own frame: straight along +y at x = reach + r, then a corner to the left.
        reach, half = np.where(side % 2 == 0, a, b), np.where(side % 2 == 0, b, a)
        x = reach + r * np.cos(turned)
        y = np.where(part % 2 == 1, half + r * np.sin(turned), along - half)
        c, n = np.cos(0.5 * np.pi * side), np.sin(0.5 * np.pi * side)
        step = np.abs(np.sin(np.pi * times_s / _STEP_S))
        sway = np.sign(self.bob_m) * _SWAY_RAD * np.sin(np.pi * times_s / _STEP_S)
        heading = 0.5 * np.pi * side + turned + sway + (np.pi if self.speed_m_s < 0.0 else 0.0)
        poses = np.tile(np.eye(4), (len(times_s), 1, 1))
        poses[:, :3, 3] = np.stack([c * x - n * y, n * x + c * y, self.bob_m * step], axis=1)
        poses[:, 0, 0] = poses[:, 1, 1] = np.cos(heading)
        poses[:, 1, 0] = np.sin(heading)
        poses[:, 0, 1] = -poses[:, 1, 0]
        return poses


@dataclass(frozen=True)
class Swing:
    """Pendulum motion about the horizontal x axis of an object that hangs below it."""

    pivot_m: tuple[float, float, float]
    """Position of the axis [m]."""
    heading_rad: float
    """Heading of the axis in the world [rad]."""
    amplitude_rad: float
    """Amplitude to either side [rad]."""
    period_s: float
    """Period of the oscillation [s]."""
    phase_rad: float = 0.0
    """Phase at the start of the flight [rad]."""

    def __call__(self, times_s: Array) -> Array:
        """Return poses (M, 4, 4) at times (M,) [s]."""
        angle = self.amplitude_rad * np.sin(2.0 * np.pi * np.asarray(times_s) / self.period_s + self.phase_rad)
        c, s = np.cos(angle), np.sin(angle)
        tilts = np.tile(np.eye(4), (len(angle), 1, 1))
        tilts[:, 1, 1] = tilts[:, 2, 2] = c
        tilts[:, 1, 2], tilts[:, 2, 1] = -s, s
        return np.asarray(pose_matrix(rotation_z(self.heading_rad), np.array(self.pivot_m)) @ tilts)


def person(rng: Random) -> tuple[Box, ...]:
    """Return a person who walks along y, upright at the origin."""
    skin, hair, shirt = pick(rng, _SKINS), pick(rng, _HAIRS), pick(rng, _SHIRTS)
    cloth, jeans = partial(_shirt, colour=shirt), partial(textures.fabric, colour=pick(rng, _TROUSERS))
    bare, crop = partial(textures.plain, colour=skin), partial(textures.plain, colour=hair)
    shoe = partial(textures.plain, colour=(40, 38, 36))
    k = rng.uniform(0.93, 1.06)
    boxes = []
    for s in (-1, 1):
        boxes.append(block(s * 0.1, s * 0.14, 0.08, 0.16, 0.18, 0.8, jeans))
        boxes.append(block(s * 0.1, s * 0.14 + 0.05, 0.0, 0.13, 0.3, 0.08, shoe))
        boxes.append(block(s * 0.27, -s * 0.09, 0.86, 0.11, 0.15, 0.6, cloth))
        boxes.append(block(s * 0.27, -s * 0.06, 0.74, 0.09, 0.11, 0.12, bare))
    boxes.append(block(0.0, 0.0, 0.86, 0.42, 0.25, 0.6, cloth, cloth))
    boxes.append(block(0.0, 0.0, 1.46, 0.12, 0.12, 0.07, bare))
    boxes.append(block(0.0, 0.01, 1.51, 0.19, 0.22, 0.25, crop, partial(_face, colour=skin, hair=hair)))
    if rng.random() < 0.5:
        boxes.append(block(0.0, -0.22, 0.95, 0.32, 0.18, 0.44, partial(textures.fabric, colour=pick(rng, _SHIRTS))))
    else:
        boxes.append(block(0.36, -0.08, 0.42, 0.1, 0.34, 0.28, partial(textures.fabric, colour=pick(rng, _TROUSERS))))
    return tuple(Box(box.centre * k, box.half * k, box.paint, box.front, box.R) for box in boxes)


def _shirt(rng: Random, height: int, width: int, colour: Colour) -> Image:
    """Return a shirt: checked, striped, or with a print on its chest."""
    kind = rng.random()
    if kind < 0.35:
        return textures.fabric(rng, height, width, colour)
    image = textures.shade(colour, textures.grain(rng, height, width, (1, 2, 6)), 0.08)
    if kind < 0.65:
        for y in range(0, height, max(height // 12, 4)):
            image[y : y + max(height // 24, 2)] = image[y : y + max(height // 24, 2)] // 2
    else:
        centre, radius = (width // 2, int(0.4 * height)), max(min(height, width) // 4, 2)
        cv2.circle(image, centre, radius, (236, 232, 220), -1, cv2.LINE_AA)
        cv2.circle(image, centre, radius // 2, textures.vary(rng, (60, 60, 70), 0.4), -1, cv2.LINE_AA)
    return image


def _face(rng: Random, height: int, width: int, colour: Colour, hair: Colour) -> Image:
    """Return a face."""
    image = textures.shade(colour, textures.grain(rng, height, width, (3, 10)), 0.04)
    image[: height // 4] = hair
    for x in (0.3, 0.7):
        eye = (int(x * width), int(0.46 * height))
        cv2.ellipse(
            image, eye, (max(width // 10, 1), max(height // 22, 1)), 0, 0, 360, (244, 242, 238), -1, cv2.LINE_AA
        )
        cv2.circle(image, eye, max(width // 22, 1), (46, 36, 30), -1, cv2.LINE_AA)
        brow = (eye[0], eye[1] - height // 10)
        cv2.line(image, (brow[0] - width // 9, brow[1]), (brow[0] + width // 9, brow[1]), hair, max(height // 30, 1))
    cv2.line(image, (width // 2, height // 2), (width // 2, int(0.64 * height)), tuple(0.8 * c for c in colour), 2)
    cv2.line(image, (int(0.36 * width), int(0.8 * height)), (int(0.64 * width), int(0.8 * height)), (150, 70, 66), 2)
    return image


def cart(rng: Random) -> tuple[Box, ...]:
    """Return a trolley piled with cartons and cases, along y."""
    steel = partial(textures.plain, colour=METAL)
    boxes = [block(0.0, 0.0, 0.2, 0.7, 1.2, 0.06, steel)]
    boxes += [block(sx * 0.28, sy * 0.45, 0.0, 0.06, 0.18, 0.2, steel) for sx in (-1, 1) for sy in (-1, 1)]
    boxes += [block(sx * 0.32, -0.58, 0.26, 0.04, 0.04, 0.85, steel) for sx in (-1, 1)]
    boxes.append(block(0.0, -0.58, 1.07, 0.68, 0.04, 0.04, steel))
    for y in (-0.28, 0.3):
        z = 0.26
        for _ in range(int(rng.integers(2, 4))):
            w, d, h = rng.uniform(0.46, 0.64), rng.uniform(0.44, 0.54), rng.uniform(0.26, 0.42)
            paint = (textures_storage.cartons, textures_storage.one_carton, textures_storage.crate)[
                int(rng.integers(3))
            ]
            boxes.append(block(rng.uniform(-0.03, 0.03), y, z, w, d, h, paint))
            z += h
    return tuple(boxes)


def banner(rng: Random, width_m: float, height_m: float) -> tuple[Box, ...]:
    """Return a printed banner that hangs below the origin, along x, its rope 0.3 m long."""
    cloth = pictures.PICTURES[int(rng.integers(len(pictures.PICTURES)))]
    half = np.array([0.5 * width_m, 0.012, 0.5 * height_m])
    wood = partial(textures.wood, colour=(96, 70, 46))
    sheet = Box(np.array([0.0, 0.0, -0.3 - half[2]]), half, cloth, cloth)
    bars = [Box(np.array([0.0, 0.0, z]), np.array([half[0] + 0.05, 0.03, 0.03]), wood) for z in (-0.3, -0.3 - height_m)]
    ropes = [Box(np.array([s * 0.8 * half[0], 0.0, -0.15]), np.array([0.01, 0.01, 0.15]), wood) for s in (-1, 1)]
    return (sheet, *bars, *ropes)
