"""Surfaces of a scene: coloured point clouds with normals, triangle meshes, and maps seen from above."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array, Floats, Image
from dronevio.models.errors import ConfigError

Colours = npt.NDArray[np.uint8]
Triangles = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class PointCloud:
    """N points on surfaces."""

    points: Array
    """(N, 3) Points in the world frame."""
    normals: Array
    """(N, 3) Unit normals of the surfaces, towards the side from which they were seen."""
    colours: Colours
    """(N, 3) Colours of the points: red, green, blue."""

    def __post_init__(self) -> None:
        """Check the shapes.

        Raises:
            ConfigError: The fields have different lengths; the message names the field.
        """
        _check_shapes("point cloud", len(self.points), points=self.points, normals=self.normals, colours=self.colours)

    def __len__(self) -> int:
        return len(self.points)

    def transformed(self, scale: float, R: Array, t: Array) -> Self:
        """Return the cloud in a new world frame, as `Reconstruction.transformed` does."""
        return replace(self, points=scale * self.points @ R.T + t, normals=self.normals @ R.T)

    def selected(self, which: npt.NDArray[np.bool_] | Triangles) -> Self:
        """Return some of the points, by a mask (N,) or by their indices."""
        return replace(self, points=self.points[which], normals=self.normals[which], colours=self.colours[which])


@dataclass(frozen=True, eq=False)
class Texture:
    """An image on the triangles of a mesh. At a seam, a vertex has more than one pixel."""

    image: Image
    """(H, W, 3) Red, green and blue."""
    pixels: Array
    """(T, 2) Column and row of each pixel that belongs to a vertex; pixel centres have integer coordinates."""
    vertices: Triangles
    """(T,) Index of the vertex to which each pixel belongs."""
    triangles: Triangles
    """(F, 3) Indices of the pixels of each triangle's corners, in the order of the triangle's vertices."""

    def coordinates(self) -> Array:
        """Return the pixels (T, 2) as shares of width and height, from the upper left corner of the image."""
        height, width = self.image.shape[:2]
        return np.asarray((self.pixels + 0.5) / [width, height])


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles between N vertices."""

    vertices: Array
    """(N, 3) Vertices in the world frame."""
    normals: Array
    """(N, 3) Unit normals of the vertices, towards the side from which they were seen."""
    colours: Colours
    """(N, 3) Colours of the vertices: red, green, blue."""
    triangles: Triangles
    """(F, 3) Indices of the vertices of each triangle, counterclockwise as seen from the side of the normals."""
    texture: Texture | None = None
    """Image on the triangles; None if the vertices alone have colours."""

    def __post_init__(self) -> None:
        """Check shapes and indices.

        Raises:
            ConfigError: A shape or an index contradicts the others; the message names the field.
        """
        count = len(self.vertices)
        _check_shapes("mesh", count, vertices=self.vertices, normals=self.normals, colours=self.colours)
        _check_shapes("mesh", len(self.triangles), triangles=self.triangles)
        if len(self.triangles) and not (self.triangles.min() >= 0 and self.triangles.max() < count):
            raise ConfigError(
                f"mesh: triangles have values from {self.triangles.min()} to {self.triangles.max()};"
                f" expected 0 to {count - 1}"
            )
        if self.texture is not None:
            corners = self.texture.triangles
            if corners.shape != self.triangles.shape or np.any(self.texture.vertices[corners] != self.triangles):
                raise ConfigError("mesh: the corners of its texture are not those of its triangles; expected the same")

    def transformed(self, scale: float, R: Array, t: Array) -> Self:
        """Return the mesh in a new world frame, as `Reconstruction.transformed` does."""
        return replace(self, vertices=scale * self.vertices @ R.T + t, normals=self.normals @ R.T)


@dataclass(frozen=True, eq=False)
class OverheadMap:
    """Heights and colours of a scene seen vertically from above, in square cells; z of the world frame points up.

    The first row is that of the largest y (north), the first column that of the smallest x (west).
    """

    west_north: tuple[float, float]
    """Smallest x and largest y of the map: the outer corner of the first cell."""
    cell: float
    """Side of a cell, above zero."""
    heights: Floats
    """(H, W) Height z of the highest surface at the centre of each cell; NaN where there is none."""
    colours: Image
    """(H, W, 3) Red, green and blue; black where there is no surface."""

    def __post_init__(self) -> None:
        """Check the shapes.

        Raises:
            ConfigError: Heights and colours differ, or the side of a cell is not above zero.
        """
        if self.heights.ndim != 2 or self.colours.shape != (*self.heights.shape, 3):
            found = f"heights of shape {self.heights.shape} and colours of shape {self.colours.shape}"
            raise ConfigError(f"overhead map: {found}; expected (H, W) and (H, W, 3)")
        if not 0.0 < self.cell < np.inf:
            raise ConfigError(f"overhead map: cell = {self.cell}; expected a length above zero")


def _check_shapes(kind: str, count: int, **values: npt.NDArray[np.generic]) -> None:
    """Raise ConfigError unless all values have the shape (count, 3)."""
    for name, value in values.items():
        if value.shape != (count, 3):
            raise ConfigError(f"{kind}: {name} has shape {value.shape}; expected {(count, 3)}")
