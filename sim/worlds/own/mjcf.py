"""Worlds in MJCF, MuJoCo's own format: the static geoms of a file with their materials.

The file is read together with the files that it includes. Only the parts that matter here reach MuJoCo: compiler,
defaults, textures, materials, meshes and bodies. All files are read beforehand, from the folder of the world.
Bodies with joints, and mocap bodies, are left out. As in MuJoCo's viewers, geoms of groups 3 to 5 are not seen; those
with ``contype`` and ``conaffinity`` 0 are not solid.
"""

import io
import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import mujoco
import numpy as np
from PIL import Image as Pillow

from dronevio.models.arrays import Array, Image
from dronevio.models.errors import InputError
from dronevio.models.rotation import matrix_from_quat_wxyz
from dronevio.sim.appearance.instances import Instance
from dronevio.sim.worlds.own.bodies import Body, Place, box_body, capsule_body, cylinder_body, ellipsoid_body
from dronevio.sim.worlds.own.folder import WorldFolder
from dronevio.sim.worlds.own.looks import Look, reduced_to
from dronevio.sim.worlds.own.meshes import MOST_TRIANGLES, MUJOCO_SUFFIXES, mesh_body, mesh_numbered

MOST_GEOMS = 2000
"""Largest number of static geoms."""
_KEPT = ("compiler", "default", "asset", "worldbody")
_ASSETS = ("texture", "material", "mesh")
_DYNAMIC = ("composite", "flexcomp", "attach", "plugin")
_MOST_BYTES = 5_000_000  # of XML
_MOST_INCLUDES = 50
_LARGEST_TEXTURE_PX = 4096
_MOST_RESOLUTION = 100.0  # of built-in meshes
_PLANE_M = 0.02  # thickness of planes that are not the floor
_LARGEST_M = 1000.0
_HIDDEN_GROUP = 3
_TYPES = {
    mujoco.mjtGeom.mjGEOM_PLANE: "plane",
    mujoco.mjtGeom.mjGEOM_BOX: "box",
    mujoco.mjtGeom.mjGEOM_SPHERE: "sphere",
    mujoco.mjtGeom.mjGEOM_CYLINDER: "cylinder",
    mujoco.mjtGeom.mjGEOM_CAPSULE: "capsule",
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: "ellipsoid",
    mujoco.mjtGeom.mjGEOM_MESH: "mesh",
}


def inlined(folder: WorldFolder, name: str, content: bytes) -> tuple[str, dict[str, bytes]]:
    """Return the parts of an MJCF file that matter, with what it includes, and the files of its assets by new names.

    Args:
        folder: File and folder of the world.
        name: Name of the MJCF file in the folder.
        content: Its content.

    Raises:
        InputError: The file is not MJCF, has an element that is not supported, or names a file outside of the folder.
    """
    root = _included(folder, name, content, [name])
    parts = [part for part in root if part.tag in _KEPT]
    assets: dict[str, bytes] = {}
    folders = dict.fromkeys(("mesh", "texture"), "")
    for part in parts:
        if part.tag == "compiler":
            both = part.attrib.pop("assetdir", "")
            for kind in folders:
                folders[kind] = part.attrib.pop(f"{kind}dir", both) or folders[kind]
            part.attrib.pop("strippath", None)
    whole = ET.Element("mujoco")
    for part in parts:
        if part.tag == "asset":
            for asset in [one for one in part if one.tag not in _ASSETS]:
                part.remove(asset)
            for asset in part:
                _read_asset(folder, name, asset, folders, assets)
        _check_copies(folder.path, name, part, 1)
        whole.append(part)
    return ET.tostring(whole, encoding="unicode"), assets


def _included(folder: WorldFolder, name: str, content: bytes, reading: list[str]) -> ET.Element:
    """Return the root of an MJCF file with the elements of the files that it includes.

    Raises:
        InputError: A file is not MJCF or cannot be read.
    """
    where = name if name != folder.path.name else "MJCF"
    if len(content) > _MOST_BYTES:
        raise InputError(folder.path, f"{where}: {len(content)} bytes of XML", f"at most {_MOST_BYTES}")
    if re.search(rb"<!\s*(DOCTYPE|ENTITY)", content, re.IGNORECASE):
        raise InputError(folder.path, f"{where}: a document type", "XML without document types and entities")
    try:
        root = ET.fromstring(content)
    except (ET.ParseError, ValueError, LookupError) as error:
        line = error.position[0] if isinstance(error, ET.ParseError) else None
        raise InputError(folder.path, f"{where}: {error}", "MJCF, which is XML", line) from None
    if root.tag not in ("mujoco", "mujocoinclude"):
        raise InputError(folder.path, f"{where}: the element {root.tag!r}", "MJCF, whose first element is mujoco")
    _include_in(folder, root, reading)
    return root


def _include_in(folder: WorldFolder, element: ET.Element, reading: list[str]) -> None:
    """Replace the elements ``include`` within an element by what they name."""
    children: list[ET.Element] = []
    for child in element:
        if child.tag in _DYNAMIC:
            raise InputError(folder.path, f"the element {child.tag!r}", "static bodies with geoms")
        if child.tag != "include":
            _include_in(folder, child, reading)
            children.append(child)
            continue
        file = child.get("file", "")
        if len(reading) > _MOST_INCLUDES or file in reading:
            raise InputError(folder.path, f"include file={file!r}", "each file once, and at most 50 of them")
        reading.append(file)
        children += _included(folder, file, folder.read(file, "include", (".xml",)), reading)
    element[:] = children


def _read_asset(
    folder: WorldFolder, name: str, asset: ET.Element, folders: dict[str, str], assets: dict[str, bytes]
) -> None:
    """Read the files of an asset, and replace their names in it by those in ``assets``."""
    where = f"{asset.tag} {asset.get('name', '')}".rstrip()
    if asset.tag == "mesh" and any(float_of(word) > _MOST_RESOLUTION for word in asset.get("params", "").split()):
        raise InputError(folder.path, f"{where}: params={asset.get('params')!r}", f"at most {_MOST_RESOLUTION:g}")
    for side in ("width", "height"):
        if float_of(asset.get(side, "1")) > _LARGEST_TEXTURE_PX:
            raise InputError(folder.path, f"{where}: {side}={asset.get(side)!r}", f"at most {_LARGEST_TEXTURE_PX} px")
    if asset.tag == "texture":
        asset.attrib.pop("content_type", None)
    for attribute in [one for one in asset.attrib if one.startswith("file")]:
        suffixes = MUJOCO_SUFFIXES if asset.tag == "mesh" else (".png",)
        path = PurePosixPath(name).parent / folders.get(asset.tag, "") / asset.attrib[attribute]
        content = folder.read(str(path), where, suffixes)
        if asset.tag == "texture":
            _check_image(folder.path, where, content)
        if asset.tag == "mesh" and "name" not in asset.attrib:
            asset.set("name", PurePosixPath(asset.attrib[attribute]).stem)
        if asset.tag == "texture" and "name" not in asset.attrib:
            asset.set("name", PurePosixPath(asset.attrib[attribute]).stem)
        key = f"asset_{len(assets)}{path.suffix.lower()}"
        assets[key] = content
        asset.set(attribute, key)


def float_of(text: str) -> float:
    """Return the number of a text, inf if it is none, so that it exceeds every limit."""
    try:
        value = float(text)
    except ValueError:
        return np.inf
    return np.inf if np.isnan(value) else value


def _check_image(path: Path, where: str, content: bytes) -> None:
    """Raise InputError unless the content of a file is a PNG image of a limited size."""
    try:
        with Pillow.open(io.BytesIO(content), formats=("PNG",)) as opened:
            size = opened.size
    except (OSError, SyntaxError, ValueError, Pillow.DecompressionBombError):
        raise InputError(path, f"{where}: no PNG image", "a PNG image") from None
    if max(size) > _LARGEST_TEXTURE_PX:
        raise InputError(path, f"{where}: an image of {size[0]} × {size[1]} px", f"at most {_LARGEST_TEXTURE_PX} px")


def _check_copies(path: Path, name: str, element: ET.Element, copies: float) -> None:
    """Raise InputError if replicated geoms are too many."""
    if element.tag == "replicate":
        copies *= float_of(element.get("count", "1"))
        if copies > MOST_GEOMS:
            raise InputError(path, f"replicate count={element.get('count')!r}", f"at most {MOST_GEOMS} geoms in all")
    for child in element:
        _check_copies(path, name, child, copies)


@dataclass(frozen=True, eq=False)
class StaticGeom:
    """A static geom of a model in the world."""

    kind: str
    """Its type, such as ``box``."""
    size: Array
    """(3,) Its size as MuJoCo defines it for the type [m]."""
    position: Array
    """(3,) Its position [m]."""
    R: Array
    """(3, 3) Its orientation."""
    name: str
    """Its name, or that of its body, or its type."""
    look: Look
    """Its look."""
    is_seen: bool
    """Whether it is visible."""
    is_solid: bool
    """Whether it collides."""
    mesh: int
    """Number of its mesh; −1 for none."""

    @property
    def is_level(self) -> bool:
        """Whether it is a plane that faces up."""
        return self.kind == "plane" and bool(self.R[2, 2] > 1.0 - 1e-6)


@dataclass(frozen=True, eq=False)
class StaticModel:
    """The static geoms of an MJCF model."""

    path: Path
    """File of the world."""
    model: mujoco.MjModel
    """The compiled model."""
    geoms: tuple[StaticGeom, ...]
    """Its static geoms."""
    pad_m: Array | None
    """(3,) Position of its site ``pad`` [m]; None without one."""

    def bodies(self, floor_m: float, ppm: float) -> list[Body]:
        """Return the bodies of the geoms, apart from the floor.

        Args:
            floor_m: Height of the floor [m]; level planes there are left out.
            ppm: Largest resolution of textures [px/m].

        Raises:
            InputError: A plane that is not the floor is infinite.
        """
        bodies = []
        for geom in self.geoms:
            if geom.is_level and abs(geom.position[2] - floor_m) < 1e-3:
                continue
            body = self._body(geom, Place(geom.position, geom.R, geom.look, ppm, Instance(geom.name)))
            bodies.append(_with(body, geom.is_seen, geom.is_solid))
        return bodies

    def box_of(self, geom: StaticGeom) -> tuple[Array, Array]:
        """Return the lower and the upper corner (3,) of the bounding box of a geom that is no plane [m]."""
        if geom.mesh >= 0:
            points = mesh_numbered(self.model, geom.mesh).triangles.reshape(-1, 3) @ geom.R.T + geom.position
            return points.min(axis=0), points.max(axis=0)
        r, h = geom.size[:2]
        half = {"sphere": (r, r, r), "cylinder": (r, r, h), "capsule": (r, r, h + r)}.get(geom.kind, tuple(geom.size))
        reach = np.abs(geom.R) @ np.array(half)
        return geom.position - reach, geom.position + reach

    def _body(self, geom: StaticGeom, place: Place) -> Body:
        """Return the body of a geom."""
        radius_m, half_m = float(geom.size[0]), float(geom.size[1])
        if geom.kind == "mesh":
            return mesh_body(mesh_numbered(self.model, geom.mesh), place)
        if geom.kind == "sphere":
            return ellipsoid_body(np.full(3, radius_m), place)
        if geom.kind == "cylinder":
            return cylinder_body(radius_m, 2.0 * half_m, place)
        if geom.kind == "capsule":
            return capsule_body(radius_m, half_m, place)
        if geom.kind == "ellipsoid":
            return ellipsoid_body(geom.size, place)
        if geom.kind == "box":
            return box_body(geom.size, place)
        if not geom.size[0] > 0.0 or not geom.size[1] > 0.0:
            raise InputError(self.path, f"geom {geom.name}: an infinite plane", "a floor, or a plane with a size")
        below = place.position - 0.5 * _PLANE_M * place.R[:, 2]
        half = np.array([geom.size[0], geom.size[1], 0.5 * _PLANE_M])
        return box_body(half, Place(below, place.R, place.look, place.ppm, place.instance))


def read_static(folder: WorldFolder, name: str, content: bytes) -> StaticModel:
    """Return the static geoms of an MJCF file.

    Args:
        folder: File and folder of the world.
        name: Name of the MJCF file in the folder.
        content: Its content.

    Raises:
        InputError: It is not MJCF, MuJoCo cannot compile it, it has too many geoms or one of another type, or it names
            a file outside of the folder.
    """
    path = folder.path
    text, assets = inlined(folder, name, content)
    try:
        spec = mujoco.MjSpec.from_string(text, assets=assets)
        solid = [bool(geom.contype or geom.conaffinity) for geom in spec.geoms]
        if len(spec.geoms) > MOST_GEOMS:
            raise InputError(path, f"{len(spec.geoms)} geoms", f"at most {MOST_GEOMS}")
        for mesh in spec.meshes:
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        for geom in spec.geoms:
            geom.contype = geom.conaffinity = 0  # no convex hulls are needed
        spec.compiler.discardvisual = 0
        spec.compiler.fusestatic = 0
        model = spec.compile()
    except ValueError as error:
        message = " ".join(re.sub(r"\s+", " ", str(error)).split())[:200]
        raise InputError(path, message, "a model that MuJoCo compiles") from None
    if model.nmeshface > MOST_TRIANGLES:
        raise InputError(path, f"{model.nmeshface} triangles", f"at most {MOST_TRIANGLES}")
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    static = np.flatnonzero(model.body_weldid[model.geom_bodyid] == 0)
    static = static[model.body_mocapid[model.geom_bodyid[static]] < 0]
    looks: dict[tuple[int, bytes], Look] = {}
    for number in static.tolist():
        looks.setdefault(_look_key(model, number), _look(model, number))
    geoms = tuple(
        _static_geom(path, model, data, number, solid[number], looks[_look_key(model, number)])
        for number in static.tolist()
    )
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, "pad")
    return StaticModel(path, model, geoms, None if site < 0 else data.site_xpos[site].copy())


def _static_geom(
    path: Path, model: mujoco.MjModel, data: mujoco.MjData, number: int, is_solid: bool, look: Look
) -> StaticGeom:
    """Return a geom of a model.

    Raises:
        InputError: Its type is not supported, or it is too large.
    """
    kind = _TYPES.get(mujoco.mjtGeom(int(model.geom_type[number])))
    name = model.geom(number).name or model.body(int(model.geom_bodyid[number])).name.replace("world", "")
    if kind is None:
        unsupported = mujoco.mjtGeom(int(model.geom_type[number])).name.removeprefix("mjGEOM_").lower()
        raise InputError(path, f"geom {name or number}: {unsupported}", f"one of {', '.join(_TYPES.values())}")
    position, size = data.geom_xpos[number].copy(), model.geom_size[number].copy()
    R = data.geom_xmat[number].reshape(3, 3).copy()
    if np.abs(position).max() > _LARGEST_M or (kind != "plane" and size.max() > _LARGEST_M):
        raise InputError(path, f"geom {name or number} of {size.max():g} m at {position.tolist()} m", "at most 1000 m")
    mesh = int(model.geom_dataid[number]) if kind == "mesh" else -1
    if mesh >= 0:  # the geom has the principal axes of the mesh; here it has those of its file
        R = R @ matrix_from_quat_wxyz(model.mesh_quat[mesh]).T
        position = position - R @ model.mesh_pos[mesh]
    is_seen = bool(model.geom_group[number] < _HIDDEN_GROUP) and _rgba(model, number)[3] > 0.0
    return StaticGeom(kind, size, position, R, name or kind, look, is_seen, is_solid, mesh)


def _rgba(model: mujoco.MjModel, geom: int) -> Array:
    """Return the colour (4,) of a geom: its own unless that is the default and it has a material."""
    own = np.asarray(model.geom_rgba[geom], dtype=np.float64)
    material = int(model.geom_matid[geom])
    if material >= 0 and np.allclose(own, [0.5, 0.5, 0.5, 1.0]):
        return np.asarray(model.mat_rgba[material], dtype=np.float64)
    return np.asarray(own)


def _look_key(model: mujoco.MjModel, geom: int) -> tuple[int, bytes]:
    """Return what geoms of the same look have in common."""
    return int(model.geom_matid[geom]), model.geom_rgba[geom].tobytes()


def _look(model: mujoco.MjModel, geom: int) -> Look:
    """Return the look of a geom: the texture of its material, or its colour."""
    colour = 255.0 * _rgba(model, geom)[:3]
    material = int(model.geom_matid[geom])
    texture = -1 if material < 0 else int(model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB])
    if texture < 0:
        red, green, blue = np.clip(colour, 8.0, 245.0).tolist()
        return Look("plain", (red, green, blue))
    image = _image(model, texture).astype(np.float32) * (colour / 255.0).astype(np.float32)
    repeat = model.mat_texrepeat[material].astype(np.float64)
    tiled = bool(model.mat_texuniform[material]) and repeat[0] > 0.0
    return Look(image=np.clip(image, 0.0, 255.0).astype(np.uint8), repeat_m=1.0 / repeat[0] if tiled else None)


def _image(model: mujoco.MjModel, texture: int) -> Image:
    """Return the image (H, W, 3) of a texture; that of one side of a cube."""
    height, width, channels = (int(part[texture]) for part in (model.tex_height, model.tex_width, model.tex_nchannel))
    first = int(model.tex_adr[texture])
    image = model.tex_data[first : first + height * width * channels].reshape(height, width, channels)
    if model.tex_type[texture] != mujoco.mjtTexture.mjTEXTURE_2D:
        image = image[:width]
    colours = image[..., :3] if channels >= 3 else np.repeat(image[..., :1], 3, axis=2)
    return reduced_to(np.ascontiguousarray(colours), 2048)


def _with(body: Body, is_seen: bool, is_solid: bool) -> Body:
    """Return a body that is seen, solid or both."""
    if is_seen and is_solid:
        return body
    if is_solid:
        return Body(filling=body.solids, core=body.core)
    if is_seen:
        faces = [face for box in body.boxes for face in box.faces()]
        return Body(sheets=(*faces, *body.sheets), prints=body.prints, pasted=body.pasted)
    return Body()
