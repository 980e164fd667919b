"""Simulations of many vehicles of one type in one world by `mujoco.batch`."""

from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch

from dronevio.models.arrays import Array, Mask
from dronevio.models.rotation import quat_wxyz_from_matrix
from dronevio.sim.physics.batch_contacts import BatchContacts
from dronevio.sim.physics.clearance_grid import WITHOUT_CONTACTS, ClearanceGrid
from dronevio.sim.physics.motion import middle_of_interval
from dronevio.sim.physics.vehicle_states import Rows, VehicleParameters, VehicleStates

Indices = npt.NDArray[np.intp]

FASTEST = 1e4
"""Largest component of a velocity [m/s] or angular velocity [rad/s] that is not divergence."""
_NONE = np.zeros(0, dtype=np.intp)
_RECORDED = int(mujoco.mjtState.mjSTATE_QPOS | mujoco.mjtState.mjSTATE_QVEL)


@dataclass(frozen=True, eq=False)
class Interval:
    """One IMU interval of k simulations."""

    start: Array
    """(13, k) Motion at its start; that of diverging vehicles is stopped."""
    middle: Array | None
    """(13, k) Motion in its middle, if it is recorded."""
    touched: Mask
    """(k,) Which vehicles have collided so far."""
    diverged: Mask
    """(k,) Which simulations have diverged so far."""


class BatchSimulation:
    """n simulations of a vehicle, which advance by IMU intervals; k of them may be selected by rows."""

    def __init__(self, spec: mujoco.MjSpec, count: int, substeps: int, recorded: bool, nthread: int) -> None:
        """Compile the model.

        Args:
            spec: Specification of the physics; it is not changed.
            count: Number of simulations.
            substeps: Number of time steps of an IMU interval.
            recorded: Whether the motion in the middle of an interval is wanted.
            nthread: Number of threads; 0 means one for each processor.
        """
        self._detector = BatchContacts(spec, count, nthread)
        model = spec.compile()
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self._body = model.body("quadrotor").id
        self._batch = Batch(model, count, nthread, persistent=True)
        self._pose, self._twist = self._batch.bind("qpos"), self._batch.bind("qvel")
        self._control, self._contacts = self._batch.bind("ctrl"), self._batch.bind("ncon")
        self._grid = ClearanceGrid(model, substeps * model.opt.timestep)
        self._flags, self._disabled = int(model.opt.disableflags), self._batch.expand("opt.disableflags")
        self._masses, self._inertias = self._batch.expand("body_mass"), self._batch.expand("body_inertia")
        self._batch.set_const()
        self._substeps = substeps
        self._record = np.zeros((count, substeps, 13)) if recorded else None

    def save(self) -> Array:
        """Return the states (n, S) of MuJoCo."""
        return np.array(self._batch.state)

    def restore(self, saved: Array, parameters: VehicleParameters) -> None:
        """Return to states (n, S) of vehicles with given parameters."""
        self.change_bodies(np.arange(len(saved)), parameters)
        self._batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
        self._batch.state[:] = saved

    def change_bodies(self, rows: Indices, parameters: VehicleParameters) -> None:
        """Give k bodies the masses and moments of inertia of k vehicles."""
        self._masses[rows, self._body] = parameters.mass_kg
        self._inertias[rows, self._body] = parameters.inertia_kg_m2
        self._batch.set_const(rows)

    def place(self, rows: Indices, states: VehicleStates) -> None:
        """Reset k simulations to the states of k vehicles."""
        self._batch.reset(rows, stage=mujoco.mjtStage.mjSTAGE_NONE)
        self._pose[rows, :3] = states.position_m
        self._pose[rows, 3:] = quat_wxyz_from_matrix(states.R_world_vehicle)
        self._twist[rows, :3] = states.velocity_m_s
        self._twist[rows, 3:] = states.rate_rad_s

    def motion(self, rows: Rows) -> Array:
        """Return the motion (13, k) of the physics."""
        return np.concatenate([self._pose[rows].T, self._twist[rows].T])

    def run(self, rows: Rows, start: Array, wrench: Array, touched: Mask, diverged: Mask) -> Interval:
        """Run k simulations for an interval. A diverging vehicle is held at its pose at the start.

        Args:
            rows: The simulations.
            start: (13, k) Their current motion.
            wrench: (k, 6) Constant forces [N] and torques [N m].
            touched: (k,) Which vehicles have collided before.
            diverged: (k,) Which simulations have diverged before.
        """
        clear = self._grid.clear(start[:3], start[7:10])
        self._disabled[rows] = np.where(clear, self._flags | WITHOUT_CONTACTS, self._flags)
        self._control[rows] = wrench
        middle = self._stepped(None if isinstance(rows, slice) else rows)
        touched = self._touching(rows, touched)
        stopped = self._diverging(rows, diverged)
        if stopped.size:
            diverged, start = diverged.copy(), start.copy()
            diverged[stopped], start[7:, stopped] = True, 0.0
            indices = self._indices(rows)[stopped]
            self._batch.reset(indices, stage=mujoco.mjtStage.mjSTAGE_NONE)
            self._pose[indices], self._twist[indices] = start[:7, stopped].T, 0.0
            if middle is not None:
                middle[:, stopped] = start[:, stopped]
        return Interval(start, middle, touched, diverged)

    def _stepped(self, ids: Indices | None) -> Array | None:
        """Run some simulations, or all, for an interval; return the motion (13, k) in its middle if it is recorded."""
        substeps = self._substeps
        if self._record is None:
            self._batch.step(ids, substeps)
            return None
        record = self._record if ids is None else np.empty((len(ids), substeps, 13))
        self._batch.rollout(substeps, record=[_RECORDED], ids=ids, out={_RECORDED: record})
        half = substeps // 2
        return middle_of_interval(np.array(record[:, half - 1].T, order="C"), record[:, half].T, substeps)

    def _touching(self, rows: Rows, touched: Mask) -> Mask:
        """Return which of k vehicles have collided, given those (k,) that had before."""
        candidates = np.flatnonzero((self._contacts[rows] > 0) & ~touched)
        if not candidates.size:
            return touched
        indices, touched = self._indices(rows)[candidates], touched.copy()
        finite = np.isfinite(self._pose[indices]).all(axis=1)
        touched[candidates[finite]] = self._detector.detect(indices[finite], self._pose[indices[finite]])
        return touched

    def _diverging(self, rows: Rows, diverged: Mask) -> Indices:
        """Return which of k simulations diverge, as indices into them, with those (k,) that have before."""
        pose, twist, warning = self._pose[rows], self._twist[rows], self._batch.warning[rows, :, 1]
        slow = np.abs(pose).max() < FASTEST and np.abs(twist).max() < FASTEST  # false for NaN
        if slow and not warning.any() and not diverged.any():
            return _NONE
        valid = (np.abs(pose) < FASTEST).all(axis=1) & (np.abs(twist) < FASTEST).all(axis=1)
        return np.flatnonzero(~valid | warning.any(axis=1) | diverged)

    def _indices(self, rows: Rows) -> Indices:
        """Return the indices (k,) of the selected simulations."""
        return np.arange(len(self._pose))[rows]
