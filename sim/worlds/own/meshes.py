"""Meshes: triangles from files, their surfaces, and boxes that fill them.

A mesh is solid where a lattice of cells along the axes of its frame touches its triangles, and inside of them. Each
edge of the lattice's box is divided evenly, so that a mesh that is a box is filled exactly.
"""

from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

import mujoco
import numpy as np
import numpy.typing as npt
from scipy import ndimage

from dronevio.models.arrays import Array, Image, Mask
from dronevio.models.errors import InputError
from dronevio.models.rotation import matrix_from_quat_wxyz
from dronevio.sim.appearance.cutouts import Cutouts, Print
from dronevio.sim.appearance.prisms import UNPAINTED
from dronevio.sim.appearance.scenery import facing
from dronevio.sim.appearance.solids import Box
from dronevio.sim.worlds.own.bodies import Body, Place
from dronevio.sim.worlds.own.glb import glb_mesh
from dronevio.sim.worlds.own.looks import Look

MUJOCO_SUFFIXES = (".obj", ".stl")
"""Suffixes of files of meshes that MuJoCo reads."""
SUFFIXES = (*MUJOCO_SUFFIXES, ".glb")
"""Suffixes of files of meshes."""
MOST_TRIANGLES = 100_000
"""Largest number of triangles of a mesh."""
_CELL_M = 0.05
_MOST_CELLS = 48  # along the longest axis
_THIN_M = 0.01  # least thickness
_PANEL_PX = 1300  # largest side of the part of a texture for one direction
_GAP_PX = 8
_LIGHT = {"+z": 1.0, "-z": 0.55, "side": 0.8}  # brightness of what faces up, down and to a side


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles, with their position on an image if they have one."""

    triangles: Array
    """(F, 3, 3) Corners, anticlockwise as seen from outside [m]."""
    on_image: Array | None = None
    """(F, 3, 2) Position of the corners on an image, as fractions of width and height from the top left corner."""
    image: Image | None = None
    """(H, W, 3) Image of its own."""

    @property
    def half(self) -> Array:
        """(3,) Half extents of its bounding box [m]."""
        return np.asarray(0.5 * np.ptp(self.triangles.reshape(-1, 3), axis=0))

    def centred(self) -> "Mesh":
        """Return the mesh with the centre of its bounding box in the origin."""
        middle = 0.5 * (self.triangles.min(axis=(0, 1)) + self.triangles.max(axis=(0, 1)))
        return replace(self, triangles=self.triangles - middle)

    def moved(self, R: Array, position: Array) -> "Mesh":
        """Return the mesh rotated by R (3, 3) about the origin, then translated by ``position`` (3,)."""
        return replace(self, triangles=self.triangles @ R.T + position)


def read_mesh(path: Path, where: str, name: str, content: bytes, line: int | None = None) -> Mesh:
    """Return the mesh in the content of a file.

    Args:
        path: File of the world, for error messages.
        where: Field that names the file.
        name: Name of the file.
        content: Its content.
        line: Line of the field.

    Raises:
        InputError: It is not a mesh, or one with too many triangles.
    """
    try:
        mesh = _compiled_mesh(content, name[name.rfind(".") :].lower())
    except ValueError as error:
        found = f"{where}: {name!r}: {str(error).splitlines()[0]}"
        raise InputError(path, found, f"a mesh of at most {MOST_TRIANGLES} triangles", line) from None
    return mesh


@lru_cache(maxsize=16)
def _compiled_mesh(content: bytes, suffix: str) -> Mesh:
    """Return the mesh in the content of a file.

    Raises:
        ConfigError: It is GLB, and the package that reads it is not installed.
        ValueError: It cannot be read, or has too many triangles.
    """
    if suffix == ".glb":
        mesh = Mesh(*glb_mesh(content))
        if len(mesh.triangles) > MOST_TRIANGLES:
            raise ValueError(f"{len(mesh.triangles)} triangles")
        return mesh
    file = f"mesh{suffix}"
    text = f'<mujoco><asset><mesh name="mesh" file="{file}" inertia="shell"/></asset><worldbody>'
    text += '<geom type="mesh" mesh="mesh" contype="0" conaffinity="0"/></worldbody></mujoco>'
    model = mujoco.MjSpec.from_string(text, assets={file: content}).compile()
    if model.nmeshface > MOST_TRIANGLES:
        raise ValueError(f"{model.nmeshface} triangles")
    return mesh_numbered(model, 0)


def mesh_numbered(model: mujoco.MjModel, number: int) -> Mesh:
    """Return a mesh of a model in the frame of its file."""
    faces = slice(model.mesh_faceadr[number], model.mesh_faceadr[number] + model.mesh_facenum[number])
    vertices = model.mesh_vert[model.mesh_vertadr[number] :].astype(np.float64)[model.mesh_face[faces]]
    triangles = vertices @ matrix_from_quat_wxyz(model.mesh_quat[number]).T + model.mesh_pos[number]
    if model.mesh_texcoordnum[number] == 0:
        return Mesh(triangles)
    first = model.mesh_texcoordadr[number]
    return Mesh(triangles, model.mesh_texcoord[first:].astype(np.float64)[model.mesh_facetexcoord[faces]])


def mesh_body(mesh: Mesh, place: Place) -> Body:
    """Return a mesh given in the frame of its body.

    It shows the image of its look if both have positions on one, otherwise a texture along each axis.
    """
    filling = place.placed(filling_boxes(mesh.triangles))
    core = (max(filling, key=lambda box: float(np.prod(box.half))),)
    moved = mesh.moved(place.R, place.position)
    if mesh.on_image is None or place.look.image is None:
        return Body(prints=(mesh_print(moved.triangles, place),), filling=filling, core=core)
    shown = Cutouts(_as_quads(moved.triangles), _as_quads(mesh.on_image), place.instance)
    return Body(pasted=((place.look, shown),), filling=filling, core=core)


def _as_quads(corners: Array) -> Array:
    """Return anticlockwise triangles (F, 3, D) as clockwise quadrangles (F, 4, D), of which one side has no length."""
    return corners[:, [0, 2, 1, 1]]


def mesh_print(triangles: Array, place: Place) -> Print:
    """Return the surface of triangles (F, 3, 3) in the world with a texture along each axis."""
    look, corners = place.look, _as_quads(triangles)
    normal = facing(corners)
    axis = np.abs(normal).argmax(axis=1)
    sign = np.take_along_axis(normal, axis[:, None], axis=1)[:, 0] > 0.0
    extent = np.maximum(np.ptp(triangles.reshape(-1, 3), axis=0), 1e-6)
    ppm = min(place.ppm, _PANEL_PX / float(extent.max()))
    panels = [_Panel.facing(k, extent, ppm) for k in range(3)]
    tops = np.cumsum([0, *(panel.height + _GAP_PX for panel in panels for _ in range(2))])
    width = max(panel.width for panel in panels)
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    on_image = np.empty((len(corners), 4, 2))
    for k, panel in enumerate(panels):
        for side in (0, 1):
            rows = (axis == k) & (sign == bool(side))
            x, y = panel.axes
            on_image[rows, :, 0] = (corners[rows][..., x] - low[x]) * ppm / width
            on_image[rows, :, 1] = (tops[2 * k + side] + (high[y] - corners[rows][..., y]) * ppm) / tops[-1]
    paint = partial(_panels_painted, panels=panels, look=look, ppm=ppm)
    return Print(paint, int(tops[-1]), width, (Cutouts(corners, on_image, place.instance),))


@dataclass(frozen=True)
class _Panel:
    """The part of a texture for faces along an axis."""

    axes: tuple[int, int]
    """Axes to the right and up."""
    height: int
    """Height [px]."""
    width: int
    """Width [px]."""

    @classmethod
    def facing(cls, axis: int, extent: Array, ppm: float) -> "_Panel":
        """Return the panel for faces along an axis of a box with an extent (3,) [m]."""
        x, y = ((1, 2), (0, 2), (0, 1))[axis]
        return cls((x, y), max(round(extent[y] * ppm), 1), max(round(extent[x] * ppm), 1))


def _panels_painted(
    rng: np.random.Generator, height: int, width: int, panels: list[_Panel], look: Look, ppm: float
) -> Image:
    """Return the texture with two panels for each axis, the first facing backward, with their light."""
    image = np.zeros((height, width, 3), np.uint8)
    top = 0
    for axis, panel in enumerate(panels):
        for side in (0, 1):
            light = _LIGHT["side"] if axis < 2 else _LIGHT["+z" if side else "-z"]
            whole = look.paint(ppm)(rng, panel.height + _GAP_PX, width)
            image[top : top + len(whole)] = (whole * light).astype(np.uint8)
            top += len(whole)
    return image


def filling_boxes(triangles: Array) -> list[Box]:
    """Return unpainted boxes along the axes that fill triangles (F, 3, 3) [m]."""
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    thin = high - low < _THIN_M
    low, high = np.where(thin, 0.5 * (low + high - _THIN_M), low), np.where(thin, 0.5 * (low + high + _THIN_M), high)
    cell_m = max(_CELL_M, float((high - low).max()) / _MOST_CELLS)
    shape = np.maximum(np.ceil((high - low) / cell_m - 1e-9), 1.0).astype(int)
    cell = (high - low) / shape
    touched = np.zeros(shape, np.bool_)
    points = _points_on(triangles, 0.5 * float(cell.min()))
    touched[tuple(np.clip((points - low) / cell, 0, shape - 1).astype(int).T)] = True
    solid = ndimage.binary_fill_holes(touched)
    boxes: list[Box] = []
    for first, last in _merged(np.asarray(solid, dtype=np.bool_)):
        a, b = low + first * cell, low + last * cell
        boxes.append(Box(0.5 * (a + b), 0.5 * (b - a), UNPAINTED))
    return boxes


def _points_on(triangles: Array, spacing_m: float) -> Array:
    """Return points (N, 3) on triangles (F, 3, 3), at most about a spacing apart [m]."""
    edges = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max(axis=1)
    counts = np.clip(np.ceil(edges / spacing_m), 1, 4 * _MOST_CELLS).astype(int)
    parts = []
    for count in np.unique(counts):
        u, v = np.meshgrid(np.arange(count + 1), np.arange(count + 1))
        inside = u + v <= count
        weights = np.stack([count - u[inside] - v[inside], u[inside], v[inside]], axis=1) / count
        parts.append(np.einsum("pc,fcd->fpd", weights, triangles[counts == count]).reshape(-1, 3))
    return np.concatenate(parts)


def _merged(solid: Mask) -> list[tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]]:
    """Return first and last index, exclusive, of boxes of which the solid cells (X, Y, Z) are the disjoint union.

    Each box is grown from the first cell that is left along z, then y, then x.
    """
    left, boxes = solid.copy(), []
    while left.any():
        x, y, z = (int(k) for k in np.unravel_index(int(left.argmax()), left.shape))
        top = z + _run(left[x, y, z:])
        back = y + _run(left[x, y:, z:top].all(axis=1))
        end = x + _run(left[x:, y:back, z:top].all(axis=(1, 2)))
        left[x:end, y:back, z:top] = False
        boxes.append((np.array([x, y, z]), np.array([end, back, top])))
    return boxes


def _run(values: npt.ArrayLike) -> int:
    """Return the number of true values (N,) before the first false one."""
    listed = np.asarray(values, dtype=np.bool_)
    return len(listed) if listed.all() else int(listed.argmin())
