"""Meshes in GLB, the binary form of glTF 2.0, by the package trimesh."""

import io
from typing import Any

import numpy as np

from dronevio.models.arrays import Array, Image
from dronevio.models.errors import ConfigError
from dronevio.models.extras import install_command
from dronevio.sim.worlds.own.looks import reduced_image

_TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # y is up in glTF


def glb_mesh(content: bytes) -> tuple[Array, Array | None, Image | None]:
    """Return all triangles of a GLB file with z up, and its image.

    Nothing outside the file is read. Several images become one.

    Returns:
        Corners (F, 3, 3) [m]; their positions (F, 3, 2) on the image as fractions from the top left corner, and the
        image (H, W, 3); both None without texture coordinates or an image.

    Raises:
        ConfigError: The package is not installed.
        ValueError: It is no GLB file, has no triangles, or an image with more than 8192 px along a side.
    """
    try:
        import trimesh
    except ModuleNotFoundError:
        raise ConfigError(f"GLB without trimesh; expected it, by `{install_command('glb')}`") from None
    try:
        scene = trimesh.load_scene(io.BytesIO(content), file_type="glb", process=False)
        mesh: Any = scene.to_geometry()
        faces, vertices = np.asarray(mesh.faces, np.int64), np.asarray(mesh.vertices, np.float64)
        triangles = vertices[faces] @ _TO_Z_UP.T
    except Exception as error:  # whatever the reader raises for damaged files
        raise ValueError(f"no GLB with triangles ({type(error).__name__})") from error
    if not len(faces) or not np.isfinite(triangles).all():
        raise ValueError("no triangles" if not len(faces) else "corners that are not finite")
    uv, image = getattr(mesh.visual, "uv", None), _image_of(getattr(mesh.visual, "material", None))
    if uv is None or image is None or len(uv) != len(vertices):
        return triangles, None, None
    on_image = np.asarray(uv, np.float64)[faces] * [1.0, -1.0] + [0.0, 1.0]  # trimesh counts from the bottom
    return triangles, on_image, image


def _image_of(material: Any) -> Image | None:
    """Return the colours of a material as an image; None without one."""
    picture = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    return None if picture is None else reduced_image(picture)
