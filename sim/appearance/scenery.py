"""Scenery: painted surfaces as meshes with texture atlases (pages) in MuJoCo.

MuJoCo stretches ``type="2d"`` textures over the sides of boxes and has no soft shadows. A mesh with texture coordinates
shows a texture exactly, and a few meshes are faster to render than many boxes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import mujoco
import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array, Image
from dronevio.sim.appearance.lightmap import Field, apply_light
from dronevio.sim.appearance.solids import Face, Surface, size_m

Triangles = npt.NDArray[np.int32]

PAGE_WIDTH_PX = 4160
"""Width of a page [px]: a wall of 16 m at full resolution, including gutters."""
_PAGE_HEIGHT_PX = 4096  # all OpenGL implementations since 2010 support 8192
_GUTTER_PX = 8  # repeated border of each face, so that coarse mipmap levels do not blend neighbours
_SMALLEST_PX = 6


@dataclass(frozen=True, eq=False)
class Page:
    """A texture atlas and its mesh."""

    texture: Image
    """(H, W, 3) Texture, an RGB image."""
    vertices: Array
    """(4 F, 3) Corners of the quadrangles [m]: top left and right, bottom right and left, as seen from the visible
    side."""
    texture_coordinates: Array
    """(4 F, 2) Texture coordinates of the corners, (0, 0) at the first row and column."""
    normals: Array
    """(4 F, 3) Unit normals at the corners."""

    @property
    def triangles(self) -> Triangles:
        """(2 F, 3) Corners of the triangles, anticlockwise as seen from the visible side.

        Large faces such as walls, which are first on a page, are rendered last, since others hide parts of them.
        """
        return _triangles(len(self.vertices) // 4)[::-1]

    def reduced(self, factor: int) -> "Page":
        """Return the page with a texture that is smaller by a factor along each axis."""
        return replace(self, texture=reduced_image(self.texture, factor))


def reduced_image(image: Image, factor: int) -> Image:
    """Return an image (H, W, 3) that is smaller by a factor along each axis, each pixel the mean over its area."""
    size = max(image.shape[1] // factor, 1), max(image.shape[0] // factor, 1)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def paint_pages(
    faces: Sequence[Surface], light: Sequence[Field], rng: np.random.Generator, width_px: int = PAGE_WIDTH_PX
) -> list[Page]:
    """Paint faces, apply their light maps, and arrange them on pages.

    Args:
        faces: The visible surfaces.
        light: Light map of each face.
        rng: Generator of the textures.
        width_px: Width of a page [px]; the shorter side of each face must fit.
    """
    images = [painted(face, brightness, rng) for face, brightness in zip(faces, light, strict=True)]
    lying = [image.shape[0] > image.shape[1] for image in images]  # tall images are rotated to save space
    images = [image.transpose(1, 0, 2) if lies else image for image, lies in zip(images, lying, strict=True)]
    pages = []
    for slots, height in _shelves([(image.shape[0], image.shape[1]) for image in images], width_px):
        texture = np.zeros((height, width_px, 3), np.uint8)
        vertices, coordinates, normals = [], [], []
        for index, row, column in slots:
            face, image = faces[index], images[index]
            padded = cv2.copyMakeBorder(image, *(_GUTTER_PX,) * 4, cv2.BORDER_REPLICATE)
            texture[row : row + padded.shape[0], column : column + padded.shape[1]] = padded
            quads = quads_of(face.grid)
            origin, extent = np.array([column, row]) + _GUTTER_PX, np.array(image.shape[1::-1])
            on_image = quads_of(_even_grid(face.grid.shape[0], face.grid.shape[1]))
            on_page = on_image[..., ::-1] if lying[index] else on_image
            vertices.append(quads.reshape(-1, 3))
            coordinates.append((origin + on_page.reshape(-1, 2) * extent) / [width_px, height])
            normals.append(np.repeat(facing(quads), 4, axis=0))
        pages.append(Page(texture, *(np.concatenate(parts) for parts in (vertices, coordinates, normals))))
    return pages


def facing(quads: Array) -> Array:
    """Return the unit normals (F, 3) of quadrangles (F, 4, 3), clockwise as seen; a side may have length 0."""
    a, b, c, d = np.moveaxis(quads, 1, 0)
    normal = np.cross(c - a, b - d)
    return np.asarray(normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12))


def _triangles(count: int) -> Triangles:
    """Return the triangles (2 F, 3) of quadrangles whose corners are numbered consecutively."""
    quads = np.arange(4 * count, dtype=np.int32).reshape(-1, 4)
    return np.concatenate([quads[:, [0, 2, 1]], quads[:, [0, 3, 2]]])


def painted(face: Surface, brightness: Field, rng: np.random.Generator) -> Image:
    """Return the texture (H, W, 3) of a surface with its light map applied."""
    height, width = (max(round(v * face.pixels_per_m), _SMALLEST_PX) for v in size_m(face))
    return apply_light(face.paint(rng, height, width), brightness)


def quads_of(grid: Array) -> Array:
    """Return the cells (F, 4, D) of a grid (R + 1, C + 1, D): top left and right, bottom right and left."""
    cells = np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]], axis=2)
    return cells.reshape(-1, 4, grid.shape[2])


def _even_grid(rows: int, columns: int) -> Array:
    """Return the texture coordinates (rows, columns, 2) of a grid, x and y from 0 to 1."""
    right, down = np.meshgrid(np.linspace(0.0, 1.0, columns), np.linspace(0.0, 1.0, rows))
    return np.stack([right, down], axis=-1)


def _shelves(sizes: Sequence[tuple[int, int]], width_px: int) -> list[tuple[list[tuple[int, int, int]], int]]:
    """Pack images of (height, width) into shelves, tallest first.

    Returns:
        For each page its slots (index, row, column), including gutters, and its height.
    """
    pages: list[tuple[list[tuple[int, int, int]], int]] = []
    slots: list[tuple[int, int, int]] = []
    top = column = shelf = 0
    for index in sorted(range(len(sizes)), key=lambda i: (-sizes[i][0], -sizes[i][1])):
        height, width = (v + 2 * _GUTTER_PX for v in sizes[index])
        if column + width > width_px:
            top, column, shelf = top + shelf, 0, 0
        if top + height > _PAGE_HEIGHT_PX:
            pages.append((slots, top))
            slots, top, column, shelf = [], 0, 0, 0
        slots.append((index, top, column))
        column, shelf = column + width, max(shelf, height)
    return [*pages, (slots, top + shelf)]


def add_pages(spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str, pages: Sequence[Page]) -> None:
    """Add pages to a body of a model as visible geoms without collision, named ``name_0``, ``name_1`` and so on."""
    for number, page in reversed(list(enumerate(pages))):  # the first has the largest faces, which others hide
        _add_page(spec, body, f"{name}_{number}", page)


def _add_page(spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str, page: Page) -> None:
    """Add one page to a body."""
    _add_painted_material(spec, name, page.texture)
    mesh = _add_seen_mesh(spec, body, name, page.vertices, page.triangles)
    mesh.usernormal = page.normals.ravel()
    mesh.usertexcoord = page.texture_coordinates.ravel()
    mesh.userfacenormal = mesh.userfacetexcoord = page.triangles.ravel()
    spec.geom(name).material = name


def add_instance(spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str, quads: Array) -> None:
    """Add quadrangles (F, 4, 3) to a body of a model as one geom without texture, for segmentation."""
    _add_seen_mesh(spec, body, name, quads.reshape(-1, 3), _triangles(len(quads)))


def _add_seen_mesh(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str, vertices: Array, triangles: Triangles
) -> mujoco.MjsMesh:
    """Add a mesh of vertices (V, 3) and triangles (T, 3) to a body as a visible geom without collision."""
    mesh = spec.add_mesh(name=name, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    mesh.uservert, mesh.userface = vertices.ravel(), triangles.ravel()
    body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, contype=0, conaffinity=0)
    return mesh


def add_mirror(spec: mujoco.MjSpec, face: Face, image: Image, reflectance: float) -> None:
    """Add a reflecting floor to a model as a visible geom without collision.

    MuJoCo supports reflections in planes only, if the renderer enables them. It spreads an image over a plane with the
    first row at the largest y and the first column at the smallest x, as seen from above.

    Args:
        spec: Specification of the model.
        face: Rectangle of the floor, whose right edge is along x.
        image: (H, W, 3) Texture of the floor with its light map applied.
        reflectance: Fraction of the light that it reflects.
    """
    _add_painted_material(spec, "mirror", image).reflectance = reflectance
    height, width = size_m(face)
    spec.worldbody.add_geom(
        name="mirror",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0.5 * width, 0.5 * height, 1.0],
        pos=face.corner + 0.5 * (face.right + face.down),
        material="mirror",
        contype=0,
        conaffinity=0,
    )


def _add_painted_material(spec: mujoco.MjSpec, name: str, image: Image) -> mujoco.MjsMaterial:
    """Add a material that shows an image (H, W, 3) unchanged.

    The image includes the lighting: the material emits it at its own brightness, and the lights of the scene contribute
    nothing.
    """
    texture = spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D)
    texture.height, texture.width, texture.nchannel = image.shape
    texture.data = image.tobytes()
    material = spec.add_material(name=name, rgba=[_DARK, _DARK, _DARK, 1.0], emission=1.0 / _DARK, specular=0.0)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    return material


_DARK = 1.0 / 256.0  # reflectance of the scenery for the lights of the scene
