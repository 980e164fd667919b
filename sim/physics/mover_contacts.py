"""Contacts of vehicles with moving objects, which are not part of the physics."""

from collections.abc import Sequence
from math import dist

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch

from dronevio.models.arrays import Array, Mask
from dronevio.sim.physics.collisions import CollisionDetector, Moving
from dronevio.sim.physics.contact_sensors import ContactSensors
from dronevio.sim.physics.mover_bounds import WINDOW, MoverBounds
from dronevio.sim.physics.mover_table import MoverTable


class MoverContacts:
    """Detector of contacts of a vehicle with moving objects, of which only near ones are examined.

    They push nothing: a contact ends a flight, and a step of the physics with the bodies of twenty people takes ten
    times as long.
    """

    def __init__(self, model: mujoco.MjModel, movers: Sequence[Moving], interval_s: float) -> None:
        """Take a model of the vehicle and the moving objects, these objects, and the length of an interval [s]."""
        self._bounds, self._table = MoverBounds(model, movers, interval_s), MoverTable(model, movers, interval_s)
        self._model, self._data = model, mujoco.MjData(model)
        self._detector = CollisionDetector(model)
        self._window, self._place, self._gap_m = -1, np.zeros(3), 0.0  # of the last comparison with the bounds

    def detect(self, interval: int, pose: Array) -> tuple[str, str] | None:
        """Return the names of the vehicle's part and of the object of a collision, or None without one.

        Args:
            interval: Number of the interval, at the start of which the objects are met.
            pose: (7,) Position and orientation of the vehicle.
        """
        position = pose[:3]
        if interval // WINDOW == self._window and dist(position, self._place) < self._gap_m:
            return None
        number = np.array([interval])
        self._window, self._place = interval // WINDOW, position.copy()
        self._gap_m = float(self._bounds.gap_m(number, position[None])[0])
        if self._gap_m > 0.0:
            return None
        positions, quats = self._table.at(number)
        self._data.mocap_pos[:], self._data.mocap_quat[:] = positions[0], quats[0]
        self._data.qpos[:] = pose
        mujoco.mj_fwdPosition(self._model, self._data)
        return self._detector.detect(self._data)


class BatchMoverContacts:
    """Detector of contacts of many vehicles with moving objects, as `MoverContacts`, at the time of each vehicle."""

    def __init__(
        self, spec: mujoco.MjSpec, movers: Sequence[Moving], interval_s: float, count: int, nthread: int
    ) -> None:
        """Compile the model.

        Args:
            spec: Specification of the vehicle and the moving objects; it is not changed.
            movers: These objects.
            interval_s: Length of an interval [s].
            count: Number of vehicles.
            nthread: Number of threads; 0 means one for each processor.
        """
        spec = spec.copy()
        self._sensors = ContactSensors(spec)
        model = spec.compile()
        self._batch = Batch(model, count, nthread)
        self._pose, self._sensed = self._batch.bind("qpos"), self._batch.bind("sensordata")
        self._positions, self._quats = self._batch.bind("mocap_pos"), self._batch.bind("mocap_quat")
        self._bounds, self._table = MoverBounds(model, movers, interval_s), MoverTable(model, movers, interval_s)

    def detect(self, rows: npt.NDArray[np.intp], interval: npt.NDArray[np.int64], pose: Array) -> Mask:
        """Return which of k vehicles collide (k,).

        Args:
            rows: (k,) Indices of the vehicles.
            interval: (k,) Numbers of the intervals, at the starts of which the objects are met.
            pose: (k, 7) Positions and orientations of the vehicles.
        """
        near = self._bounds.near(interval, pose[:, :3])
        if near.any():
            rows, pose = rows[near], pose[near]
            self._pose[rows] = pose
            self._positions[rows], self._quats[rows] = self._table.at(interval[near])
            self._batch.forward(rows, stage=mujoco.mjtStage.mjSTAGE_POS)
            near[near] = self._sensors.collide(self._sensed[rows])
        return near
