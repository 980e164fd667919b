"""Contacts of many simulations of one model, other than those of a foot with the ground."""

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch

from dronevio.models.arrays import Array
from dronevio.sim.physics.collisions import COLLISION_GROUP, FEET, stands

_SLOTS = 4  # contacts of one geom that are examined
_FOUND_AND_NORMAL = sum(
    1 << int(field) for field in (mujoco.mjtConDataField.mjCONDATA_FOUND, mujoco.mjtConDataField.mjCONDATA_NORMAL)
)


class BatchContacts:
    """Detector of contacts, as `CollisionDetector`, for simulations in `mujoco.batch`.

    A batch has no access to contacts, and contact sensors would add to the cost of every step. The sensors are
    therefore those of a second model, which is evaluated for the simulations that have contacts.
    """

    def __init__(self, spec: mujoco.MjSpec, count: int, nthread: int) -> None:
        """Compile the model with sensors.

        Args:
            spec: Specification of the physics; it is not changed.
            count: Number of simulations.
            nthread: Number of threads; 0 means one for each processor.
        """
        spec = spec.copy()
        spec.option.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)  # which a batch of one state does not have
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
        self.model = spec.compile()
        """The model with sensors."""
        self._batch = Batch(self.model, count, nthread)
        self._pose = self._batch.bind("qpos")
        self._moving = self._batch.bind("mocap_pos"), self._batch.bind("mocap_quat")
        self._sensed = self._batch.bind("sensordata")

    def detect(
        self, rows: npt.NDArray[np.intp], pose: Array, moving: tuple[Array, Array] | None = None
    ) -> npt.NDArray[np.bool_]:
        """Return which of k simulations collide (k,).

        Args:
            rows: (k,) Indices of the simulations.
            pose: (k, 7) Positions and orientations of the vehicle.
            moving: Positions (k, M, 3) [m] and quaternions (k, M, 4) of the moving objects, if there are any.
        """
        self._pose[rows] = pose
        if moving is not None:
            for bound, values in zip(self._moving, moving, strict=True):
                bound[rows] = values.reshape(len(rows), *bound.shape[1:])
        self._batch.forward(rows, stage=mujoco.mjtStage.mjSTAGE_POS)
        sensed = self._sensed[rows].reshape(len(rows), len(self._foot), _SLOTS, 4)
        standing = stands(self._foot[:, None], sensed[..., 3])
        return np.asarray(np.any((sensed[..., 0] > 0.0) & ~standing, axis=(1, 2)))
