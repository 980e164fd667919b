"""Collision geometry of a world, and detection of contacts other than those of the feet with the ground."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array

COLLISION_GROUP = 3
"""Group of the collision geoms; MuJoCo's viewers hide it by default."""
FEET = "foot"
"""Prefix of the names of a vehicle's feet."""
_LEVEL = 0.7  # smallest vertical component of the contact normal of a foot on the ground

_COPIED = ("name", "type", "size", "pos", "quat", "group")
_COPIED_TURN = ("type", "axisangle", "xyaxes", "zaxis", "euler")  # alternative parameters of an orientation


class Moving(Protocol):
    """Interface of an object of a world that moves along a path that does not depend on the flight."""

    @property
    def body(self) -> str:
        """Name of its mocap body."""

    @property
    def poses(self) -> Callable[[Array], Array]:
        """Function from times (M,) since the start of the flight [s] to poses T_world_body (M, 4, 4)."""


@dataclass(frozen=True)
class Collision:
    """A contact of the drone other than that of a foot with the ground."""

    t_ns: int
    """Time of the contact [ns]."""
    part: str
    """Name of the part of the drone."""
    against: str
    """Name of the object."""
    speed_m_s: float
    """Speed of the drone before the contact [m/s]."""

    def __str__(self) -> str:
        return (
            f"crashed at t = {self.t_ns * 1e-9:.2f} s: {self.part} against {self.against} at {self.speed_m_s:.1f} m/s"
        )


def add_floor(spec: mujoco.MjSpec) -> None:
    """Add an infinite floor at z = 0."""
    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 1.0], group=COLLISION_GROUP)


def add_static_geoms(spec: mujoco.MjSpec, surroundings: mujoco.MjSpec, planes_only: bool = False) -> None:
    """Add the collision geoms (group 3) of a world, without visible geometry and without its moving objects."""
    for body in surroundings.bodies:
        if not body.mocap:
            _add_collision_geoms(spec.worldbody, body, planes_only)


def add_movers(spec: mujoco.MjSpec, surroundings: mujoco.MjSpec) -> None:
    """Add the moving objects of a world, which are mocap bodies, with their collision geoms (group 3)."""
    for body in surroundings.bodies:
        if body.mocap:
            copy = spec.worldbody.add_body(name=body.name, mocap=True, pos=body.pos, quat=body.quat)
            _add_collision_geoms(copy, body)


def _add_collision_geoms(to: mujoco.MjsBody, body: mujoco.MjsBody, planes_only: bool = False) -> None:
    """Add the collision geoms of a body to another."""
    for geom in body.geoms:
        if geom.group == COLLISION_GROUP and (geom.type == mujoco.mjtGeom.mjGEOM_PLANE or not planes_only):
            copy = to.add_geom(**{name: getattr(geom, name) for name in _COPIED})
            for name in _COPIED_TURN:
                setattr(copy.alt, name, getattr(geom.alt, name))


def stands(is_foot: npt.NDArray[np.bool_], normal_z: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    """Return which contacts are those of a foot on level ground, given the vertical components of their normals."""
    return np.asarray(is_foot & (np.abs(normal_z) > _LEVEL))


class CollisionDetector:
    """Detector of contacts other than those of a foot with the ground."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self._names = [model.geom(k).name for k in range(model.ngeom)]
        self._of_world = np.asarray(model.body_rootid[model.geom_bodyid]) != model.body("quadrotor").rootid
        self._feet = np.array([name.startswith(FEET) for name in self._names])

    def detect(self, data: mujoco.MjData) -> tuple[str, str] | None:
        """Return the names of the drone's part and of the object of a collision, or None without one."""
        if not data.ncon:
            return None
        pairs = data.contact.geom
        flipped = self._of_world[pairs[:, :1]]
        own, other = np.where(flipped, pairs[:, ::-1], pairs).T
        illegal = ~stands(self._feet[own], data.contact.frame[:, 2])
        if not illegal.any():
            return None
        first = int(np.argmax(illegal))
        return self._names[own[first]], self._names[other[first]]
