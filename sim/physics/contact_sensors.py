"""Sensors of contacts other than those of a foot with the ground, for simulations in `mujoco.batch`."""

import mujoco
import numpy as np

from dronevio.models.arrays import Array, Mask
from dronevio.sim.physics.collisions import COLLISION_GROUP, FEET, stands

_SLOTS = 4  # contacts of one geom that are examined
_FOUND_AND_NORMAL = sum(
    1 << int(field) for field in (mujoco.mjtConDataField.mjCONDATA_FOUND, mujoco.mjtConDataField.mjCONDATA_NORMAL)
)


class ContactSensors:
    """Sensors that tell what `CollisionDetector` tells of one simulation, since a batch has no access to contacts."""

    def __init__(self, spec: mujoco.MjSpec) -> None:
        """Add the sensors to the specification of a vehicle."""
        geoms = [geom for geom in spec.body("quadrotor").geoms if geom.group == COLLISION_GROUP]
        for geom in geoms:
            spec.add_sensor(
                name=f"contact_{geom.name}",
                type=mujoco.mjtSensor.mjSENS_CONTACT,
                objtype=mujoco.mjtObj.mjOBJ_GEOM,
                objname=geom.name,
                intprm=[_FOUND_AND_NORMAL, 0, _SLOTS],
            )
        self._foot = np.array([geom.name.startswith(FEET) for geom in geoms])

    def collide(self, sensed: Array) -> Mask:
        """Return which of k simulations collide (k,), given their ``sensordata`` (k, S)."""
        contacts = sensed.reshape(len(sensed), len(self._foot), _SLOTS, 4)
        standing = stands(self._foot[:, None], contacts[..., 3])
        return np.asarray(np.any((contacts[..., 0] > 0.0) & ~standing, axis=(1, 2)))
