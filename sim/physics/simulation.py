"""Simulation of one vehicle in a world by MuJoCo, and the record of its motion."""

import mujoco
import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.rotation import quat_wxyz_from_matrix
from dronevio.sim.physics.clearance_grid import WITHOUT_CONTACTS, ClearanceGrid
from dronevio.sim.physics.collisions import CollisionDetector
from dronevio.sim.physics.motion import Motion, extrapolated_back, middle_of_interval


class Simulation:
    """Simulation of a vehicle, which advances by IMU intervals."""

    def __init__(self, model: mujoco.MjModel, substeps: int) -> None:
        """Take the model and the number of time steps of an IMU interval."""
        self._model, self._substeps = model, substeps
        self._grid = ClearanceGrid(model, substeps * model.opt.timestep)
        self._flags = int(model.opt.disableflags)
        self._data = mujoco.MjData(model)
        self._collision_detector = CollisionDetector(model)

    def place(
        self, pose: Array, T_world_vehicle: Array | None, velocity_m_s: Array | None, rate_rad_s: Array | None
    ) -> None:
        """Reset the simulation to a pose (7,), which a pose (4, 4) replaces, and a motion; at rest by default."""
        mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[:] = pose
        if T_world_vehicle is not None:
            self._data.qpos[:3] = T_world_vehicle[:3, 3]
            self._data.qpos[3:] = quat_wxyz_from_matrix(T_world_vehicle[:3, :3])
        self._data.qvel[:3] = 0.0 if velocity_m_s is None else velocity_m_s
        self._data.qvel[3:] = 0.0 if rate_rad_s is None else rate_rad_s

    def motion(self) -> Array:
        """Return the motion (13,) of the physics: pose and twist."""
        return np.concatenate([self._data.qpos, self._data.qvel])

    def run(self, wrench: Array) -> Array:
        """Run the physics for an interval with a constant wrench (6,).

        Returns:
            The motion (13,) in the middle of the interval.
        """
        model, data = self._model, self._data
        clear = self._grid.clears(data.qpos[:3], data.qvel[:3])
        model.opt.disableflags = self._flags | (WITHOUT_CONTACTS if clear else 0)
        data.ctrl[:] = wrench
        half = self._substeps // 2
        mujoco.mj_step(model, data, half)
        before = self.motion()
        mujoco.mj_step(model, data, 1)
        middle = middle_of_interval(before, self.motion(), self._substeps)
        mujoco.mj_step(model, data, self._substeps - half - 1)
        return middle

    def touching(self) -> tuple[str, str] | None:
        """Return the names of the vehicle's part and of the object of a collision, or None without one."""
        return self._collision_detector.detect(self._data)


class MotionRecord:
    """Motion of the physics at the IMU time stamps from t = 0 on, and between them."""

    def __init__(self, motion: Array, middle: Array, rotor_speeds_rad_s: Array) -> None:
        """Take the motion (13,) at t = 0 and half an interval later, and the rotor speeds (R,) in between [rad/s]."""
        self.t_ns = [0]
        self.rows = [motion]
        self._rotor_speeds = [rotor_speeds_rad_s]
        self._between = [extrapolated_back(motion, middle), middle]  # from before t = 0 on

    def add(self, t_ns: int, motion: Array, middle: Array, rotor_speeds_rad_s: Array) -> None:
        """Add a time stamp [ns]."""
        self.t_ns.append(t_ns)
        self.rows.append(motion)
        self._between.append(middle)
        self._rotor_speeds.append(rotor_speeds_rad_s)

    def motion(self, first: int, step_s: float) -> Motion:
        """Return the motion from an index on, given the time step of the physics [s]."""
        rows = np.array(self.rows[first:]).reshape(-1, 13)
        between = np.array(self._between[first:])
        times = np.array(self.t_ns[first:], dtype=np.int64)
        speeds = np.array(self._rotor_speeds[first:]).reshape(-1, len(self._rotor_speeds[0]))
        return Motion(times, step_s, rows[:, :7], rows[:, 7:], between[:, :7], between[:, 7:], speeds)
