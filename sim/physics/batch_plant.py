"""Batch plant: the physics of many quadrotors of one type in one world, stepped together by `mujoco.batch`."""

import copy

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch

from dronevio.models.errors import ConfigError
from dronevio.models.quadrotor import RESEARCH, Quadrotor
from dronevio.models.rig import Rig
from dronevio.models.rotation import quat_wxyz_from_matrix
from dronevio.sim.physics.batch_contacts import BatchContacts
from dronevio.sim.physics.batch_motion import (
    POSITION,
    QUATERNION,
    RATE,
    VELOCITY,
    rotated_back,
    rotations,
    rotations_at_velocities,
    specific_forces,
    velocities_of,
)
from dronevio.sim.physics.batch_state import PlantState, PointSamples
from dronevio.sim.physics.plant import LONGEST_STEP_S, LOWEST_IMU_RATE_HZ
from dronevio.sim.physics.rotors import Airflow, Rotors
from dronevio.sim.physics.vehicle import physics_spec, standing_pose
from dronevio.sim.physics.vehicle_states import Mask, Rows, VehicleParameters, VehicleStates
from dronevio.sim.physics.wind import CALM, BatchAir, Winds

Array = npt.NDArray[np.float64]

FASTEST = 1e4
"""Largest component of a velocity [m/s] or angular velocity [rad/s] that is not divergence."""
_ALL = slice(None)
_NONE = np.zeros(0, dtype=np.intp)
_RECORDED = int(mujoco.mjtState.mjSTATE_QPOS | mujoco.mjtState.mjSTATE_QVEL)


class BatchPlant:
    """n quadrotors with rotor speed commands and noise-free IMUs.

    Clock, wrench, latency and IMU samples are those of `QuadrotorPlant`: time advances in IMU intervals, the wrench of
    the rotors is constant over the steps of an interval, and the physics are one interval ahead of the clock. Results
    do not depend on the number of threads.

    A vehicle whose state or command is not finite, or that is faster than any quadrotor, is marked as diverged. It
    keeps its last finite pose, with zero velocities, until it is reset.
    """

    def __init__(
        self,
        count: int,
        rig: Rig,
        quadrotor: Quadrotor | None = None,
        *,
        step_s: float = LONGEST_STEP_S,
        surroundings: mujoco.MjSpec | None = None,
        ground_m: float = 0.0,
        imu: bool = True,
        rng: np.random.Generator | None = None,
        nthread: int = 0,
    ) -> None:
        """Compile the physics model, and place all vehicles at rest at the origin.

        Args:
            count: Number of vehicles.
            rig: Mounting and rate of the IMU.
            quadrotor: The vehicle type; the research quadrotor of 1.5 kg by default.
            step_s: Time step of the physics [s]; at most half the IMU interval, of which it is a fraction.
            surroundings: Specification of a world, whose static geoms of group 3 are obstacles; only a floor by
                default.
            ground_m: Height of the ground of the ground effect [m].
            imu: Whether IMU samples are computed.
            rng: Generator of the gusts; a fixed seed by default.
            nthread: Number of threads; 0 means one for each processor.

        Raises:
            ConfigError: There is no vehicle, the IMU rate is too low, or the time step does not divide the IMU
                interval into two or more steps.
        """
        if count < 1:
            raise ConfigError(f"{count} vehicles; expected 1 or more")
        if rig.imu.rate_hz < LOWEST_IMU_RATE_HZ:
            raise ConfigError(f"IMU rate of {rig.imu.rate_hz:g} Hz; expected at least {LOWEST_IMU_RATE_HZ:g} Hz")
        self.count = count
        self.rig = rig
        self.quadrotor = quadrotor or RESEARCH
        self.interval_ns = round(1e9 / rig.imu.rate_hz)
        self.interval_s = self.interval_ns * 1e-9
        self._substeps = _substeps(self.interval_s, step_s)
        self._step_s = self.interval_s / self._substeps
        self._ground_m = ground_m
        self._imu = imu
        spec = physics_spec(self.quadrotor, rig, self._step_s, surroundings)
        model = spec.compile()
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self._body = model.body("quadrotor").id
        self._batch = Batch(model, count, nthread)
        self._pose, self._twist = self._batch.bind("qpos"), self._batch.bind("qvel")
        self._control, self._contacts = self._batch.bind("ctrl"), self._batch.bind("ncon")
        self._masses, self._inertias = self._batch.expand("body_mass"), self._batch.expand("body_inertia")
        self._batch.set_const()
        self._detector = BatchContacts(spec, count, nthread)
        self._standing_m = float(standing_pose(self.quadrotor, rig, self._step_s)[2])
        self._parameters = VehicleParameters.of(self.quadrotor, count)
        self._rotors = Rotors(self.quadrotor, self._parameters)
        self._state = self._rotors.steady_state(np.zeros((count, 4)))
        self._air = BatchAir(Winds.of(CALM, count), rng or np.random.default_rng(0))
        self._elapsed = np.zeros(count, dtype=np.int64)
        self._touched, self._diverged = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
        self._motion = np.zeros((13, count))
        self._velocity_between = np.zeros((3, count))
        self._record = np.zeros((count, self._substeps, 13))
        self._samples = PointSamples(np.zeros((count, 3)), np.zeros((count, 3)))
        self.reset(np.ones(count, dtype=bool), VehicleStates.at(np.tile([0.0, 0.0, self._standing_m], (count, 1))))

    @property
    def standing_height_m(self) -> float:
        """Height of the centre of mass above the floor when a drone of the type stands on its feet [m]."""
        return self._standing_m

    @property
    def t_ns(self) -> npt.NDArray[np.int64]:
        """(n,) Times since the last reset of each vehicle [ns]."""
        return self._elapsed * self.interval_ns

    @property
    def states(self) -> VehicleStates:
        """True states of the vehicles."""
        position = self._motion[POSITION] - 0.5 * self._step_s * self._motion[VELOCITY]
        R = rotations_at_velocities(self._motion, self._step_s)
        return VehicleStates(
            np.ascontiguousarray(position.T),
            np.ascontiguousarray(R.transpose(2, 0, 1)),
            np.ascontiguousarray(self._motion[VELOCITY].T),
            np.ascontiguousarray(self._motion[RATE].T),
            self._state.speed_rad_s.copy(),
            self._state.charge.copy(),
            self._state.voltage_v.copy(),
        )

    @property
    def rotor_speeds_rad_s(self) -> Array:
        """(n, 4) Speeds of the rotors from the current time on [rad/s]."""
        return self._state.speed_rad_s.copy()

    @property
    def samples(self) -> PointSamples:
        """Noise-free IMU samples at the current time, of t = 0 after a reset; zeros in a plant without IMUs."""
        return self._samples

    @property
    def touched(self) -> Mask:
        """(n,) Whether a vehicle has collided since its reset: any contact but that of a foot with the ground."""
        return self._touched.copy()

    @property
    def diverged(self) -> Mask:
        """(n,) Whether the simulation of a vehicle has diverged since its reset."""
        return self._diverged.copy()

    @property
    def parameters(self) -> VehicleParameters:
        """Physical parameters of the vehicles."""
        return self._parameters

    @property
    def winds(self) -> Winds:
        """Mean winds and strengths of gusts at the vehicles."""
        return self._air.winds

    @property
    def wind_m_s(self) -> Array:
        """(n, 3) Current velocities of the air at the vehicles in the world frame [m/s]."""
        return self._air.velocity_m_s().copy()

    def reseed(self, rng: np.random.Generator) -> None:
        """Draw gusts from streams of another generator from now on."""
        self._air.reseed(rng)

    def save(self) -> PlantState:
        """Return the state of vehicles, gusts and clocks, with arrays of its own."""
        return copy.deepcopy(
            PlantState(
                self._batch.state,
                self._state,
                self._parameters,
                self._air.save(),
                self._elapsed,
                self._touched,
                self._diverged,
                self._motion,
                self._velocity_between,
                self._samples,
            )
        )

    def restore(self, saved: PlantState) -> None:
        """Return to a state of a plant of the same vehicle type, world and rates, with as many vehicles."""
        saved = copy.deepcopy(saved)
        self._parameters, self._state = saved.parameters, saved.rotors
        self._rotors = Rotors(self.quadrotor, self._parameters)
        self._masses[:, self._body] = self._parameters.mass_kg
        self._inertias[:, self._body] = self._parameters.inertia_kg_m2
        self._batch.set_const()
        self._batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
        self._batch.state[:] = saved.physics
        self._air.restore(saved.air)
        self._elapsed, self._touched, self._diverged = saved.elapsed, saved.touched, saved.diverged
        self._motion, self._velocity_between, self._samples = saved.motion, saved.velocity_between, saved.samples

    def reset(
        self,
        mask: Mask,
        states: VehicleStates,
        parameters: VehicleParameters | None = None,
        winds: Winds | None = None,
    ) -> None:
        """Reset clock, gusts and states of the vehicles in a mask; other vehicles are not changed.

        Args:
            mask: (n,) The vehicles to reset.
            states: States of n vehicles, of which only the rows of the mask are used.
            parameters: New parameters of n vehicles, of which only the rows of the mask are used; unchanged by default.
            winds: New winds at n vehicles, of which only the rows of the mask are used; unchanged by default.

        Raises:
            ConfigError: A state is not finite, or faster than `FASTEST`.
        """
        rows = np.flatnonzero(mask)
        if rows.size == 0:
            return
        states.rows(rows).check(FASTEST)
        if parameters is not None:
            self._parameters = self._parameters.replaced(mask, parameters)
            self._rotors = Rotors(self.quadrotor, self._parameters)
            self._masses[rows, self._body] = parameters.mass_kg[rows]
            self._inertias[rows, self._body] = parameters.inertia_kg_m2[rows]
            self._batch.set_const(rows)
        self._air.renew(rows, self.winds if winds is None else self.winds.replaced(mask, winds))
        self._batch.reset(rows, stage=mujoco.mjtStage.mjSTAGE_NONE)
        self._pose[rows, :3] = states.position_m[rows]
        self._pose[rows, 3:] = quat_wxyz_from_matrix(states.R_world_vehicle[rows])
        self._twist[rows, :3] = states.velocity_m_s[rows]
        self._twist[rows, 3:] = states.rate_rad_s[rows]
        rotors = Rotors(self.quadrotor, self._parameters.rows(rows))
        steady = rotors.steady_state(states.rotor_speed_rad_s[rows], states.battery_charge[rows])
        self._state = self._state.with_rows(rows, steady)
        for flags in (self._touched, self._diverged):
            flags[rows] = False
        self._elapsed[rows] = 0
        self._motion[:, rows] = self._physics_motion(rows)
        middle = self._step_interval(rows, rotors)
        if self._imu:
            before = 2.0 * self._motion[:, rows] - middle  # extrapolated to before t = 0
            self._velocity_between[:, rows] = velocities_of(self.rig.T_vehicle_imu[:3, 3], before, self._step_s)
            sampled = self._sample(rows, middle)
            gyro, accel = self._samples.gyro_rad_s.copy(), self._samples.accel_m_s2.copy()
            gyro[rows], accel[rows] = sampled.gyro_rad_s, sampled.accel_m_s2
            self._samples = PointSamples(gyro, accel)

    def advance(self, commands: Array) -> PointSamples:
        """Apply commands (n, 4) of rotor speeds [rad/s] for one IMU interval, and return the IMU samples at its end."""
        finite = np.isfinite(commands)
        if not finite.all():
            rows = np.asarray(finite.all(axis=1))
            self._diverged |= ~rows
            commands = np.where(rows[:, None], commands, 0.0)
        self._elapsed += 1
        self._motion = self._physics_motion(_ALL)
        self._state = self._rotors.step(self._state, commands, self.interval_s)
        middle = self._step_interval(_ALL, self._rotors)
        if self._imu:
            self._samples = self._sample(_ALL, middle)
        return self._samples

    def _physics_motion(self, rows: Rows) -> Array:
        """Return the motion (13, k) of the physics."""
        return np.concatenate([self._pose[rows].T, self._twist[rows].T])

    def _step_interval(self, rows: Rows, rotors: Rotors) -> Array:
        """Step the physics of k vehicles with their rotors by an interval.

        Returns:
            The motion (13, k) in the middle of the interval; that at its start in a plant without IMUs.
        """
        ids = None if isinstance(rows, slice) else rows
        state = self._state if ids is None else self._state.rows(rows)
        self._control[rows] = rotors.wrench(state, self._airflow(rows))
        middle = self._run(ids) if self._imu else self._run_unrecorded(rows)
        self._detect_contacts(rows)
        stopped = self._stop_diverged(rows)
        middle[:, stopped] = self._motion[:, rows][:, stopped]
        return middle

    def _run(self, ids: npt.NDArray[np.intp] | None) -> Array:
        """Run the physics for an interval and return the motion (13, k) in its middle."""
        record = self._record if ids is None else np.empty((len(ids), *self._record.shape[1:]))
        self._batch.rollout(self._substeps, record=[_RECORDED], ids=ids, out={_RECORDED: record})
        half = self._substeps // 2
        middle = np.array(record[:, half - 1].T, order="C")
        if self._substeps % 2:  # the middle is between two steps
            middle = 0.5 * (middle + record[:, half].T)
        return middle

    def _run_unrecorded(self, rows: Rows) -> Array:
        """Run the physics for an interval and return the motion (13, k) at its start."""
        self._batch.step(None if isinstance(rows, slice) else rows, self._substeps)
        return self._motion[:, rows]

    def _airflow(self, rows: Rows) -> Airflow:
        """Return the airflow at the selected vehicles, and advance the gusts by the distance of an interval."""
        motion = self._motion[:, rows]
        R = rotations(motion[QUATERNION])
        through_air = motion[VELOCITY] - self._air.velocity_m_s(rows).T
        self._air.move_through(np.sqrt((through_air * through_air).sum(axis=0)) * self.interval_s, rows)
        return Airflow(rotated_back(R, through_air).T, motion[RATE].T, R[2].T, motion[2] - self._ground_m)

    def _detect_contacts(self, rows: Rows) -> None:
        """Record collisions of the selected vehicles."""
        candidates = np.flatnonzero((self._contacts[rows] > 0) & ~self._touched[rows])
        if candidates.size:
            indices = np.arange(self.count)[rows][candidates]
            indices = indices[np.isfinite(self._pose[indices]).all(axis=1)]
            self._touched[indices] = self._detector.detect(indices, self._pose[indices])

    def _stop_diverged(self, rows: Rows) -> npt.NDArray[np.intp]:
        """Mark and stop diverging vehicles, and return which of the selected ones are stopped."""
        pose, twist, warning = self._pose[rows], self._twist[rows], self._batch.warning[rows, :, 1]
        diverged = self._diverged[rows]
        slow = np.abs(pose).max() < FASTEST and np.abs(twist).max() < FASTEST  # false for NaN
        if slow and not warning.any() and not diverged.any():
            return _NONE
        valid = (np.abs(pose) < FASTEST).all(axis=1) & (np.abs(twist) < FASTEST).all(axis=1)
        stopped = np.flatnonzero(~valid | warning.any(axis=1) | diverged)
        indices = np.arange(self.count)[rows][stopped]
        self._diverged[indices] = True
        self._motion[VELOCITY, indices] = 0.0
        self._motion[RATE, indices] = 0.0
        self._batch.reset(indices, stage=mujoco.mjtStage.mjSTAGE_NONE)
        self._pose[indices] = self._motion[:7, indices].T
        self._twist[indices] = 0.0
        return stopped

    def _sample(self, rows: Rows, middle: Array) -> PointSamples:
        """Return the samples of k IMUs, given the motion (13, k) in the middle of the next interval."""
        T, motion = self.rig.T_vehicle_imu, self._motion[:, rows]
        before, after = self._velocity_between[:, rows], velocities_of(T[:3, 3], middle, self._step_s)
        R = rotations_at_velocities(motion, self._step_s)
        force = specific_forces(R, before, after, self.interval_s)  # in the vehicle frame
        self._velocity_between[:, rows] = after
        return PointSamples(motion[RATE].T @ T[:3, :3], force.T @ T[:3, :3])


def _substeps(interval_s: float, step_s: float) -> int:
    """Return the number of time steps in an IMU interval.

    Raises:
        ConfigError: The time step does not divide the interval into two or more steps.
    """
    count = round(interval_s / step_s) if step_s > 0.0 else 0
    if count < 2 or abs(count * step_s - interval_s) > 1e-6 * interval_s:
        raise ConfigError(
            f"time step of {step_s:g} s; expected a half, third, … of the IMU interval of {interval_s:g} s"
        )
    return count
