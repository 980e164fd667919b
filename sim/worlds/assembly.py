"""Assembly of MuJoCo specifications from layouts: visible geometry, collision geometry and camera settings."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from dronevio.models.arrays import Array, Image
from dronevio.models.rotation import quat_wxyz_from_matrix
from dronevio.sim.appearance.instances import Instance, unique_names
from dronevio.sim.appearance.scenery import Page, add_instance, add_mirror, add_pages, quads_of, reduced_image
from dronevio.sim.appearance.solids import Box, Surface, visible_faces
from dronevio.sim.paths.space import Space
from dronevio.sim.worlds.layout import Layout, MovingObject

_COLLISION_GROUP = 3  # hidden in MuJoCo's viewers by default
_NEAR_M, _FAR_M = 0.03, 30.0
_PROTRUSION_M = 1e-3  # by which a solid may protrude from keep-out boxes without being an obstacle of its own
_PLACES = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), axis=-1).reshape(-1, 3)  # in a box that are compared


@dataclass(frozen=True, eq=False)
class Appearance:
    """Painted textures of a layout."""

    pages: Sequence[Page]
    """Pages of the static scenery."""
    moving_pages: Sequence[Sequence[Page]]
    """Pages of each moving object."""
    mirror: Image | None
    """(H, W, 3) Texture of the reflecting floor with its light map applied, if there is one."""

    def reduced(self, factor: int) -> "Appearance":
        """Return the appearance with textures that are smaller by a factor along each axis."""
        return Appearance(
            [page.reduced(factor) for page in self.pages],
            [[page.reduced(factor) for page in pages] for pages in self.moving_pages],
            None if self.mirror is None else reduced_image(self.mirror, factor),
        )


def assembled(layout: Layout, appearance: Appearance) -> mujoco.MjSpec:
    """Return the specification of a world."""
    spec = mujoco.MjSpec()
    _set_up_view(spec, layout, np.concatenate([page.vertices for page in appearance.pages]))
    add_collision_geoms(spec, layout)
    add_pages(spec, spec.worldbody, "scenery", appearance.pages)
    if layout.mirror is not None and appearance.mirror is not None:
        add_mirror(spec, layout.mirror.face, appearance.mirror, layout.mirror.reflectance)
    for thing, pages in zip(layout.moving, appearance.moving_pages, strict=True):
        add_pages(spec, _add_mover(spec, thing), thing.name, pages)
    add_moving_geoms(spec, layout)
    return spec


def assembled_instances(layout: Layout) -> mujoco.MjSpec:
    """Return the visible geometry of a world without textures, one geom per object instance."""
    spec = mujoco.MjSpec()
    quads = instance_quads(layout)
    _set_up_view(spec, layout, np.concatenate([part.reshape(-1, 3) for part in quads.values()]))
    for name, part in quads.items():
        add_instance(spec, spec.worldbody, name, part)
    for thing in layout.moving:
        sides = [quads_of(face.grid) for box in thing.boxes for face in box.faces()]
        add_instance(spec, _add_mover(spec, thing), thing.name, np.concatenate(sides))
    return spec


def instance_quads(layout: Layout) -> dict[str, Array]:
    """Return the visible static surfaces of a layout: the quadrangles (F, 4, 3) of each object instance by its name."""
    quads: dict[Instance, list[Array]] = {}
    for surface in seen_surfaces(layout):
        quads.setdefault(surface.instance, []).append(quads_of(surface.grid))
    for cutouts in (part for shared in layout.prints for part in shared.cutouts):
        quads.setdefault(cutouts.instance, []).append(cutouts.corners)
    names = unique_names(quads)
    return {name: np.concatenate(parts) for name, parts in zip(names, quads.values(), strict=True)}


def seen_surfaces(layout: Layout) -> list[Surface]:
    """Return all static surfaces with textures of their own; a reflecting floor is the last."""
    mirror = [] if layout.mirror is None else [layout.mirror.face]
    return [*layout.shell, *visible_faces(layout.boxes, layout.low, layout.high), *mirror]


def _add_mover(spec: mujoco.MjSpec, thing: MovingObject) -> mujoco.MjsBody:
    """Add the body of a moving object at its initial pose."""
    T_world_thing = thing.poses(np.zeros(1))[0]
    quat = quat_wxyz_from_matrix(T_world_thing[:3, :3])
    return spec.worldbody.add_body(name=thing.name, mocap=True, pos=T_world_thing[:3, 3], quat=quat)


def space_of(layout: Layout) -> Space:
    """Return the space of a layout for planning: bounds, keep-out boxes, lanes of moving objects, and all solids.

    Solids within the keep-out boxes, and those beyond the bounds, are left out, since they change no clearance outside.
    """
    kept_out, solids = _space_with(layout, (*layout.obstacles, *layout.lanes)), solid_space_of(layout)
    places = solids.centres[:, None] + (_PLACES * solids.halves[:, None]) @ solids.rotations.transpose(0, 2, 1)
    protruding = kept_out.clearance(places).max(axis=1) > _PROTRUSION_M
    return Space(
        kept_out.low,
        kept_out.high,
        np.concatenate([kept_out.centres, solids.centres[protruding]]),
        np.concatenate([kept_out.halves, solids.halves[protruding]]),
        np.concatenate([kept_out.rotations, solids.rotations[protruding]]),
    )


def solid_space_of(layout: Layout) -> Space:
    """Return the space of a layout with its solids, which are those of its collision geoms, as obstacles."""
    return _space_with(layout, layout.solids)


def _space_with(layout: Layout, boxes: Sequence[Box]) -> Space:
    """Return the space within the bounds of a layout around some boxes."""
    centres, halves = (np.array([getattr(box, part) for box in boxes]).reshape(-1, 3) for part in ("centre", "half"))
    rotations = np.array([box.R for box in boxes]).reshape(-1, 3, 3)
    return Space(layout.low.copy(), layout.high.copy(), centres, halves, rotations)


def outline_of(layout: Layout) -> Array:
    """Return the edges (L, 2, 3) of the bounds and the obstacles of a layout [m]."""
    bounds = _edges(0.5 * (layout.low + layout.high), 0.5 * (layout.high - layout.low), np.eye(3))
    return np.concatenate([bounds, *(_edges(box.centre, box.half, box.R) for box in layout.obstacles)])


def _set_up_view(spec: mujoco.MjSpec, layout: Layout, seen: Array) -> None:
    """Set clipping planes for visible points (N, 3), a light for the drone, and no shadow maps."""
    reach_m = float(np.linalg.norm(np.ptp(seen, axis=0)))
    spec.stat.extent = float(np.linalg.norm(layout.high - layout.low))
    spec.stat.center = 0.5 * (layout.low + layout.high)
    spec.visual.map.znear = _NEAR_M / spec.stat.extent
    spec.visual.map.zfar = max(_FAR_M, reach_m) / spec.stat.extent
    spec.visual.quality.shadowsize = 0
    spec.visual.quality.offsamples = 0
    spec.visual.headlight.ambient = [0.4, 0.4, 0.4]
    spec.visual.headlight.diffuse = [0.5, 0.5, 0.5]
    spec.visual.headlight.specular = [0.0, 0.0, 0.0]


def add_collision_geoms(spec: mujoco.MjSpec, layout: Layout) -> None:
    """Add the collision geoms: floor, walls and ceiling if there are any, solids, and moving objects."""
    middle = 0.5 * (layout.low + layout.high)
    planes = [("floor", 2, layout.low)]
    if layout.walled:
        planes.append(("ceiling", 2, layout.high))
        planes += [
            (f"wall_{'xy'[axis]}_{side}", axis, bound)
            for axis in (0, 1)
            for side, bound in (("low", layout.low), ("high", layout.high))
        ]
    for name, axis, bound in planes:
        place, inward = np.array([*middle[:2], 0.0]), np.zeros(3)
        place[axis], inward[axis] = bound[axis], 1.0 if bound is layout.low else -1.0
        spec.worldbody.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=[0.0, 0.0, 1.0],
            pos=place,
            zaxis=inward,
            group=_COLLISION_GROUP,
        )
    for number, box in enumerate(layout.solids):
        _add_block(spec.worldbody, f"{box.instance.kind}_part_{number}", box)


def add_moving_geoms(spec: mujoco.MjSpec, layout: Layout) -> None:
    """Add the collision geoms of the moving objects, on bodies of their names that are added where missing."""
    for thing in layout.moving:
        body = spec.body(thing.name) or _add_mover(spec, thing)
        for number, box in enumerate(thing.boxes):
            _add_block(body, f"{thing.name}_part_{number}", box)


def _add_block(body: mujoco.MjsBody, name: str, box: Box) -> None:
    """Add a collision box to a body."""
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=box.half,
        pos=box.centre,
        quat=quat_wxyz_from_matrix(box.R),
        group=_COLLISION_GROUP,
    )


def _edges(centre: Array, half: Array, R: Array) -> Array:
    """Return the twelve edges (12, 2, 3) of a box [m]."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
    corners = centre + (signs * half) @ R.T
    pairs = [(i, i | bit) for i in range(8) for bit in (4, 2, 1) if not i & bit]
    return np.stack([corners[[i, j]] for i, j in pairs])
