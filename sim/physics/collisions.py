"""Collisions: what of a world can be touched, and when a drone has touched it otherwise than with its feet."""

from dataclasses import dataclass

import mujoco
import numpy as np

COLLISION_GROUP = 3
"""The group of the geoms that are touched; MuJoCo's viewers do not draw it unless asked."""
FEET = "foot"
"""How the names of a vehicle's feet begin."""

_COPIED = ("name", "type", "size", "pos", "quat", "group")
_COPIED_TURN = ("type", "axisangle", "xyaxes", "zaxis", "euler")  # other ways to say an orientation
_LEVEL = 0.7  # a foot stands where the contact's normal points upwards by this much


@dataclass(frozen=True)
class Collision:
    """The drone touched something that it should not have."""

    t_ns: int
    """When [ns]."""
    part: str
    """With which of its parts."""
    against: str
    """What it was."""
    speed_m_s: float
    """How fast it flew just before [m/s]."""

    def __str__(self) -> str:
        return (
            f"crashed at t = {self.t_ns * 1e-9:.2f} s: {self.part} against {self.against} at {self.speed_m_s:.1f} m/s"
        )


def add_floor(spec: mujoco.MjSpec) -> None:
    """Add an endless floor at z = 0."""
    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 1.0], group=COLLISION_GROUP)


def add_collision_geoms(spec: mujoco.MjSpec, surroundings: mujoco.MjSpec) -> None:
    """Add the touched geoms (group 3) of a world's static body, without anything that is only seen."""
    for geom in surroundings.worldbody.geoms:
        if geom.group == COLLISION_GROUP:
            copy = spec.worldbody.add_geom(**{name: getattr(geom, name) for name in _COPIED})
            for name in _COPIED_TURN:
                setattr(copy.alt, name, getattr(geom.alt, name))


class CollisionDetector:
    """Appearance at the physics' contacts for one that is not of a foot with something to stand on."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self._names = [model.geom(k).name for k in range(model.ngeom)]
        self._of_world = np.asarray(model.geom_bodyid) == 0
        self._feet = np.array([name.startswith(FEET) for name in self._names])

    def detect(self, data: mujoco.MjData) -> tuple[str, str] | None:
        """Return the names of the drone's part and of what it touches, or None where nothing is illegal."""
        if not data.ncon:
            return None
        pairs = data.contact.geom
        flipped = self._of_world[pairs[:, :1]]
        own, other = np.where(flipped, pairs[:, ::-1], pairs).T
        illegal = ~(self._feet[own] & (np.abs(data.contact.frame[:, 2]) > _LEVEL))
        if not illegal.any():
            return None
        first = int(np.argmax(illegal))
        return self._names[own[first]], self._names[other[first]]
