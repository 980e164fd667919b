"""Vegetation and rocks: trees, bushes, ferns, logs, boulders.

Each returns cutouts of shared images, in the frame of its own foot, and the boxes that it fills. Trunks are prisms of
eight sides.
"""

from dataclasses import dataclass, replace

import numpy as np

from dronevio.models.arrays import Array, Image
from dronevio.models.rotation import rotation_z
from dronevio.sim.appearance import textures
from dronevio.sim.appearance import textures_nature as nature
from dronevio.sim.appearance.cutouts import Cutouts, joined, spray
from dronevio.sim.appearance.instances import Instance, single_instance
from dronevio.sim.appearance.lightmap import Field
from dronevio.sim.appearance.prisms import UNPAINTED, lateral_surface, prism_boxes
from dronevio.sim.appearance.scenery import facing, quads_of
from dronevio.sim.appearance.solids import Box, parts_of
from dronevio.sim.appearance.textures import Colour, scaled

Random = np.random.Generator

BARKS = 4
"""Number of kinds of bark, side by side on the bark texture."""
TONES = 4
"""Number of kinds of leaves on the leaf texture, each in the shade (left) and in the sun (right)."""

_SIDES = 8
_OF_KITE = 0.85  # of the diagonals of a kite: sides of a rectangle that differs least from it


@dataclass(frozen=True, eq=False)
class Vegetation:
    """A plant or log."""

    wood: tuple[Cutouts, ...]
    """Parts with the bark texture."""
    leaves: tuple[Cutouts, ...]
    """Parts with the leaf texture."""
    obstacles: tuple[Box, ...]
    """Keep-out boxes within the flight space."""
    filling: tuple[Box, ...]
    """Boxes that fill it within the flight space."""

    def moved(self, R: Array, position: Array) -> "Vegetation":
        """Return the plant rotated by R (3, 3), then translated by ``position`` (3,)."""
        wood, leaves = (tuple(part.moved(R, position) for part in parts) for parts in (self.wood, self.leaves))
        boxes = (tuple(box.moved(R, position) for box in part) for part in (self.obstacles, self.filling))
        return Vegetation(wood, leaves, *boxes)

    def as_instance(self, kind: str) -> "Vegetation":
        """Return the plant as one instance of a kind."""
        thing = Instance(kind)
        wood, leaves = (tuple(replace(part, instance=thing) for part in parts) for parts in (self.wood, self.leaves))
        return Vegetation(wood, leaves, self.obstacles, parts_of(thing, self.filling))


@single_instance
def tree(
    rng: Random,
    radius_m: float,
    height_m: float,
    within_m: float,
    kind: int,
    sun: Array,
    twigs: int,
    sides: int = _SIDES,
) -> Vegetation:
    """Return a tall tree: a bare trunk of a given radius up to ``within_m``, and a crown above.

    Args:
        rng: Draws it.
        radius_m: Of the trunk [m].
        height_m: Of the whole tree [m].
        within_m: Up to where a drone may meet it: there it is a prism [m].
        kind: Its bark, one of `BARKS`.
        sun: (3,) Unit vector toward the sun.
        twigs: How many its crown has: the fewer, the larger.
        sides: Of its trunk, an even number.
    """
    flare = 0.3
    heights = np.array([0.8 * height_m, 0.5 * (0.8 * height_m + within_m), within_m, flare, -0.1])
    radii = radius_m * np.array([0.25, 0.7, 1.0, 1.0, 1.3])
    axis_offset = np.zeros((5, 2))
    axis_offset[:2] = np.cumsum(rng.uniform(-0.25, 0.25, (2, 2)), axis=0)[::-1]
    trunk = Cutouts.of_grid(lateral_surface(heights, radii, sides, axis_offset), kind / BARKS, (kind + 1) / BARKS)
    # the bark's rows follow the height, not the rings
    trunk.on_image[..., 1] = 1.0 - trunk.corners[..., 2] / (0.8 * height_m)
    base = within_m + 0.9 + rng.uniform(0.0, 0.1) * height_m
    half = np.array([rng.uniform(1.5, 2.3), rng.uniform(1.5, 2.3), 0.5 * (height_m - base)])
    middle = np.array([*axis_offset[0], 0.5 * (height_m + base)])
    crown = foliage(rng, middle, half, rng.uniform(1.1, 1.6) * (150.0 / twigs) ** 0.3, twigs, sun)
    root = Box(
        np.array([0.0, 0.0, 0.5 * flare]), np.array([0.85, 0.85, 0.0]) * radius_m + [0, 0, 0.5 * flare], UNPAINTED
    )
    solid = (*prism_boxes(radius_m, -0.1, within_m, sides), root)
    return Vegetation((trunk,), (crown,), solid, solid).moved(_leaning(rng), np.zeros(3))


def _leaning(rng: Random) -> Array:
    """Return a random rotation (3, 3) that tilts an upright object by up to 2.5°."""
    tip, toward = np.radians(rng.uniform(0.0, 2.5)), rotation_z(rng.uniform(0.0, 2.0 * np.pi))
    c, s = np.cos(tip), np.sin(tip)
    return np.asarray(toward @ np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]) @ toward.T)


def foliage(rng: Random, middle: Array, half: Array, twig_m: float, twigs: int, sun: Array) -> Cutouts:
    """Return twigs on an ellipsoid, lit from the direction of the sun.

    Args:
        rng: Draws them.
        middle: (3,) Its centre [m].
        half: (3,) Its half axes [m].
        twig_m: Length of a twig [m].
        twigs: How many.
        sun: (3,) Unit vector toward the sun.
    """
    outward = rng.standard_normal((twigs, 3))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    depth = rng.uniform(0.55, 1.0, (twigs, 1))
    lit = outward @ sun + 0.9 * (depth[:, 0] - 0.75) + 0.5 * rng.standard_normal(twigs) > -0.1
    cells = rng.integers(0, TONES, twigs) + TONES * lit
    return spray(rng, middle + outward * depth * half, outward, twig_m, cells, 2 * TONES)


@single_instance
def bush(rng: Random, sun: Array) -> Vegetation:
    """Return a bush of about 0.5 to 1 m height."""
    half = np.array([rng.uniform(0.35, 0.6), rng.uniform(0.35, 0.6), rng.uniform(0.3, 0.55)])
    twig = 0.3
    inside = foliage(rng, np.array([0.0, 0.0, 0.7 * half[2]]), half, twig, 100, sun)
    leaves = joined([inside, inside.turned_over()])
    leaves.corners[..., 2] = np.maximum(leaves.corners[..., 2], 0.01)
    reach = np.abs(leaves.corners[..., :2]).max(axis=(0, 1))
    top = float(leaves.corners[..., 2].max())
    hull = Box(np.array([0.0, 0.0, 0.5 * top]), np.array([*reach, 0.5 * top]), UNPAINTED)
    kites = leaves.corners[: len(inside.corners)]
    return Vegetation((), (leaves,), (hull,), plates(kites, kites[:, 2] - kites[:, 0], _OF_KITE))


@single_instance
def fern(rng: Random, fronds: int = 9) -> Vegetation:
    """Return a fern, a low rosette of fronds without collision geometry."""
    parts = []
    for k in range(fronds):
        length, width, pitch = rng.uniform(0.35, 0.6), rng.uniform(0.06, 0.1), rng.uniform(0.3, 0.7)
        c, s = length * np.cos(pitch), length * np.sin(pitch)
        frond = np.array([[0.0, 0.0, 0.02], [0.55 * c, -width, s], [1.05 * c, 0.0, 0.8 * s], [0.55 * c, width, s]])
        cell = (int(rng.integers(0, 2 * TONES)) + np.array([[0.5], [0.9], [0.5], [0.1]])) / (2 * TONES)
        on_image = np.concatenate([cell, [[1.0], [0.5], [0.0], [0.5]]], axis=1)
        turn = rotation_z(2.0 * np.pi * (k + rng.uniform(-0.3, 0.3)) / fronds)
        parts.append(Cutouts(frond[None] @ turn.T, on_image[None]))
    top = joined(parts)
    return Vegetation((), (top, top.turned_over()), (), ())


@single_instance
def log(rng: Random, radius_m: float, length_m: float, kind: int) -> Vegetation:
    """Return a fallen trunk along y."""
    trunk = lateral_surface(np.array([0.5, -0.5]) * length_m, np.full(2, radius_m), _SIDES)
    bark = Cutouts.of_grid(trunk, kind / BARKS, (kind + 1) / BARKS, 0.1, 0.1 + 0.09 * length_m)
    ends = []
    ring = trunk[0]
    for k in range(0, _SIDES, 2):
        for z, order in ((0.5, (0, 1, 2)), (-0.5, (0, 2, 1))):
            corners = np.array([[0.0, 0.0, 0.0], ring[k], ring[k + 1], ring[k + 2]])[
                [0, order[1] if z > 0 else 3, 2, 3 if z > 0 else 1]
            ]
            corners[:, 2] = z * length_m
            cell = (kind + 0.5 + 0.1 * corners[:, :1] / radius_m) / BARKS
            ends.append(Cutouts(corners[None], np.concatenate([cell, 0.5 + 0.02 * corners[:, 1:2]], axis=1)[None]))
    lie = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    lift = np.array([0.0, 0.0, 0.85 * radius_m])
    solid = tuple(prism_boxes(radius_m, -0.5 * length_m, 0.5 * length_m, _SIDES))
    whole = Vegetation((bark, joined(ends)), (), solid, solid)
    return whole.moved(lie, lift).moved(rotation_z(rng.uniform(0.0, np.pi)), np.zeros(3))


PLATE_M = 0.02
"""Thickness of the plates of irregular objects [m]."""


def plates(corners: Array, along: Array, share: float = 1.0, depth_m: float = 0.0) -> tuple[Box, ...]:
    """Return a thin box for each of some quadrangles (F, 4, 3): the rectangle around it, or a share of that.

    Args:
        corners: (F, 4, 3) Corners of the quadrangles, clockwise as seen [m].
        along: (F, 3) Direction of a side of each rectangle.
        share: Of the length of each side.
        depth_m: Of the middle of the plates below the surface [m].
    """
    normal = facing(corners)
    right = along - np.sum(along * normal, axis=1, keepdims=True) * normal
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    R = np.stack([right, np.cross(normal, right), normal], axis=2)
    inside = corners @ R
    low, high = inside.min(axis=1), inside.max(axis=1)
    middle = 0.5 * (low + high)
    middle[:, 2] = inside[..., 2].mean(axis=1) - depth_m
    half = 0.5 * share * (high - low)
    half[:, 2] = 0.5 * PLATE_M
    places = np.einsum("fij,fj->fi", R, middle)
    return tuple(Box(at, size, UNPAINTED, R=turn) for at, size, turn in zip(places, half, R, strict=True))


def boulder(rng: Random, half: Array) -> tuple[Array, Box]:
    """Return the surface of a boulder, a grid (R + 1, C + 1, 3) [m], and its bounding box."""
    rows, columns = 6, 10
    v, u = np.meshgrid(
        np.linspace(0.5 * np.pi, -0.35, rows + 1), np.linspace(0.0, 2.0 * np.pi, columns + 1), indexing="ij"
    )
    ball = np.stack([np.cos(v) * np.cos(u), np.cos(v) * np.sin(u), np.sin(v)], axis=2)
    ball = np.sign(ball) * np.abs(ball) ** 0.62  # between a sphere and a cube
    ball /= np.abs(ball).max(axis=(0, 1))
    uneven = rng.uniform(0.82, 1.0, (rows + 1, columns + 1, 1))
    uneven[:, -1], uneven[:2] = uneven[:, 0], 1.0
    grid = ball * uneven * half
    reach = np.abs(grid).max(axis=(0, 1))
    top = float(grid[..., 2].max())
    return grid, Box(np.array([0.0, 0.0, 0.5 * top]), np.array([*reach[:2], 0.5 * top]), UNPAINTED)


def boulder_filling(grid: Array, box: Box) -> tuple[Box, ...]:
    """Return shell and core of a boulder, given its surface (R + 1, C + 1, 3) [m] and its bounding box."""
    cells = quads_of(grid)
    shell = plates(cells, cells[:, 1] + cells[:, 2] - cells[:, 0] - cells[:, 3], depth_m=0.5 * PLATE_M)
    return (*shell, replace(box, half=0.5 * box.half))


def bark_image(rng: Random, height: int, width: int, colours: tuple[Colour, ...], sun: Array) -> Image:
    """Return the bark texture with `BARKS` kinds side by side, each lit as on a trunk from the x axis on."""
    each = width // BARKS
    angle = np.linspace(0.0, 2.0 * np.pi, each, dtype=np.float32)
    facing = np.maximum(np.cos(angle) * sun[0] + np.sin(angle) * sun[1], 0.0)
    light: Field = (0.56 + 0.62 * facing).astype(np.float32)
    images = [nature.bark(rng, height, each, colour) for colour in colours]
    return np.concatenate([textures.to_image(image * light[None, :, None]) for image in images], axis=1)


def leaf_image(rng: Random, height: int, width: int, colours: tuple[Colour, ...]) -> Image:
    """Return the leaf texture in ``2 * TONES`` columns: each colour in the shade, then each in the sun."""
    each = width // (2 * TONES)
    inks = [scaled(colour, f) for f in (0.7, 1.3) for colour in colours]
    return np.concatenate([nature.leaves(rng, height, each, ink, 170) for ink in inks], axis=1)
