"""Simulations of vehicles among the static geoms of a world by `mujoco.batch`, for the intervals with contacts."""

import mujoco
import numpy as np
from mujoco.batch import Batch

from dronevio.models.arrays import Array
from dronevio.sim.physics.contact_sensors import ContactSensors
from dronevio.sim.physics.free_flight import Stepped, diverging, quaternion_after
from dronevio.sim.physics.motion import middle_of_interval
from dronevio.sim.physics.vehicle_states import VehicleParameters

_SLOTS = 32  # vehicles in one call; each has a `mujoco.MjData` of its own, in which all static geoms keep their places
_SLOTS_OF_PLANES = 256  # in a world of few geoms, each thread has one
_RECORDED = int(mujoco.mjtState.mjSTATE_QPOS | mujoco.mjtState.mjSTATE_QVEL)


class ContactSimulation:
    """Simulation of intervals of vehicles among static geoms; it keeps nothing from one interval to the next.

    MuJoCo's Euler integrator is semi-implicit: its poses belong to half a time step later than its velocities. They are
    moved by half a step at both ends, so that times agree and free flight continues where contacts end.
    """

    def __init__(self, spec: mujoco.MjSpec, count: int, substeps: int, nthread: int) -> None:
        """Compile the model.

        Args:
            spec: Specification of a vehicle and static geoms, which gets sensors of the contacts.
            count: Largest number of vehicles.
            substeps: Number of time steps of an interval.
            nthread: Number of threads; 0 means one for each processor.
        """
        self._sensors = ContactSensors(spec)
        self.model = spec.compile()
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self._substeps, self._nthread = substeps, nthread
        self._count, self._blank = count, np.zeros(0)
        self._made: Batch | None = None

    def run(self, motion: Array, wrench: Array, vehicles: VehicleParameters) -> Stepped:
        """Simulate an interval of k vehicles.

        Args:
            motion: (13, k) Motion at its start.
            wrench: (k, 6) Constant forces [N] and torques [N m].
            vehicles: Masses and moments of inertia of the k vehicles.
        """
        k, half = motion.shape[1], self._substeps // 2
        ahead, constants = moved_ahead(motion, 0.5 * self.model.opt.timestep).T, body_constants(vehicles)
        steps = np.empty((k, self._substeps, 13))  # poses and twists after each
        collided, failed = np.zeros(k, dtype=np.bool_), np.zeros(k, dtype=np.bool_)
        batch = self._batch
        for first in range(0, k, batch.nsim):
            rows = slice(first, first + batch.nsim)
            ids = np.arange(len(ahead[rows]))
            batch.state[ids], batch.warning[ids] = self._blank, 0
            batch.bind("qpos")[ids], batch.bind("qvel")[ids] = ahead[rows, :7], ahead[rows, 7:]
            batch.bind("ctrl")[ids] = wrench[rows]
            for name, values in constants.items():
                batch.expand(name)[ids] = values[rows]
            batch.rollout(self._substeps, record=[_RECORDED], ids=ids, out={_RECORDED: steps[rows]})
            collided[rows] = self._sensors.collide(batch.bind("sensordata")[ids])
            failed[rows] = batch.warning[ids, :, 1].any(axis=1)
        middle = middle_of_interval(steps[:, half - 1].T, steps[:, half].T, self._substeps)
        middle, end = (moved_ahead(each, -0.5 * self.model.opt.timestep) for each in (middle, steps[:, -1].T))
        failed |= diverging(end)
        return Stepped(middle, end, collided & ~failed, failed)

    @property
    def _batch(self) -> Batch:
        """The simulations, which are made when they are first needed."""
        if self._made is None:
            sleeps = bool(self.model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP)
            slots = min(self._count, _SLOTS if sleeps else _SLOTS_OF_PLANES)
            self._made = Batch(self.model, slots, self._nthread, persistent=sleeps)
            self._blank = self._made.state[0].copy()
        return self._made


def moved_ahead(motion: Array, duration_s: float) -> Array:
    """Return a motion (13, k) with the poses after a time [s], and the same velocities."""
    moved = np.array(motion, order="C")
    moved[:3] += duration_s * motion[7:10]
    p, q, r = duration_s * motion[10:]
    moved[3:7] = quaternion_after(motion[3:7] / np.linalg.norm(motion[3:7], axis=0), (p, q, r))
    return moved


def body_constants(vehicles: VehicleParameters) -> dict[str, Array]:
    """Return the fields of `mujoco.MjModel` that depend on masses and moments of inertia of k vehicles, by name.

    They are those that ``mj_setConst`` would compute from the whole world for each vehicle.
    """
    mass, inertia = vehicles.mass_kg[:, None], vehicles.inertia_kg_m2
    easily, turning = 1.0 / mass, (1.0 / inertia).mean(axis=1, keepdims=True)
    nothing = np.zeros_like(mass)
    return {
        "body_mass": np.hstack([nothing, mass]),
        "body_subtreemass": np.hstack([mass, mass]),
        "body_inertia": np.stack([np.zeros_like(inertia), inertia], axis=1),
        "body_invweight0": np.stack([np.hstack([nothing, nothing]), np.hstack([easily, turning])], axis=1),
        "dof_M0": np.hstack([mass, mass, mass, inertia]),
        "dof_invweight0": np.hstack([easily, easily, easily, turning, turning, turning]),
    }
