"""Plant: MuJoCo's physics of a multirotor in a world, on a clock of integer nanoseconds."""

from collections.abc import Sequence
from math import sqrt

import mujoco
import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples
from dronevio.models.quadrotor import RESEARCH, Quadrotor
from dronevio.models.rig import Rig
from dronevio.models.rotation import cross
from dronevio.models.state import NavState
from dronevio.sim.physics.collisions import Collision, Moving
from dronevio.sim.physics.motion import Motion
from dronevio.sim.physics.mover_contacts import MoverContacts
from dronevio.sim.physics.rotors import Airflow, MotorFailure, Rotors
from dronevio.sim.physics.simulation import MotionRecord, Simulation
from dronevio.sim.physics.vehicle import imu_interval_ns, meeting_spec, physics_model, physics_steps, standing_pose
from dronevio.sim.physics.wind import CALM, Air, Wind

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
        movers: Sequence[Moving] = (),
        pad_m: Array | None = None,
        wind: Wind = CALM,
        failure: MotorFailure | None = None,
        rng: np.random.Generator | None = None,
    ) -> None:
        """Compile the physics model.

        Args:
            rig: Mounting and rate of the IMU.
            quadrotor: The vehicle; the research quadrotor of 1.5 kg by default.
            surroundings: Specification of a world, whose geoms of group 3 are solid; only a floor by default.
            movers: All moving objects of the world; a drone that meets one has collided, but is not pushed.
            pad_m: (3,) Initial position on the floor [m]; the origin by default.
            wind: Mean wind and gusts.
            failure: Failure of a rotor; none by default.
            rng: Generator of the gusts.

        Raises:
            ConfigError: The IMU rate is too low, there is no such rotor to fail, or there are gusts without an ``rng``.
        """
        self.rig = rig
        self.quadrotor = quadrotor or RESEARCH
        self.interval_ns = imu_interval_ns(rig)
        self.interval_s = self.interval_ns * 1e-9
        substeps = physics_steps(self.interval_s)
        self._step_s = self.interval_s / substeps
        self._rotors = Rotors(self.quadrotor)
        self._air = Air(wind, rng)
        self._failure = failure or MotorFailure(0, np.inf)
        if self._failure.rotor >= self.quadrotor.rotor_count:
            raise ConfigError(
                f"failure of rotor {self._failure.rotor} of {self.quadrotor.rotor_count}; expected an index from 0 to"
                f" {self.quadrotor.rotor_count - 1}"
            )
        self._simulation = Simulation(physics_model(self.quadrotor, rig, self._step_s, surroundings), substeps)
        self._movers: MoverContacts | None = None
        if surroundings is not None and movers:
            meeting = meeting_spec(self.quadrotor, rig, surroundings).compile()
            self._movers = MoverContacts(meeting, movers, self.interval_s)
        self._pad = np.zeros(3) if pad_m is None else np.asarray(pad_m, dtype=np.float64)
        self._standing = standing_pose(self.quadrotor, rig, self._step_s)
        self._standing[:3] += self._pad
        self.reset()

    @property
    def t_ns(self) -> int:
        """Current time of the plant [ns]."""
        return self._record.t_ns[-1]

    @property
    def rotor_speeds_rad_s(self) -> Array:
        """(R,) Speeds of the rotors [rad/s]."""
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
            rotor_speeds_rad_s: (R,) Rotor speeds [rad/s]; 0 by default.
        """
        self._simulation.place(self._standing, T_world_vehicle, velocity_m_s, rate_rad_s)
        standstill = np.zeros(self.quadrotor.rotor_count)
        self._state = self._rotors.steady_state(standstill if rotor_speeds_rad_s is None else rotor_speeds_rad_s)
        self._air.reset()
        self._collision: Collision | None = None
        self._sensed = 0
        motion = self._simulation.motion()
        self._record = MotionRecord(motion, self._run_interval(0, motion), self._state.speed_rad_s)

    def advance(self, t_ns: int, command: Array) -> None:
        """Apply a command (R,) of rotor speeds [rad/s] up to the last IMU time stamp not after ``t_ns``."""
        command = np.asarray(command, dtype=np.float64)
        while (now_ns := self.t_ns + self.interval_ns) <= t_ns:
            motion = self._simulation.motion()
            self._state = self._rotors.step(self._state, command, self.interval_s, self._powered(now_ns))
            self._record.add(now_ns, motion, self._run_interval(now_ns, motion), self._state.speed_rad_s)

    def step_until(self, t_ns: int, command: Array) -> ImuSamples:
        """Apply a command (R,) of rotor speeds [rad/s] until ``t_ns`` and return the new noise-free IMU samples.

        The first call includes the sample of t = 0. The last sample is that of the last IMU time stamp not after
        ``t_ns``.
        """
        self.advance(t_ns, command)
        samples = self.motion(self._sensed).points(self.rig.T_vehicle_imu, self.interval_s)
        self._sensed = len(self._record.t_ns)
        return samples

    def motion(self, first: int = 0) -> Motion:
        """Return the true motion since the reset at the IMU time stamps, from index ``first`` on."""
        return self._record.motion(first, self._step_s)

    def state(self) -> NavState:
        """Return the current true state of the IMU, with zero biases."""
        return self._state_of(self.rig.T_vehicle_imu)

    def vehicle_state(self) -> NavState:
        """Return the current true state of the vehicle frame at the centre of mass."""
        return self._state_of(_VEHICLE)

    def _state_of(self, T_vehicle_sensor: Array) -> NavState:
        """Return the true state of a frame fixed to the vehicle: the last row of `Motion.trajectory`, but faster."""
        row = self._record.rows[-1]
        position, quat, velocity, rate = row[:3], row[3:7].copy(), row[7:10], row[10:]
        mujoco.mju_quatIntegrate(quat, rate, -0.5 * self._step_s)
        R = _matrix(quat)
        lever = R @ T_vehicle_sensor[:3, 3]
        T = np.eye(4)
        T[:3, :3] = R @ T_vehicle_sensor[:3, :3]
        T[:3, 3] = position - 0.5 * self._step_s * velocity + lever
        return NavState(
            t_ns=self.t_ns,
            T_world_imu=T,
            velocity_m_s=velocity + R @ cross(rate, T_vehicle_sensor[:3, 3]),
            gyro_bias_rad_s=np.zeros(3),
            accel_bias_m_s2=np.zeros(3),
            angular_velocity_rad_s=rate @ T_vehicle_sensor[:3, :3],
        )

    def _powered(self, t_ns: int) -> npt.NDArray[np.bool_] | None:
        """Return which rotors (R,) have power during the interval that ends at a time [ns]; None for all."""
        if t_ns * 1e-9 <= self._failure.t_s:
            return None
        return np.asarray(np.arange(self.quadrotor.rotor_count) != self._failure.rotor)

    def _run_interval(self, t_ns: int, motion: Array) -> Array:
        """Run the physics for the interval that starts at a time [ns] with a motion (13,).

        The physics are one interval ahead of the clock, since the wrench does not depend on the current command.

        Returns:
            The motion (13,) in the middle of the interval.
        """
        middle = self._simulation.run(self._rotors.wrench(self._state, self._airflow(motion)))
        end_ns = t_ns + self.interval_ns
        if self._collision is None and (touching := self._touching(end_ns)) is not None:
            self._collision = Collision(end_ns, *touching, float(np.linalg.norm(motion[7:10])))
        return middle

    def _touching(self, t_ns: int) -> tuple[str, str] | None:
        """Return the names of the drone's part and of the object of a collision at a time [ns], or None without one."""
        touching = self._simulation.touching()
        if touching is None and self._movers is not None:
            return self._movers.detect(t_ns // self.interval_ns, self._simulation.motion()[:7])
        return touching

    def _airflow(self, motion: Array) -> Airflow:
        """Return the airflow at the drone, and advance the gusts by the distance of an interval."""
        R = _matrix(motion[3:7])
        through_air = motion[7:10] - self._air.velocity_m_s()
        self._air.move_through(np.asarray(sqrt(through_air @ through_air) * self.interval_s))
        return Airflow(through_air @ R, motion[10:], R[2], motion[2] - self._pad[2])


def _matrix(quat_wxyz: Array) -> Array:
    """Return the rotation (3, 3) of one unit quaternion, ten times as fast as the vectorized function."""
    R = np.empty(9)
    mujoco.mju_quat2Mat(R, quat_wxyz)
    return R.reshape(3, 3)
