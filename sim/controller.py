"""The controller: geometric tracking on SE(3), down to the speed of each rotor.

Lee, Leok, McClamroch, "Geometric tracking control of a quadrotor UAV on SE(3)", CDC 2010. The position error asks for
a force; the force, with the heading, asks for an attitude; the errors of attitude and rate ask for a torque. The
reference's own acceleration, rates and angular acceleration are fed forward.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.models.errors import ConfigError
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.quadrotor import Quadrotor
from dronevio.models.rotation import inverse_pose
from dronevio.models.state import NavState
from dronevio.sim.path import Reference, attitude

Array = npt.NDArray[np.float64]

_UP = np.array([0.0, 0.0, 1.0])
_IDLE_SHARE = 0.1  # of the greatest rotor speed: rotors never stop in the air


@dataclass(frozen=True)
class Gains:
    """Stiffness and damping by unit mass and inertia, so that they hold for every quadrotor."""

    position_per_s2: float = 9.0
    """Acceleration by position error [1/s²]: a natural frequency of 3 rad/s."""
    velocity_per_s: float = 5.0
    """Acceleration by velocity error [1/s]."""
    tilt_per_s2: float = 140.0
    """Angular acceleration of roll and pitch by attitude error [1/s²]: 12 rad/s, a third of the rotors' 33."""
    tilt_rate_per_s: float = 18.0
    """Angular acceleration of roll and pitch by rate error [1/s]."""
    yaw_per_s2: float = 30.0
    """Angular acceleration of yaw by attitude error [1/s²]: the rotors' drag torque is weak."""
    yaw_rate_per_s: float = 9.0
    """Angular acceleration of yaw by rate error [1/s]."""


class Mixer:
    """Turns thrust and torques into rotor speeds, and gives way sensibly where the rotors cannot."""

    def __init__(self, quadrotor: Quadrotor) -> None:
        self._inverse = np.linalg.inv(quadrotor.allocation)
        self._high = quadrotor.rotor_speed_max_rad_s**2
        self._low = _IDLE_SHARE**2 * self._high

    def speeds(self, thrust_n: float, torque_nm: Array) -> Array:
        """Return rotor speeds (4,) [rad/s] for a thrust and torques (3,) about x, y, z.

        Where a rotor would leave its range, yaw is given up first, then thrust, last roll and pitch: a drone that
        keeps its tilt keeps its path.
        """
        low, high = self._low, self._high
        tilt = self._inverse[:, 1:3] @ torque_nm[:2]
        tilt = tilt * min(1.0, (high - low) / max(float(np.ptp(tilt)), 1e-9))
        lift = min(max(self._inverse[0, 0] * thrust_n, low - float(tilt.min())), high - float(tilt.max()))
        base = lift + tilt
        yaw = self._inverse[:, 3] * torque_nm[2]
        room = np.where(yaw > 0.0, high - base, base - low)
        share = min(1.0, float(np.min(room / np.maximum(np.abs(yaw), 1e-9))))
        return np.asarray(np.sqrt(np.clip(base + share * yaw, low, high)))


class SE3Controller:
    """Flies a reference; implements `Controller`.

    It works on the vehicle frame at the centre of mass, and takes the state of the IMU wherever that is mounted.
    """

    def __init__(
        self, reference: Reference, T_vehicle_imu: Array, quadrotor: Quadrotor | None = None, gains: Gains | None = None
    ) -> None:
        """Prepare to fly.

        Args:
            reference: Where to be, when.
            T_vehicle_imu: (4, 4) Where the IMU is mounted.
            quadrotor: Whose mass, inertia and rotors to count with; the house's 1.5 kg one by default.
            gains: How stiffly to fly.
        """
        self._reference = reference
        self._quadrotor = quadrotor or Quadrotor()
        self._gains = gains or Gains()
        self._mixer = Mixer(self._quadrotor)
        self._T_imu_vehicle = inverse_pose(T_vehicle_imu)
        self._R_vehicle_imu = T_vehicle_imu[:3, :3]
        self._lever = T_vehicle_imu[:3, 3]
        self._inertia = np.array(self._quadrotor.inertia_kg_m2)
        self._air_drag_per_s = (
            4.0 * self._quadrotor.drag_n_s2_per_rad_m * self._quadrotor.hover_speed_rad_s / self._quadrotor.mass_kg
        )

    def command(self, state: NavState, t_ns: int) -> Array:
        """Return rotor speeds (4,) [rad/s] for the state at ``t_ns``; zeros while the drone should stand.

        Raises:
            ConfigError: The state has no angular velocity, or the reference ends before ``t_ns``.
        """
        row = self._reference.row(t_ns)
        if not self._reference.flying[row]:
            return np.zeros(4)
        if state.angular_velocity_rad_s is None:
            raise ConfigError("state without angular velocity; expected one, since the controller damps the rates")
        T = state.T_world_imu @ self._T_imu_vehicle
        R = T[:3, :3]
        rate = self._R_vehicle_imu @ state.angular_velocity_rad_s
        velocity = state.velocity_m_s - R @ _cross(rate, self._lever)
        force = self._acceleration(row, T[:3, 3], velocity)
        R_wanted = attitude(force, self._reference.yaw_rad[row])
        torque = self._torque(row, R, R_wanted, rate)
        return self._mixer.speeds(self._quadrotor.mass_kg * float(force @ R[:, 2]), torque)

    def _acceleration(self, row: int, position: Array, velocity: Array) -> Array:
        """Return the specific force (3,) that the rotors should give, in the world [m/s²] (Lee 2010, eq. 15)."""
        reference, gains = self._reference, self._gains
        wanted = reference.velocity_m_s[row]
        drag = self._air_drag_per_s * wanted * [1.0, 1.0, 0.0]
        return np.asarray(
            gains.position_per_s2 * (reference.position_m[row] - position)
            + gains.velocity_per_s * (wanted - velocity)
            + reference.acceleration_m_s2[row]
            + drag
            + GRAVITY_M_S2 * _UP
        )

    def _torque(self, row: int, R: Array, R_wanted: Array, rate: Array) -> Array:
        """Return the torque (3,) in the vehicle frame [N m] (Lee 2010, eq. 16)."""
        gains = self._gains
        turn = R_wanted.T @ R
        attitude_error = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        wanted_rate = turn.T @ self._reference.rate_rad_s[row]
        wanted_change = turn.T @ self._reference.angular_acceleration_rad_s2[row] - _cross(rate, wanted_rate)
        stiffness = np.array([gains.tilt_per_s2, gains.tilt_per_s2, gains.yaw_per_s2])
        damping = np.array([gains.tilt_rate_per_s, gains.tilt_rate_per_s, gains.yaw_rate_per_s])
        change = wanted_change - stiffness * attitude_error - damping * (rate - wanted_rate)
        return np.asarray(self._inertia * change + _cross(rate, self._inertia * rate))


def _cross(a: Array, b: Array) -> Array:
    """Return a × b of two (3,) vectors; `np.cross` takes ten times as long for so few numbers."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
