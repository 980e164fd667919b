"""Bodies of vehicles in MJCF files of one's own.

The file has one body in ``worldbody``, whose origin is the centre of mass and whose axes are x forward, y left, z up.
Its ``pos`` is where it stands. Geoms of group 3 touch the world, those whose names begin with ``foot`` as its feet; the
others are drawn. Mass, moments of inertia, joint, sites and controls are those of the vehicle, and need not be in the
file. Meshes and textures are files in its folder.

The file may have been downloaded: plugins, includes and files outside of its folder are refused.
"""

from pathlib import Path
from xml.etree import ElementTree

import mujoco

from dronevio.models.errors import InputError
from dronevio.models.recordings.files import read_text
from dronevio.sim.physics.collisions import COLLISION_GROUP, FEET

_EXPECTED = "an MJCF file with one body"
_REFUSED = ("include", "extension", "plugin", "attach", "model")
_FOLDERS = ("meshdir", "texturedir", "assetdir")


def own_spec(path: Path) -> mujoco.MjSpec:
    """Return the specification of the body in an MJCF file, which is named ``quadrotor``.

    Raises:
        InputError: The file is missing or damaged, has no such body, or names files outside of its folder.
    """
    text = read_text(path, _EXPECTED)
    _check_references(path, text)
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise InputError(path, " ".join(str(error).split()), _EXPECTED) from None
    bodies = [body for body in spec.bodies if body.name != "world"]
    if len(bodies) != 1 or spec.worldbody.geoms:
        found = f"{len(bodies)} bodies and {len(spec.worldbody.geoms)} geoms beside them"
        raise InputError(path, found, "one body that holds all geoms")
    body = bodies[0]
    for unneeded in (*spec.actuators, *spec.sensors, *body.joints, *body.sites):
        spec.delete(unneeded)
    body.name = "quadrotor"
    touching = [geom for geom in body.geoms if geom.group == COLLISION_GROUP]
    if sum(geom.name.startswith(FEET) for geom in touching) < 3:
        raise InputError(path, "fewer than 3 feet", f"geoms of group {COLLISION_GROUP} with names such as foot_1")
    for k, geom in enumerate(body.geoms):
        geom.mass = 0.0
        geom.contype, geom.conaffinity = 0, int(geom.group == COLLISION_GROUP)
        if geom.group == COLLISION_GROUP and not geom.name:
            geom.name = f"part_{k}"
    return spec


def _check_references(path: Path, text: str) -> None:
    """Check that a file refers to files in its folder only.

    Raises:
        InputError: It does not, it has code, or it is no XML.
    """
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise InputError(path, "a document type with entities", _EXPECTED)
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InputError(path, f"no XML: {error}", _EXPECTED) from None
    folder = path.parent.resolve()
    for element in root.iter():
        if element.tag in _REFUSED:
            raise InputError(path, f"an element <{element.tag}>", "a file without plugins and includes")
        for name, value in element.attrib.items():
            if name in _FOLDERS:
                raise InputError(path, f"{name} = {value!r}", "names of files relative to this one")
            if name.startswith("file") and not (folder / value).resolve().is_relative_to(folder):
                raise InputError(path, f"{name} = {value!r}, outside of the folder", "a file beside this one")
