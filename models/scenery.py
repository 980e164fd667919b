"""The visible surroundings of a simulated flight, for drawings: textured triangles and outlines, without MuJoCo."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError


@dataclass(frozen=True, eq=False)
class TexturedMesh:
    """Triangles with a texture, which includes the lighting."""

    vertices: npt.NDArray[np.float32]
    """(N, 3) Vertices in the frame of the object [m]."""
    texture_coordinates: npt.NDArray[np.float32]
    """(N, 2) Position of the vertices in the texture, (0, 0) at the top left and (1, 1) at the bottom right corner."""
    triangles: npt.NDArray[np.uint32]
    """(F, 3) Indices of the vertices of each triangle, counterclockwise as seen from the visible side."""
    texture: npt.NDArray[np.uint8]
    """(H, W, 3) Texture: red, green, blue."""

    def __post_init__(self) -> None:
        """Check shapes and indices.

        Raises:
            ConfigError: A shape or an index contradicts the others; the message names the field.
        """
        n = len(self.vertices)
        for name, columns in (("vertices", 3), ("texture_coordinates", 2)):
            value = getattr(self, name)
            if value.shape != (n, columns):
                raise ConfigError(f"textured mesh: {name} has shape {value.shape}; expected {(n, columns)}")
            if not np.isfinite(value).all():
                raise ConfigError(f"textured mesh: {name} has values that are not finite; expected finite ones")
        if self.triangles.ndim != 2 or self.triangles.shape[1] != 3:
            raise ConfigError(f"textured mesh: triangles has shape {self.triangles.shape}; expected (F, 3)")
        if len(self.triangles) and self.triangles.max() >= n:
            raise ConfigError(f"textured mesh: triangles has the value {self.triangles.max()}; expected 0 to {n - 1}")
        if self.texture.ndim != 3 or self.texture.shape[2] != 3 or 0 in self.texture.shape:
            raise ConfigError(f"textured mesh: texture has shape {self.texture.shape}; expected (H, W, 3)")


@dataclass(frozen=True, eq=False)
class Scenery:
    """What does not move in a world."""

    outline: Array
    """(L, 2, 3) Line segments of the bounds and the obstacles in the world frame [m]."""
    meshes: tuple[TexturedMesh, ...] = ()
    """Visible surfaces in the world frame; ceilings and walls are visible from inside only."""


NO_SCENERY = Scenery(np.zeros((0, 2, 3)))
"""Scenery that is not known."""
