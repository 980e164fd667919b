"""Plant: MuJoCo's physics of a quadrotor in a world, on a clock of integer nanoseconds."""

from math import sqrt

import mujoco
import numpy as np
import numpy.typing as npt

from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples
from dronevio.models.quadrotor import RESEARCH, Quadrotor
from dronevio.models.rig import Rig
from dronevio.models.rotation import cross, quat_wxyz_from_matrix
from dronevio.models.state import NavState
from dronevio.sim.physics.collisions import Collision, CollisionDetector
from dronevio.sim.physics.motion import Motion
from dronevio.sim.physics.rotors import ALL_POWERED, Airflow, MotorFailure, Rotors
from dronevio.sim.physics.vehicle import physics_model, standing_pose
from dronevio.sim.physics.wind import CALM, Wind, make_air

Array = npt.NDArray[np.float64]

LONGEST_STEP_S = 1e-3
"""Longest time step of the physics [s]; the step divides the IMU interval."""
LOWEST_IMU_RATE_HZ = 100.0
"""Lowest supported IMU rate [Hz], since rotor forces are constant between IMU samples."""
_VEHICLE = np.eye(4)


class QuadrotorPlant:
    """Quadrotor with rotor speed commands and a noise-free IMU; implements `Plant`.

    Time advances in IMU intervals. The wrench of the rotors, computed from their speeds and the motion of the body at
    the start of an interval, is constant over its physics steps; a command therefore acts from the next interval on,
    similar to the latency of a real motor controller. The plant starts at t = 0 at rest on its pad, heading along x.
    """

    def __init__(
        self,
        rig: Rig,
        quadrotor: Quadrotor | None = None,
        *,
        surroundings: mujoco.MjSpec | None = None,
        pad_m: Array | None = None,
        wind: Wind = CALM,
        failure: MotorFailure | None = None,
        rng: np.random.Generator | None = None,
    ) -> None:
        """Compile the physics model.

        Args:
            rig: Mounting and rate of the IMU.
            quadrotor: The vehicle; the research quadrotor of 1.5 kg by default.
            surroundings: Specification of a world, whose static geoms of group 3 are obstacles; only a floor by
                default.
            pad_m: (3,) Initial position on the floor [m]; the origin by default.
            wind: Mean wind and gusts.
            failure: Failure of a rotor; none by default.
            rng: Generator of the gusts.

        Raises:
            ConfigError: The IMU rate is too low, or there are gusts without an ``rng``.
        """
        if rig.imu.rate_hz < LOWEST_IMU_RATE_HZ:
            raise ConfigError(f"IMU rate of {rig.imu.rate_hz:g} Hz; expected at least {LOWEST_IMU_RATE_HZ:g} Hz")
        self.rig = rig
        self.quadrotor = quadrotor or RESEARCH
        self.interval_ns = round(1e9 / rig.imu.rate_hz)
        self.interval_s = self.interval_ns * 1e-9
        self._substeps = max(2, int(np.ceil(self.interval_s / LONGEST_STEP_S - 1e-9)))
        self._step_s = self.interval_s / self._substeps
        self._rotors = Rotors(self.quadrotor)
        self._air = make_air(wind, rng)
        self._failure = failure or MotorFailure(0, np.inf)
        self._model = physics_model(self.quadrotor, rig, self._step_s, surroundings)
        self._data = mujoco.MjData(self._model)
        self._collision_detector = CollisionDetector(self._model)
        self._pad = np.zeros(3) if pad_m is None else np.asarray(pad_m, dtype=np.float64)
        self._standing = standing_pose(self.quadrotor, rig, self._step_s)
        self._standing[:3] += self._pad
        self.reset()

    @property
    def t_ns(self) -> int:
        """Current time of the plant [ns]."""
        return self._t_ns

    @property
    def rotor_speeds_rad_s(self) -> Array:
        """(4,) Speeds of the rotors [rad/s]."""
        return self._state.speed_rad_s.copy()

    @property
    def battery_charge(self) -> float:
        """State of charge of the battery, from 1 (full) to 0 (empty)."""
        return float(self._state.charge)

    @property
    def battery_v(self) -> float:
        """Voltage of the battery under load [V]."""
        return float(self._state.voltage_v)

    @property
    def power_w(self) -> float:
        """Electrical power drawn from the battery [W]."""
        return float(self._rotors.power_w(self._state))

    @property
    def wind_m_s(self) -> Array:
        """(3,) Velocity of the air at the drone in the world frame [m/s]."""
        return self._air.velocity_m_s().copy()

    @property
    def collision(self) -> Collision | None:
        """First collision since the reset; None so far."""
        return self._collision

    @property
    def standing_height_m(self) -> float:
        """Height of the centre of mass above the floor when the drone stands on its feet [m]."""
        return float(self._standing[2] - self._pad[2])

    def reset(
        self,
        T_world_vehicle: Array | None = None,
        velocity_m_s: Array | None = None,
        rate_rad_s: Array | None = None,
        rotor_speeds_rad_s: Array | None = None,
    ) -> None:
        """Reset clock, battery, gusts and vehicle state.

        Args:
            T_world_vehicle: (4, 4) Pose; standing on the floor by default.
            velocity_m_s: (3,) Velocity of the centre of mass in the world [m/s]; 0 by default.
            rate_rad_s: (3,) Angular velocity in the vehicle frame [rad/s]; 0 by default.
            rotor_speeds_rad_s: (4,) Rotor speeds [rad/s]; 0 by default.
        """
        mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[:] = self._standing
        if T_world_vehicle is not None:
            self._data.qpos[:3] = T_world_vehicle[:3, 3]
            self._data.qpos[3:] = quat_wxyz_from_matrix(T_world_vehicle[:3, :3])
        self._data.qvel[:3] = 0.0 if velocity_m_s is None else velocity_m_s
        self._data.qvel[3:] = 0.0 if rate_rad_s is None else rate_rad_s
        self._state = self._rotors.steady_state(np.zeros(4) if rotor_speeds_rad_s is None else rotor_speeds_rad_s)
        self._air.reset()
        self._collision: Collision | None = None
        self._t_ns = 0
        self._sensed = 0
        self._times = [0]
        self._rows = [self._row()]
        self._rotor_speeds = [self._state.speed_rad_s]
        between = self._step_interval()
        self._between = [2.0 * self._rows[0] - between, between]  # extrapolated to before t = 0

    def advance(self, t_ns: int, command: Array) -> None:
        """Apply a command (4,) of rotor speeds [rad/s] up to the last IMU time stamp not after ``t_ns``."""
        command = np.asarray(command, dtype=np.float64)
        while self._t_ns + self.interval_ns <= t_ns:
            self._t_ns += self.interval_ns
            self._times.append(self._t_ns)
            self._rows.append(self._row())
            self._state = self._rotors.step(self._state, command, self.interval_s, self._powered())
            self._rotor_speeds.append(self._state.speed_rad_s)
            self._between.append(self._step_interval())

    def step_until(self, t_ns: int, command: Array) -> ImuSamples:
        """Apply a command (4,) of rotor speeds [rad/s] until ``t_ns`` and return the new noise-free IMU samples.

        The first call includes the sample of t = 0. The last sample is that of the last IMU time stamp not after
        ``t_ns``.
        """
        self.advance(t_ns, command)
        samples = self.motion(self._sensed).points(self.rig.T_vehicle_imu, self.interval_s)
        self._sensed = len(self._times)
        return samples

    def motion(self, first: int = 0) -> Motion:
        """Return the true motion since the reset at the IMU time stamps, from index ``first`` on."""
        rows = np.array(self._rows[first:]).reshape(-1, 13)
        between = np.array(self._between[first:])
        times = np.array(self._times[first:], dtype=np.int64)
        speeds = np.array(self._rotor_speeds[first:]).reshape(-1, 4)
        return Motion(times, self._step_s, rows[:, :7], rows[:, 7:], between[:, :7], between[:, 7:], speeds)

    def state(self) -> NavState:
        """Return the current true state of the IMU, with zero biases."""
        return self._state_of(self.rig.T_vehicle_imu)

    def vehicle_state(self) -> NavState:
        """Return the current true state of the vehicle frame at the centre of mass."""
        return self._state_of(_VEHICLE)

    def _state_of(self, T_vehicle_sensor: Array) -> NavState:
        """Return the true state of a frame fixed to the vehicle: the last row of `Motion.trajectory`, but faster."""
        row = self._rows[-1]
        position, quat, velocity, rate = row[:3], row[3:7].copy(), row[7:10], row[10:]
        mujoco.mju_quatIntegrate(quat, rate, -0.5 * self._step_s)
        R = _matrix(quat)
        lever = R @ T_vehicle_sensor[:3, 3]
        T = np.eye(4)
        T[:3, :3] = R @ T_vehicle_sensor[:3, :3]
        T[:3, 3] = position - 0.5 * self._step_s * velocity + lever
        return NavState(
            t_ns=self._t_ns,
            T_world_imu=T,
            velocity_m_s=velocity + R @ cross(rate, T_vehicle_sensor[:3, 3]),
            gyro_bias_rad_s=np.zeros(3),
            accel_bias_m_s2=np.zeros(3),
            angular_velocity_rad_s=rate @ T_vehicle_sensor[:3, :3],
        )

    def _row(self) -> Array:
        """Return pose and twist (13,) of the physics."""
        return np.concatenate([self._data.qpos, self._data.qvel])

    def _powered(self) -> npt.NDArray[np.bool_]:
        """Return which rotors (4,) have power during the interval that ends now."""
        if self._t_ns * 1e-9 <= self._failure.t_s:
            return ALL_POWERED
        return np.asarray(np.arange(4) != self._failure.rotor)

    def _step_interval(self) -> Array:
        """Step the physics to the next IMU time stamp and return the row (13,) of the middle of the interval.

        The physics are one interval ahead of the clock, since the wrench does not depend on the current command.
        """
        model, data = self._model, self._data
        data.ctrl[:] = self._rotors.wrench(self._state, self._airflow())
        half = self._substeps // 2
        mujoco.mj_step(model, data, half)
        row = self._row()
        if self._substeps % 2:  # the middle is between two steps
            mujoco.mj_step(model, data, 1)
            row = 0.5 * (row + self._row())
        mujoco.mj_step(model, data, half)
        self._record_collision()
        return row

    def _airflow(self) -> Airflow:
        """Return the airflow at the drone, and advance the gusts by the distance of an interval."""
        data = self._data
        R = _matrix(data.qpos[3:])
        through_air = data.qvel[:3] - self._air.velocity_m_s()
        self._air.move_through(np.asarray(sqrt(through_air @ through_air) * self.interval_s))
        return Airflow(through_air @ R, data.qvel[3:], R[2], data.qpos[2] - self._pad[2])

    def _record_collision(self) -> None:
        """Store the first collision; the physics are at the end of the interval that starts at the clock."""
        touched = self._collision_detector.detect(self._data)
        if touched is not None and self._collision is None:
            speed = float(np.linalg.norm(self._rows[-1][7:10]))
            self._collision = Collision(self._t_ns + self.interval_ns, *touched, speed)


def _matrix(quat_wxyz: Array) -> Array:
    """Return the rotation (3, 3) of one unit quaternion, ten times as fast as the vectorized function."""
    R = np.empty(9)
    mujoco.mju_quat2Mat(R, quat_wxyz)
    return R.reshape(3, 3)
