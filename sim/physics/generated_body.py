"""Bodies that are generated from the parameters of a vehicle: arms to each rotor, discs, legs and a box."""

import mujoco
import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.quadrotor import Quadrotor
from dronevio.sim.physics.collisions import COLLISION_GROUP, FEET

VISIBLE_GROUP = 2
"""Group of the geoms that are drawn and touch nothing."""

# Lengths relative to the reach of the rotors, about as those of the research quadrotor.
_BOX_HALF = (0.32, 0.26, 0.14)
_LEG = 0.5  # from the centre of mass, or the lowest disc if that is lower, down to the foot
_FOOT_ASIDE, _FOOT_RADIUS = 0.5, 0.05
_ARM_RADIUS = 0.035
_DISC_HALF_HEIGHT = 0.04
_SAG = 0.1  # of the feet under the weight, relative to the height of the centre of mass
_FRONT_RGBA, _REAR_RGBA = (0.95, 0.45, 0.10, 0.35), (0.60, 0.65, 0.70, 0.35)
_CARBON_RGBA, _BOX_RGBA, _NOSE_RGBA = (0.20, 0.21, 0.24, 1.0), (0.10, 0.32, 0.28, 1.0), (0.85, 0.86, 0.88, 1.0)


def generated_spec(quadrotor: Quadrotor) -> mujoco.MjSpec:
    """Return the specification of a body ``quadrotor`` with the size of a vehicle, without sites, mass and controls.

    What is drawn and what touches are the same shapes. The feet are called ``foot_0`` to ``foot_3``.
    """
    spec = mujoco.MjSpec()
    reach, places = quadrotor.reach_m, quadrotor.rotor_positions_m
    foot_m = min(0.0, float(places[:, 2].min())) - _LEG * reach
    height_m = _FOOT_RADIUS * reach - foot_m
    body = spec.worldbody.add_body(name="quadrotor", pos=[0.0, 0.0, height_m])
    shapes = _Shapes(body, height_m)
    shapes.add("body", mujoco.mjtGeom.mjGEOM_BOX, np.zeros(3), reach * np.array(_BOX_HALF), _BOX_RGBA)
    nose = np.array([(_BOX_HALF[0] + 0.06) * reach, 0.0, 0.0])
    shapes.draw(mujoco.mjtGeom.mjGEOM_BOX, nose, reach * np.array([0.06, 0.15, 0.06]), _NOSE_RGBA)
    for k, place in enumerate(places):
        beneath = place - [0.0, 0.0, 2.0 * _DISC_HALF_HEIGHT * quadrotor.rotor_radius_m]
        shapes.add_bar(f"arm_{k}", np.array([0.0, 0.0, beneath[2]]), beneath, _ARM_RADIUS * reach)
        size = np.array([quadrotor.rotor_radius_m, _DISC_HALF_HEIGHT * quadrotor.rotor_radius_m, 0.0])
        colour = _FRONT_RGBA if place[0] > 0.1 * reach else _REAR_RGBA
        shapes.add(f"propeller_{k}", mujoco.mjtGeom.mjGEOM_CYLINDER, place, size, colour)
    for k, side in enumerate(_FOOT_ASIDE * reach * np.array([[1, -1], [-1, 1], [1, 1], [-1, -1]])):
        foot = np.array([*side, foot_m])
        shapes.draw_bar(np.array([*(0.5 * side), 0.0]), foot, _ARM_RADIUS * reach)
        shapes.add(f"{FEET}_{k}", mujoco.mjtGeom.mjGEOM_SPHERE, foot, np.full(3, _FOOT_RADIUS * reach), _CARBON_RGBA)
    return spec


class _Shapes:
    """Adds shapes to a body, each drawn and colliding."""

    def __init__(self, body: mujoco.MjsBody, height_m: float) -> None:
        """Define the body, and the contacts by the height of the standing centre of mass above the ground [m]."""
        self._body = body
        self._contact = {
            "contype": 0,  # touches the world (contype 1 there), never itself
            "conaffinity": 1,
            "group": COLLISION_GROUP,
            "mass": 0.0,
            "condim": 4,
            "friction": [0.9, 0.05 * height_m, 0.005 * height_m],
            "solref": [np.sqrt(_SAG * height_m / GRAVITY_M_S2), 1.0],
            "solimp": [0.95, 0.99, 0.02 * height_m, 0.5, 2.0],
        }

    def add(
        self, name: str, kind: mujoco.mjtGeom, pos: Array, size: Array, rgba: tuple[float, float, float, float]
    ) -> None:
        """Add a shape that is drawn and touches."""
        self.draw(kind, pos, size, rgba)
        self._body.add_geom(name=name, type=kind, pos=pos, size=size, **self._contact)

    def draw(self, kind: mujoco.mjtGeom, pos: Array, size: Array, rgba: tuple[float, float, float, float]) -> None:
        """Add a shape that is drawn only."""
        self._body.add_geom(type=kind, pos=pos, size=size, rgba=rgba, **_DRAWN)

    def add_bar(self, name: str, start: Array, end: Array, radius_m: float) -> None:
        """Add a capsule between two points that is drawn and touches."""
        self.draw_bar(start, end, radius_m)
        kind = mujoco.mjtGeom.mjGEOM_CAPSULE
        self._body.add_geom(name=name, type=kind, fromto=[*start, *end], size=[radius_m, 0, 0], **self._contact)

    def draw_bar(self, start: Array, end: Array, radius_m: float) -> None:
        """Add a capsule between two points that is drawn only."""
        kind = mujoco.mjtGeom.mjGEOM_CAPSULE
        self._body.add_geom(type=kind, fromto=[*start, *end], size=[radius_m, 0, 0], rgba=_CARBON_RGBA, **_DRAWN)


_DRAWN = {"contype": 0, "conaffinity": 0, "group": VISIBLE_GROUP, "mass": 0.0}
