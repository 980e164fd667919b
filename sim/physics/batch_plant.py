"""Batch plant: the physics of many quadrotors of one type in one world, stepped together by `mujoco.batch`."""

import copy
from dataclasses import dataclass, fields

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch

from dronevio.models.errors import ConfigError
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.quadrotor import RESEARCH, Quadrotor
from dronevio.models.rig import Rig
from dronevio.models.rotation import matrix_from_quat_wxyz, quat_wxyz_from_matrix
from dronevio.sim.physics.batch_contacts import BatchContacts
from dronevio.sim.physics.plant import LONGEST_STEP_S, LOWEST_IMU_RATE_HZ
from dronevio.sim.physics.rotors import Airflow, Rotors, RotorState
from dronevio.sim.physics.vehicle import physics_spec, standing_pose
from dronevio.sim.physics.vehicle_states import Mask, Rows, VehicleParameters, VehicleStates
from dronevio.sim.physics.wind import CALM, AirState, BatchAir, Winds

Array = npt.NDArray[np.float64]

FASTEST = 1e4
"""Largest component of a velocity [m/s] or angular velocity [rad/s] that is not divergence."""
_ALL = slice(None)
_GRAVITY = np.array([0.0, 0.0, -GRAVITY_M_S2])
_RECORDED = int(mujoco.mjtState.mjSTATE_QPOS | mujoco.mjtState.mjSTATE_QVEL)


@dataclass(frozen=True, eq=False)
class PointSamples:
    """One noise-free point sample of the IMU of each of n vehicles."""

    gyro_rad_s: Array
    """(n, 3) Angular velocities in the IMU frame [rad/s]."""
    accel_m_s2: Array
    """(n, 3) Specific forces in the IMU frame [m/s²]."""


@dataclass(frozen=True, eq=False)
class PlantState:
    """Complete state of a `BatchPlant`."""

    physics: Array
    """(n, S) States of MuJoCo."""
    rotors: RotorState
    """States of rotors and batteries."""
    parameters: VehicleParameters
    """Physical parameters of the vehicles."""
    air: AirState
    """State of the air."""
    elapsed: npt.NDArray[np.int64]
    """(n,) IMU intervals since the resets."""
    touched: Mask
    """(n,) Which vehicles have collided."""
    diverged: Mask
    """(n,) Which simulations have diverged."""
    row: Array
    """(n, 13) Poses and twists at the clock."""
    velocity_between: Array
    """(n, 3) Velocities of the IMUs half an interval after the clock [m/s]."""
    samples: PointSamples
    """IMU samples of the clock."""


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
        self._row = np.zeros((count, 13))
        self._velocity_between = np.zeros((count, 3))
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
        position = self._row[:, :3] - 0.5 * self._step_s * self._row[:, 7:10]
        return VehicleStates(
            position,
            _rotations(self._row, self._step_s),
            self._row[:, 7:10].copy(),
            self._row[:, 10:].copy(),
            self._state.speed_rad_s.copy(),
            self._state.charge.copy(),
            self._state.voltage_v.copy(),
        )

    @property
    def samples(self) -> PointSamples:
        """Noise-free IMU samples at the current time, of t = 0 after a reset."""
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
                self._row,
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
        self._row, self._velocity_between, self._samples = saved.row, saved.velocity_between, saved.samples

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
        _check_states(states.rows(rows))
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
        steady = self._rotors_of(rows).steady_state(states.rotor_speed_rad_s[rows], states.battery_charge[rows])
        self._state = _with_rows(self._state, rows, steady)
        for flags in (self._touched, self._diverged):
            flags[rows] = False
        self._elapsed[rows] = 0
        self._row[rows] = self._physics_row(rows)
        middle = self._step_interval(rows)
        before = 2.0 * self._row[rows] - middle  # extrapolated to before t = 0
        self._velocity_between[rows] = self._imu_velocity(before)
        gyro, accel = self._sample(rows, middle)
        self._samples.gyro_rad_s[rows], self._samples.accel_m_s2[rows] = gyro, accel

    def advance(self, commands: Array) -> PointSamples:
        """Apply commands (n, 4) of rotor speeds [rad/s] for one IMU interval, and return the IMU samples at its end."""
        finite = np.asarray(np.isfinite(commands).all(axis=1))
        if not finite.all():
            self._diverged |= ~finite
            commands = np.where(finite[:, None], commands, 0.0)
        self._elapsed += 1
        self._row = self._physics_row(_ALL)
        self._state = self._rotors.step(self._state, commands, self.interval_s)
        self._samples = PointSamples(*self._sample(_ALL, self._step_interval(_ALL)))
        return self._samples

    def _rotors_of(self, rows: Rows) -> Rotors:
        """Return the rotors of the selected vehicles."""
        return self._rotors if isinstance(rows, slice) else Rotors(self.quadrotor, self._parameters.rows(rows))

    def _physics_row(self, rows: Rows) -> Array:
        """Return poses and twists (k, 13) of the physics."""
        return np.concatenate([self._pose[rows], self._twist[rows]], axis=1)

    def _step_interval(self, rows: Rows) -> Array:
        """Step the physics by an interval and return the rows (k, 13) of its middle."""
        ids = None if isinstance(rows, slice) else rows
        state = self._state if ids is None else self._state.rows(rows)
        self._control[rows] = self._rotors_of(rows).wrench(state, self._airflow(rows))
        recorded = self._batch.rollout(self._substeps, record=[_RECORDED], ids=ids)[_RECORDED]
        half = self._substeps // 2
        middle = np.array(recorded[:, half - 1])
        if self._substeps % 2:  # the middle is between two steps
            middle = 0.5 * (middle + recorded[:, half])
        self._detect_contacts(rows, recorded[:, -2, :7])
        return self._contain_divergence(rows, recorded[:, -1], middle)

    def _airflow(self, rows: Rows) -> Airflow:
        """Return the airflow at the selected vehicles, and advance the gusts by the distance of an interval."""
        pose, twist = self._pose[rows], self._twist[rows]
        R = matrix_from_quat_wxyz(pose[:, 3:])
        through_air = twist[:, :3] - self._air.velocity_m_s(rows)
        self._air.move_through(np.sqrt(np.sum(through_air * through_air, axis=1)) * self.interval_s, rows)
        return Airflow(_rotated_back(R, through_air), twist[:, 3:], R[:, 2], pose[:, 2] - self._ground_m)

    def _detect_contacts(self, rows: Rows, pose: Array) -> None:
        """Record collisions of the selected vehicles, given the poses (k, 7) before the last step."""
        indices = np.arange(self.count)[rows]
        candidates = np.flatnonzero((self._contacts[rows] > 0) & ~self._touched[rows] & np.isfinite(pose).all(axis=1))
        if candidates.size:
            self._touched[indices[candidates]] = self._detector.detect(indices[candidates], pose[candidates])

    def _contain_divergence(self, rows: Rows, end: Array, middle: Array) -> Array:
        """Mark and stop diverging vehicles, given rows (k, 13) of the end and the middle; return the middle."""
        valid = (np.abs(end) < FASTEST).all(axis=1) & ~self._batch.warning[rows, :, 1].any(axis=1)
        stopped = ~valid | self._diverged[rows]
        if not stopped.any():
            return middle
        indices = np.arange(self.count)[rows][stopped]
        self._diverged[indices] = True
        self._row[indices, 7:] = 0.0
        self._batch.reset(indices, stage=mujoco.mjtStage.mjSTAGE_NONE)
        self._pose[indices] = self._row[indices, :7]
        self._twist[indices] = 0.0
        middle[stopped] = self._row[indices]
        return middle

    def _sample(self, rows: Rows, middle: Array) -> tuple[Array, Array]:
        """Return gyroscope and accelerometer samples (k, 3), given the rows (k, 13) in the middle of the interval."""
        T = self.rig.T_vehicle_imu
        after = self._imu_velocity(middle)
        R_imu = _rotations(self._row[rows], self._step_s) @ T[:3, :3]
        force = _rotated_back(R_imu, (after - self._velocity_between[rows]) / self.interval_s - _GRAVITY)
        self._velocity_between[rows] = after
        return self._row[rows, 10:] @ T[:3, :3], force

    def _imu_velocity(self, row: Array) -> Array:
        """Return velocities (k, 3) of the IMU in the world frame [m/s], given poses and twists (k, 13)."""
        lever = np.cross(row[:, 10:], self.rig.T_vehicle_imu[:3, 3])
        return np.asarray(row[:, 7:10] + (_rotations(row, self._step_s) @ lever[..., None])[..., 0])


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


def _check_states(states: VehicleStates) -> None:
    """Raise an error for states that the physics cannot start from.

    Raises:
        ConfigError: A value is not finite, or a velocity is above `FASTEST`.
    """
    for field in fields(states):
        if not np.isfinite(getattr(states, field.name)).all():
            raise ConfigError(f"initial {field.name} is not finite; expected finite numbers")
    if max(np.abs(states.velocity_m_s).max(), np.abs(states.rate_rad_s).max()) >= FASTEST:
        raise ConfigError(f"initial velocity or angular velocity of {FASTEST:g} or more; expected less")


def _with_rows(state: RotorState, rows: npt.NDArray[np.intp], other: RotorState) -> RotorState:
    """Return a rotor state in which k rows are those of another one."""
    speed, acceleration = state.speed_rad_s.copy(), state.acceleration_rad_s2.copy()
    charge, voltage = state.charge.copy(), state.voltage_v.copy()
    speed[rows], acceleration[rows] = other.speed_rad_s, other.acceleration_rad_s2
    charge[rows], voltage[rows] = other.charge, other.voltage_v
    return RotorState(speed, acceleration, charge, voltage)


def _rotations(row: Array, step_s: float) -> Array:
    """Return orientations (n, 3, 3) at the times of the velocities, half a step earlier than the poses (see `Motion`).

    Args:
        row: (n, 13) Poses and twists of the physics.
        step_s: Time step of the physics [s].
    """
    half = -0.25 * step_s * row[:, 10:]  # half the rotation vector
    angle = np.sqrt(np.sum(half * half, axis=1))
    cosine, sine = np.cos(angle), np.sinc(angle / np.pi)
    w, x, y, z = row[:, 3:7].T
    a, b, c = (sine[:, None] * half).T
    turned = np.stack(
        [
            w * cosine - x * a - y * b - z * c,
            w * a + x * cosine + y * c - z * b,
            w * b - x * c + y * cosine + z * a,
            w * c + x * b - y * a + z * cosine,
        ],
        axis=1,
    )
    return matrix_from_quat_wxyz(turned)


def _rotated_back(R: Array, v: Array) -> Array:
    """Return Rᵀ v (n, 3)."""
    return np.asarray(np.einsum("nji,nj->ni", R, v))
