"""Worlds to fly in: static, textured, lit, drawn from a seed."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import mujoco
import numpy as np
import numpy.typing as npt

from dronevio.models.errors import ConfigError
from dronevio.models.rotation import quat_wxyz_from_matrix
from dronevio.sim.lightmap import bake
from dronevio.sim.room import FREE_BOX_M, SIZE_M, Room, furnished_room
from dronevio.sim.scenery import Page, add_pages, paint_pages
from dronevio.sim.solids import Box, visible_faces
from dronevio.sim.space import Space

Array = npt.NDArray[np.float64]

WORLDS: tuple[str, ...] = ("room",)
"""The names that `build_world` knows."""

_STREAMS = (10, 11)  # layout and paint, beside those of `dronevio.sim.scenario`
_TOUCHED_GROUP = 3  # MuJoCo's viewers do not draw it unless asked
_NEAR_M, _FAR_M = 0.03, 30.0
_ROUTE_M = np.array(
    [[0.0, 0.0, 1.2], [2.1, -1.2, 1.0], [2.1, 1.2, 1.7], [0.0, 0.2, 0.9], [-2.1, -1.2, 1.5], [-2.1, 1.2, 1.1]]
)


@dataclass(frozen=True, eq=False)
class Mover:
    """Something in a world that moves by itself, along a path that is known beforehand."""

    body: str
    """Name of its mocap body in the world's spec."""
    poses: Callable[[Array], Array]
    """Maps times (M,) since the start of the flight [s] to poses (M, 4, 4) in the world."""


@dataclass(frozen=True, eq=False)
class World:
    """A place without the drone."""

    name: str
    """What it is called."""
    seed: int
    """What it was drawn from."""
    spec: mujoco.MjSpec
    """Static geometry, to compile or to attach a drone to: what is seen (group 0) and what is touched (group 3)."""
    outline: Array
    """(L, 2, 3) Line segments of the walls and the furniture, for drawing [m]."""
    free_box: Array
    """(2, 3) Least and greatest corner of the space free of obstacles [m]; the pad is under its middle."""
    space: Space
    """Shell and obstacles: where a drone may fly."""
    pad: Array
    """(3,) Middle of the landing pad, on the floor [m]."""
    route: Array
    """(R, 3) A tour through the whole world [m]: from above the pad, the straight legs between its points, and the one
    from the last back to the first, keep 0.6 m clear of every surface."""
    illumination: float = 1.0
    """Light that falls in, relative to a well lit room; the images of 1 are exposed as painted."""
    movers: tuple[Mover, ...] = ()
    """What moves."""


def build_world(name: str, seed: int) -> World:
    """Build a world.

    Args:
        name: One of `WORLDS`.
        seed: Draws furniture, patterns and light; the same seed gives the same bytes.

    Raises:
        ConfigError: There is no such world.
    """
    if name not in WORLDS:
        raise ConfigError(f"unknown world {name!r}; expected one of {', '.join(WORLDS)}")
    room, pages = _painted_room(seed)
    spec = mujoco.MjSpec()
    spec.modelname = f"{name}-{seed}"
    _set_up_view(spec)
    _add_touched(spec, room)
    add_pages(spec, pages)
    walls = Box(np.array([0.0, 0.0, 0.5 * SIZE_M[2]]), 0.5 * SIZE_M, room.obstacles[0].paint)
    outline = np.concatenate([_edges(box) for box in (walls, *room.obstacles)])
    return World(name, seed, spec, outline, FREE_BOX_M.copy(), _space(room), np.zeros(3), _ROUTE_M.copy())


@lru_cache(maxsize=2)
def _painted_room(seed: int) -> tuple[Room, tuple[Page, ...]]:
    """Return the room of a seed and its painted scenery; kept, since painting takes a second."""
    layout, paint = (np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(stream,))) for stream in _STREAMS)
    room = furnished_room(layout)
    corner = np.array([0.5 * SIZE_M[0], 0.5 * SIZE_M[1], 0.0])
    faces = [*room.shell, *visible_faces(room.boxes, -corner, np.array([corner[0], corner[1], SIZE_M[2]]))]
    light = bake(faces, [box for box in room.boxes if box.glow == 0.0], room.lights)
    return room, tuple(paint_pages(faces, light, paint))


def _space(room: Room) -> Space:
    """Return the room's shell and its obstacles."""
    corner = 0.5 * SIZE_M
    centres, halves, rotations = (
        np.array([getattr(box, part) for box in room.obstacles]) for part in ("centre", "half", "R")
    )
    return Space(
        np.array([-corner[0], -corner[1], 0.0]), np.array([corner[0], corner[1], SIZE_M[2]]), centres, halves, rotations
    )


def _set_up_view(spec: mujoco.MjSpec) -> None:
    """Set what every camera needs: clipping planes, a light for the drone, no shadow maps."""
    spec.stat.extent = float(np.linalg.norm(SIZE_M))
    spec.stat.center = [0.0, 0.0, 0.5 * SIZE_M[2]]
    spec.visual.map.znear = _NEAR_M / spec.stat.extent
    spec.visual.map.zfar = _FAR_M / spec.stat.extent
    spec.visual.quality.shadowsize = 0
    spec.visual.quality.offsamples = 0
    spec.visual.headlight.ambient = [0.4, 0.4, 0.4]
    spec.visual.headlight.diffuse = [0.5, 0.5, 0.5]
    spec.visual.headlight.specular = [0.0, 0.0, 0.0]


def _add_touched(spec: mujoco.MjSpec, room: Room) -> None:
    """Add what a drone can touch: floor, ceiling, walls, and a box around each piece of furniture."""
    plane, block = mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_BOX
    spec.worldbody.add_geom(name="floor", type=plane, size=[0.0, 0.0, 1.0], group=_TOUCHED_GROUP)
    top = [0.0, 0.0, SIZE_M[2]]
    spec.worldbody.add_geom(
        name="ceiling", type=plane, size=[0.0, 0.0, 1.0], pos=top, zaxis=[0.0, 0.0, -1.0], group=_TOUCHED_GROUP
    )
    for axis in (0, 1):
        for sign, side in ((-1.0, "low"), (1.0, "high")):
            inward = np.zeros(3)
            inward[axis] = -sign
            spec.worldbody.add_geom(
                name=f"wall_{'xy'[axis]}_{side}",
                type=plane,
                size=[0.0, 0.0, 1.0],
                pos=-0.5 * SIZE_M[axis] * inward,
                zaxis=inward,
                group=_TOUCHED_GROUP,
            )
    for number, box in enumerate(room.obstacles):
        spec.worldbody.add_geom(
            name=f"obstacle_{number}",
            type=block,
            size=box.half,
            pos=box.centre,
            quat=quat_wxyz_from_matrix(box.R),
            group=_TOUCHED_GROUP,
        )


def _edges(box: Box) -> Array:
    """Return the twelve edges (12, 2, 3) of a box [m]."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
    corners = box.centre + (signs * box.half) @ box.R.T
    pairs = [(i, i | bit) for i in range(8) for bit in (4, 2, 1) if not i & bit]
    return np.stack([corners[[i, j]] for i, j in pairs])
