"""The plant: MuJoCo's physics of the quadrotor above a floor, on an integer-nanosecond clock."""

import mujoco
import numpy as np
import numpy.typing as npt

from dronevio.models.errors import ConfigError
from dronevio.models.imu import GRAVITY_M_S2, ImuSamples
from dronevio.models.quadrotor import QUADROTOR_MJCF, ROTOR_NAMES, Quadrotor
from dronevio.models.rig import Rig
from dronevio.models.rotation import matrix_from_quat_wxyz, quat_wxyz_from_matrix
from dronevio.models.state import NavState
from dronevio.sim.motion import Motion
from dronevio.sim.rotors import Rotors

Array = npt.NDArray[np.float64]

LONGEST_STEP_S = 1e-3
"""The physics steps at most this long [s]; the step divides the IMU's interval."""
LOWEST_IMU_RATE_HZ = 100.0
"""The rotors' forces are held from one IMU sample to the next: slower, and they would no longer be true."""
_SETTLING_S = 1.0  # until the feet's springs have come to rest


def quadrotor_spec(quadrotor: Quadrotor, rig: Rig) -> mujoco.MjSpec:
    """Return the vehicle's MjSpec with its constants and the IMU's site in place, ready to compile or to attach."""
    spec = mujoco.MjSpec.from_file(str(QUADROTOR_MJCF))
    body = spec.body("quadrotor")
    body.mass = quadrotor.mass_kg
    body.inertia = quadrotor.inertia_kg_m2
    for name, position in zip(ROTOR_NAMES, quadrotor.rotor_positions_m, strict=True):
        spec.site(name).pos = position
    T = rig.T_vehicle_imu
    body.add_site(name="imu", pos=T[:3, 3], quat=quat_wxyz_from_matrix(T[:3, :3]), size=[0.005] * 3, group=4)
    return spec


def _physics_model(quadrotor: Quadrotor, rig: Rig, step_s: float) -> mujoco.MjModel:
    """Return the vehicle above an endless floor at z = 0, without looks."""
    spec = quadrotor_spec(quadrotor, rig)
    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 1.0])
    spec.option.timestep = step_s
    spec.option.gravity = [0.0, 0.0, -GRAVITY_M_S2]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER  # the one whose IMU can be exact; see `Motion`
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC  # the feet stand without creeping
    return spec.compile()


class QuadrotorPlant:
    """A quadrotor that takes rotor speed commands and senses with a noise-free IMU; implements `Plant`.

    Time advances in IMU intervals. Within one, the rotors' wrench, computed from their speeds and the body's motion at
    its start, is held over the physics steps; the command therefore acts from the next interval on, which is the
    latency of a real motor controller. It starts at t = 0 standing at rest on the floor, at the origin, facing x.
    """

    def __init__(self, rig: Rig, quadrotor: Quadrotor | None = None) -> None:
        """Build the physics.

        Args:
            rig: Where the IMU sits, and its rate.
            quadrotor: The vehicle; the house's 1.5 kg one by default.

        Raises:
            ConfigError: The IMU is slower than the rotors need.
        """
        if rig.imu.rate_hz < LOWEST_IMU_RATE_HZ:
            raise ConfigError(f"IMU rate of {rig.imu.rate_hz:g} Hz; expected at least {LOWEST_IMU_RATE_HZ:g} Hz")
        self.rig = rig
        self.quadrotor = quadrotor or Quadrotor()
        self.interval_ns = round(1e9 / rig.imu.rate_hz)
        self.interval_s = self.interval_ns * 1e-9
        self._substeps = max(2, int(np.ceil(self.interval_s / LONGEST_STEP_S - 1e-9)))
        self._step_s = self.interval_s / self._substeps
        self._rotors = Rotors(self.quadrotor)
        self._model = _physics_model(self.quadrotor, rig, self._step_s)
        self._data = mujoco.MjData(self._model)
        self._standing = self._settle()
        self.reset()

    @property
    def t_ns(self) -> int:
        """The plant's clock [ns]."""
        return self._t_ns

    @property
    def rotor_speeds_rad_s(self) -> Array:
        """(4,) Speeds of the rotors [rad/s]."""
        return self._speeds.copy()

    @property
    def standing_height_m(self) -> float:
        """Height of the centre of mass above the floor when the drone stands on its feet [m]."""
        return float(self._standing[2])

    def reset(
        self,
        T_world_vehicle: Array | None = None,
        velocity_m_s: Array | None = None,
        rate_rad_s: Array | None = None,
        rotor_speeds_rad_s: Array | None = None,
    ) -> None:
        """Set the clock to 0 and the vehicle to a state.

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
        self._speeds = np.zeros(4) if rotor_speeds_rad_s is None else np.array(rotor_speeds_rad_s, dtype=np.float64)
        self._t_ns = 0
        self._sensed = 0
        self._times = [0]
        self._rows = [self._row()]
        self._turned = [self._speeds]
        between = self._cross_interval()
        self._between = [2.0 * self._rows[0] - between, between]  # before t = 0 it moved as it goes on

    def advance(self, t_ns: int, command: Array) -> None:
        """Hold a command (4,) of rotor speeds [rad/s] up to the last IMU time stamp not after ``t_ns``."""
        command = np.asarray(command, dtype=np.float64)
        while self._t_ns + self.interval_ns <= t_ns:
            self._t_ns += self.interval_ns
            self._times.append(self._t_ns)
            self._rows.append(self._row())
            self._speeds = self._rotors.next_speeds(self._speeds, command, self.interval_s)
            self._turned.append(self._speeds)
            self._between.append(self._cross_interval())

    def step_until(self, t_ns: int, command: Array) -> ImuSamples:
        """Hold a command (4,) of rotor speeds [rad/s] until ``t_ns`` and return the perfect IMU's points since.

        The first call returns the sample of t = 0 too. Stops at the last IMU time stamp not after ``t_ns``.
        """
        self.advance(t_ns, command)
        samples = self.motion(self._sensed).points(self.rig.T_vehicle_imu, self.interval_s)
        self._sensed = len(self._times)
        return samples

    def motion(self, first: int = 0) -> Motion:
        """Return the true motion since the reset at the IMU's time stamps, from the ``first`` one on."""
        rows = np.array(self._rows[first:]).reshape(-1, 13)
        between = np.array(self._between[first:])
        times = np.array(self._times[first:], dtype=np.int64)
        speeds = np.array(self._turned[first:]).reshape(-1, 4)
        return Motion(times, self._step_s, rows[:, :7], rows[:, 7:], between[:, :7], between[:, 7:], speeds)

    def state(self) -> NavState:
        """Return the true state of the IMU now, with zero biases: what a perfect estimator would say."""
        return self._state_of(self.rig.T_vehicle_imu)

    def vehicle_state(self) -> NavState:
        """Return the true state of the vehicle frame now, at the centre of mass."""
        return self._state_of(np.eye(4))

    def _state_of(self, T_vehicle_sensor: Array) -> NavState:
        """Return the true state of a frame fixed to the vehicle."""
        now = self.motion(len(self._times) - 1)
        truth = now.trajectory(T_vehicle_sensor)
        assert truth.velocity_m_s is not None
        return NavState(
            t_ns=self._t_ns,
            T_world_imu=truth.Ts_world_imu[0],
            velocity_m_s=truth.velocity_m_s[0],
            gyro_bias_rad_s=np.zeros(3),
            accel_bias_m_s2=np.zeros(3),
            angular_velocity_rad_s=now.angular_velocity_rad_s(T_vehicle_sensor)[0],
        )

    def _row(self) -> Array:
        """Return the (13,) pose and twist of the physics."""
        return np.concatenate([self._data.qpos, self._data.qvel])

    def _cross_interval(self) -> Array:
        """Step the physics to the next IMU time stamp and return the (13,) row half-way.

        The physics are one interval ahead of the clock: the wrench there is settled, whatever is commanded now.
        """
        model, data = self._model, self._data
        R = matrix_from_quat_wxyz(data.qpos[3:])
        data.ctrl[:] = self._rotors.wrench(self._speeds, data.qvel[:3] @ R, data.qvel[3:])
        half = self._substeps // 2
        mujoco.mj_step(model, data, half)
        row = self._row()
        if self._substeps % 2:  # half-way is between two steps
            mujoco.mj_step(model, data, 1)
            row = 0.5 * (row + self._row())
        mujoco.mj_step(model, data, half)
        return row

    def _settle(self) -> Array:
        """Return the (7,) pose in which the drone stands at rest: the feet's springs carry the weight."""
        mujoco.mj_resetData(self._model, self._data)
        mujoco.mj_step(self._model, self._data, round(_SETTLING_S / self._step_s))
        standing: Array = self._data.qpos.copy()
        return standing
