"""Cutouts: many objects that share a few textures, such as trunks, twigs and rocks, to save memory.

Each object consists of quadrangles that show parts of a shared texture. Leaves are cut out by their outline instead of
transparency, so that they appear in depth images, too.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.sim.appearance.instances import UNNAMED, Instance
from dronevio.sim.appearance.scenery import Page, facing
from dronevio.sim.appearance.solids import Paint

Random = np.random.Generator
Indices = npt.NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Cutouts:
    """Quadrangles that show parts of a texture."""

    corners: Array
    """(F, 4, 3) Corners [m], clockwise as seen from the visible side."""
    on_image: Array
    """(F, 4, 2) Texture coordinates as fractions of width and height from the top left corner."""
    instance: Instance = UNNAMED
    """Object instance of the quadrangles."""

    @classmethod
    def of_grid(
        cls, grid: Array, left: float = 0.0, right: float = 1.0, top: float = 0.0, bottom: float = 1.0
    ) -> "Cutouts":
        """Return the cells of a grid of points (R + 1, C + 1, 3) with a part of the texture spread evenly over them."""
        u, v = np.meshgrid(np.linspace(left, right, grid.shape[1]), np.linspace(top, bottom, grid.shape[0]))
        points = np.concatenate([grid, u[..., None], v[..., None]], axis=2)
        cells = np.stack([points[:-1, :-1], points[:-1, 1:], points[1:, 1:], points[1:, :-1]], axis=2).reshape(-1, 4, 5)
        return cls(cells[..., :3], cells[..., 3:])

    def moved(self, R: Array, position: Array) -> "Cutouts":
        """Return the quadrangles rotated by R (3, 3) about the origin, then translated by ``position`` (3,)."""
        return replace(self, corners=self.corners @ R.T + position)

    def turned_over(self) -> "Cutouts":
        """Return the quadrangles seen from behind."""
        return replace(self, corners=self.corners[:, ::-1], on_image=self.on_image[:, ::-1])


def joined(parts: Sequence[Cutouts]) -> Cutouts:
    """Return several cutouts as one, without their instances."""
    return Cutouts(np.concatenate([part.corners for part in parts]), np.concatenate([part.on_image for part in parts]))


def spray(rng: Random, centres: Array, outward: Array, length_m: float, cells: Indices, of: int) -> Cutouts:
    """Return a twig with leaves at each centre: a kite that hangs outward, seen from below.

    Args:
        rng: Generator of orientations and sizes.
        centres: (N, 3) Positions of the twigs [m].
        outward: (N, 3) Unit vectors out of the crown.
        length_m: Length of a twig [m].
        cells: (N,) Index of the texture column of each twig.
        of: Number of texture columns.
    """
    count = len(centres)
    axis = outward * 0.5 + rng.standard_normal((count, 3)) * 0.6 + [0.0, 0.0, -0.35]
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    side = np.cross(axis, outward + 0.4 * rng.standard_normal((count, 3)))
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-9)
    side[np.cross(axis, side)[:, 2] > 0.0] *= -1.0
    long = (length_m * rng.uniform(0.7, 1.3, count))[:, None] * axis
    wide = (length_m * rng.uniform(0.3, 0.5, count))[:, None] * side
    base = centres - 0.4 * long
    waist = base + rng.uniform(0.35, 0.6, (count, 1)) * long
    corners = np.stack([base, waist - wide, base + long, waist + wide], axis=1)
    shape = np.array([[0.5, 1.0], [0.0, 0.5], [0.5, 0.0], [1.0, 0.5]])
    on_cell = shape * 0.78 + rng.uniform(0.0, 0.2, (count, 1, 2))
    on_cell[..., 0] = (on_cell[..., 0] + cells[:, None]) / of
    return Cutouts(corners, on_cell)


@dataclass(frozen=True, eq=False)
class Print:
    """A texture with the cutouts that share it."""

    paint: Paint
    """Function that draws the texture, including its lighting."""
    height: int
    """Height of the texture [px]."""
    width: int
    """Width of the texture [px]."""
    cutouts: tuple[Cutouts, ...]
    """Cutouts that show the texture."""

    def page(self, rng: Random) -> Page:
        """Return the painted page."""
        whole = joined(self.cutouts)
        normals = np.repeat(facing(whole.corners), 4, axis=0)
        corners, on_image = whole.corners.reshape(-1, 3), whole.on_image.reshape(-1, 2)
        return Page(self.paint(rng, self.height, self.width), corners, on_image, normals)
