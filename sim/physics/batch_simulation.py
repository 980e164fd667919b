"""Simulations of many vehicles of one type in one world by `mujoco.batch`."""

from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch

from dronevio.models.arrays import Array, Mask
from dronevio.models.rotation import quat_wxyz_from_matrix
from dronevio.sim.physics.clearance_grid import ClearanceGrid
from dronevio.sim.physics.contact_sensors import ContactSensors
from dronevio.sim.physics.motion import middle_of_interval
from dronevio.sim.physics.vehicle_states import Rows, VehicleParameters, VehicleStates

Indices = npt.NDArray[np.intp]

FASTEST = 1e4
"""Largest component of a velocity [m/s] or angular velocity [rad/s] that is not divergence."""
_NONE = np.zeros(0, dtype=np.intp)
_SLEEP = int(mujoco.mjtEnableBit.mjENBL_SLEEP)
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
    """n simulations of a vehicle, which advance by IMU intervals; k of them may be selected by rows.

    There are three batches. Most vehicles can touch nothing during an interval: they are simulated in an empty world,
    with one `mujoco.MjData` for each thread; so are those that can touch planes only, such as the floor on which they
    stand, in a world of planes. The others are simulated among the solids, with one each, since only then can the
    kinematics of thousands of static geoms be left out of the steps.
    """

    def __init__(self, spec: mujoco.MjSpec, count: int, substeps: int, recorded: bool, nthread: int) -> None:
        """Compile the model.

        Args:
            spec: Specification of the physics; it is not changed.
            count: Number of simulations.
            substeps: Number of time steps of an IMU interval.
            recorded: Whether the motion in the middle of an interval is wanted.
            nthread: Number of threads; 0 means one for each processor.
        """
        empty, planes, full = spec.copy(), spec.copy(), spec.copy()
        for world in (empty, planes):
            for geom in world.worldbody.geoms:
                if world is empty or geom.type != mujoco.mjtGeom.mjGEOM_PLANE:
                    world.delete(geom)
            world.option.enableflags &= ~_SLEEP
        sensors = [ContactSensors(world) for world in (planes, full)]
        model, interval_s = full.compile(), substeps * spec.option.timestep
        self._grid = ClearanceGrid(model, interval_s)
        self._solids = ClearanceGrid(model, interval_s, with_planes=False)
        self._free = _batch(empty.compile(), count, nthread)
        self._low = _batch(planes.compile(), count, nthread)
        self._near = _batch(model, count, nthread)
        self._contacts = {
            batch: (each, batch.bind("sensordata"))
            for batch, each in zip((self._low, self._near), sensors, strict=True)
        }
        self._pose, self._twist, self._control = (self._free.bind(name) for name in ("qpos", "qvel", "ctrl"))
        self._substeps, self._recorded = substeps, recorded

    def save(self) -> Array:
        """Return the states (n, S) of MuJoCo."""
        return np.array(self._free.state)

    def restore(self, saved: Array, parameters: VehicleParameters) -> None:
        """Return to states (n, S) of vehicles with given parameters."""
        self.change_bodies(np.arange(len(saved)), parameters)
        self._free.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
        self._free.state[:] = saved

    def change_bodies(self, rows: Indices, parameters: VehicleParameters) -> None:
        """Give k bodies the masses and moments of inertia of k vehicles."""
        for batch in (self._free, self._low, self._near):
            body = batch.model.body("quadrotor").id
            batch.expand("body_mass")[rows, body] = parameters.mass_kg
            batch.expand("body_inertia")[rows, body] = parameters.inertia_kg_m2
            batch.set_const(rows)

    def place(self, rows: Indices, states: VehicleStates) -> None:
        """Reset k simulations to the states of k vehicles."""
        self._free.reset(rows, stage=mujoco.mjtStage.mjSTAGE_NONE)
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
        self._control[rows] = wrench
        indices = np.arange(len(self._pose))[rows]
        free, touched = self._grid.clear(start[:3], start[7:10]), touched.copy()
        near = ~free
        near[near] = ~self._solids.clear(start[:3, near], start[7:10, near])
        middle = np.empty((13, len(near))) if self._recorded else None
        for batch, some in ((self._free, free), (self._low, ~free & ~near), (self._near, near)):
            if not some.any():
                continue
            moved = self._stepped(batch, indices[some])
            if middle is not None:
                middle[:, some] = moved
            if batch is not self._free:
                sensors, sensed = self._contacts[batch]
                finite = np.isfinite(self._pose[indices[some]]).all(axis=1)
                touched[some] |= finite & sensors.collide(sensed[indices[some]])
        stopped = self._diverging(rows, diverged)
        if stopped.size:
            diverged, start = diverged.copy(), start.copy()
            diverged[stopped], start[7:, stopped] = True, 0.0
            indices = indices[stopped]
            self._free.reset(indices, stage=mujoco.mjtStage.mjSTAGE_NONE)
            self._pose[indices], self._twist[indices] = start[:7, stopped].T, 0.0
            if middle is not None:
                middle[:, stopped] = start[:, stopped]
        return Interval(start, middle, touched, diverged)

    def _stepped(self, batch: Batch, ids: Indices) -> Array | None:
        """Run k simulations of a batch for an interval; return the motion (13, k) in its middle if it is recorded."""
        if batch is not self._free:
            batch.state[ids], batch.warning[ids] = self._free.state[ids], 0
        middle = None
        if self._recorded:
            record, half = np.empty((len(ids), self._substeps, 13)), self._substeps // 2
            batch.rollout(self._substeps, record=[_RECORDED], ids=ids, out={_RECORDED: record})
            middle = middle_of_interval(np.array(record[:, half - 1].T, order="C"), record[:, half].T, self._substeps)
        else:
            batch.step(ids, self._substeps)
        if batch is not self._free:
            self._free.state[ids], self._free.warning[ids] = batch.state[ids], batch.warning[ids]
        return middle

    def _diverging(self, rows: Rows, diverged: Mask) -> Indices:
        """Return which of k simulations diverge, as indices into them, with those (k,) that have before."""
        pose, twist, warning = self._pose[rows], self._twist[rows], self._free.warning[rows, :, 1]
        slow = np.abs(pose).max() < FASTEST and np.abs(twist).max() < FASTEST  # false for NaN
        if slow and not warning.any() and not diverged.any():
            return _NONE
        valid = (np.abs(pose) < FASTEST).all(axis=1) & (np.abs(twist) < FASTEST).all(axis=1)
        return np.flatnonzero(~valid | warning.any(axis=1) | diverged)


def _batch(model: mujoco.MjModel, count: int, nthread: int) -> Batch:
    """Return simulations of vehicles of individual masses."""
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    batch = Batch(model, count, nthread, persistent=bool(model.opt.enableflags & _SLEEP))
    batch.expand("body_mass")
    batch.expand("body_inertia")
    batch.set_const()
    return batch
