"""Geometric tracking controller on SE(3), down to the speed of each rotor.

Lee, Leok, McClamroch, "Geometric tracking control of a quadrotor UAV on SE(3)", CDC 2010. The position error determines
a force; force and heading determine an attitude; the errors of attitude and angular rate determine a torque.
Acceleration, angular rate and angular acceleration of the reference are fed forward, as are the drag in still air and
the ground effect of a floor at z = 0. Other disturbances (wind, a wrong mass) are estimated by observers and
compensated.
"""

from dataclasses import dataclass
from math import cos, exp, sin, sqrt

import numpy as np
import numpy.typing as npt

from dronevio.models.errors import ConfigError
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.quadrotor import AIR_DENSITY_KG_M3, RESEARCH, Quadrotor
from dronevio.models.rotation import inverse_pose
from dronevio.models.state import NavState
from dronevio.sim.paths.path import Reference
from dronevio.sim.physics.disturbance import DisturbanceObserver
from dronevio.sim.physics.drive import IDLE_SHARE, Mixer, RotorDrive
from dronevio.sim.physics.rotors import ground_effect

Array = npt.NDArray[np.float64]

_UP = np.array([0.0, 0.0, 1.0])
_CLEAR_OF_GROUND_M = 0.05  # height above the start from which no foot carries weight


@dataclass(frozen=True)
class Gains:
    """Gains of the controller per unit mass and inertia, valid for quadrotors of any size."""

    position_per_s2: float = 9.0
    """Acceleration per position error [1/s²]: a natural frequency of 3 rad/s."""
    velocity_per_s: float = 5.0
    """Acceleration per velocity error [1/s]."""
    tilt_per_s2: float = 140.0
    """Angular acceleration of roll and pitch per attitude error [1/s²]: 12 rad/s, a third of the rotors' 33."""
    tilt_rate_per_s: float = 18.0
    """Angular acceleration of roll and pitch per rate error [1/s]."""
    yaw_per_s2: float = 30.0
    """Angular acceleration of yaw per attitude error [1/s²]; small, since the drag torque of rotors is weak."""
    yaw_rate_per_s: float = 9.0
    """Angular acceleration of yaw per rate error [1/s]."""
    force_observer_rad_s: float = 5.0
    """Poles of the force disturbance observer [rad/s], slower than the attitude loop."""
    force_max_m_s2: float = 5.0
    """Largest compensated force disturbance on each axis per unit mass [m/s²]."""
    torque_observer_rad_s: float = 12.0
    """Poles of the torque disturbance observer [rad/s], slower than the rotors."""
    torque_max_rad_s2: float = 60.0
    """Largest compensated torque disturbance on each axis per unit inertia [rad/s²]."""
    rotor_response_s: float = 0.03
    """Time constant to which the lead compensation speeds up slower rotors [s]."""


class SE3Controller:
    """Tracks a reference trajectory; implements `Controller`.

    It controls the vehicle frame at the centre of mass from the state of the IMU, wherever that is mounted. It models
    the rotor speeds itself (starting at hover speed if the reference begins in the air), and must be called for every
    step of the reference in order.
    """

    def __init__(
        self, reference: Reference, T_vehicle_imu: Array, quadrotor: Quadrotor | None = None, gains: Gains | None = None
    ) -> None:
        """Define reference, vehicle and gains.

        Args:
            reference: The reference trajectory.
            T_vehicle_imu: (4, 4) Mounting of the IMU.
            quadrotor: Parameters of the vehicle; the research quadrotor of 1.5 kg by default.
            gains: Gains of the controller.
        """
        self._reference = reference
        self._quadrotor = quadrotor or RESEARCH
        self._gains = gains = gains or Gains()
        self._step_s = float(reference.t_ns[1] - reference.t_ns[0]) * 1e-9
        self._mixer = Mixer(self._quadrotor)
        self._airborne = bool(reference.flying[0])
        self._hover_speed = self._quadrotor.hover_speed_rad_s
        speed = self._hover_speed if self._airborne else 0.0
        self._drive = RotorDrive(self._quadrotor, gains.rotor_response_s, speed)
        self._force_observer = DisturbanceObserver(gains.force_observer_rad_s, gains.force_max_m_s2)
        self._torque_observer = DisturbanceObserver(gains.torque_observer_rad_s, gains.torque_max_rad_s2)
        self._allocation = self._quadrotor.allocation
        self._T_imu_vehicle = inverse_pose(T_vehicle_imu)
        self._R_vehicle_imu = T_vehicle_imu[:3, :3]
        self._lever = T_vehicle_imu[:3, 3]
        self._inertia = np.array(self._quadrotor.inertia_kg_m2)
        self._stiffness = np.array([gains.tilt_per_s2, gains.tilt_per_s2, gains.yaw_per_s2])
        self._damping = np.array([gains.tilt_rate_per_s, gains.tilt_rate_per_s, gains.yaw_rate_per_s])
        self._spins = self._quadrotor.rotor_directions
        self._yaw_drag_nm = 0.0

    def command(self, state: NavState, t_ns: int) -> Array:
        """Return rotor speeds (4,) [rad/s] for the state at ``t_ns``; zeros while the drone is to stand.

        Raises:
            ConfigError: The state has no angular velocity, or the reference ends before ``t_ns``.
        """
        row = self._reference.row(t_ns)
        if not self._reference.flying[row]:
            self._drive.towards(np.zeros(4), self._step_s)
            return np.zeros(4)
        if state.angular_velocity_rad_s is None:
            raise ConfigError("state without angular velocity; expected one, since the controller damps the rates")
        T = state.T_world_imu @ self._T_imu_vehicle
        R = T[:3, :3]
        rate = self._R_vehicle_imu @ state.angular_velocity_rad_s
        velocity = state.velocity_m_s - R @ _cross(rate, self._lever)
        lift = float(ground_effect(self._quadrotor, T[2, 3] + self._quadrotor.rotor_height_m))
        momentum = self._inertia * rate
        momentum[2] += self._quadrotor.rotor_inertia_kg_m2 * float(self._spins @ self._drive.speeds_rad_s)
        gyroscopic = _cross(rate, momentum)
        if self._has_taken_off(row):
            self._force_observer.update(velocity, self._modelled_acceleration(R[:, 2], velocity, lift), self._step_s)
            self._torque_observer.update(rate, self._modelled_angular_acceleration(gyroscopic), self._step_s)
        force = self._acceleration(row, T[:3, 3], velocity)
        R_desired = _attitude(force, float(self._reference.yaw_rad[row]))
        torque = self._inertia * self._angular_acceleration(row, R, R_desired, rate) + gyroscopic
        torque[2] = self._yaw_drag(torque[2])
        wanted = self._mixer.speeds(self._quadrotor.mass_kg * float(force @ R[:, 2]) / lift, torque)
        return self._drive.towards(wanted, self._step_s)

    def _has_taken_off(self, row: int) -> bool:
        """Return whether the drone has left the ground, whose contact forces are no disturbance."""
        height = self._reference.position_m[:, 2]
        self._airborne = self._airborne or bool(height[row] - height[0] > _CLEAR_OF_GROUND_M)
        return self._airborne

    def _modelled_acceleration(self, up: Array, velocity: Array, lift: float) -> Array:
        """Return the modelled acceleration (3,) by rotors, gravity and still air in the world frame [m/s²]."""
        speeds, drone = self._drive.speeds_rad_s, self._quadrotor
        thrust = lift * drone.thrust_n_per_rad2_s2 * float(speeds @ speeds) / drone.mass_kg
        return np.asarray(thrust * up - GRAVITY_M_S2 * _UP + self._drag(up, velocity, float(speeds.sum())))

    def _modelled_angular_acceleration(self, gyroscopic: Array) -> Array:
        """Return the modelled angular acceleration (3,) by the rotors in the vehicle frame [rad/s²]."""
        drive, drone = self._drive, self._quadrotor
        torque = self._allocation[1:] @ drive.speeds_rad_s**2
        torque[2] -= drone.rotor_inertia_kg_m2 * float(self._spins @ drive.acceleration_rad_s2)
        return np.asarray((torque - gyroscopic) / self._inertia)

    def _acceleration(self, row: int, position: Array, velocity: Array) -> Array:
        """Return the desired specific force (3,) of the rotors in the world frame [m/s²] (Lee 2010, eq. 15)."""
        reference, gains = self._reference, self._gains
        wanted = reference.velocity_m_s[row]
        force = (
            gains.position_per_s2 * (reference.position_m[row] - position)
            + gains.velocity_per_s * (wanted - velocity)
            + reference.acceleration_m_s2[row]
            - self._force_observer.disturbance
            + GRAVITY_M_S2 * _UP
        )
        size = sqrt(force @ force)
        speeds = 4.0 * self._hover_speed * sqrt(size / GRAVITY_M_S2)
        return np.asarray(force - self._drag(force / size, wanted, speeds))

    def _drag(self, up: Array, velocity: Array, speeds: float) -> Array:
        """Return the acceleration (3,) by drag in still air in the world frame [m/s²]; see `Rotors`.

        Args:
            up: (3,) The z axis of the vehicle in the world frame.
            velocity: (3,) Velocity in the world frame [m/s].
            speeds: Sum of the rotor speeds [rad/s].
        """
        drone = self._quadrotor
        body = 0.5 * AIR_DENSITY_KG_M3 * sqrt(velocity @ velocity)
        across = drone.drag_n_s2_per_rad_m * speeds + body * drone.drag_area_m2[0]
        along = drone.inflow_n_s2_per_rad_m * speeds + body * drone.drag_area_m2[2]
        climb = float(up @ velocity)
        return np.asarray((across * velocity + (along - across) * climb * up) / -drone.mass_kg)

    def _angular_acceleration(self, row: int, R: Array, R_desired: Array, rate: Array) -> Array:
        """Return the desired angular acceleration (3,) in the vehicle frame [rad/s²] (Lee 2010, eq. 16)."""
        turn = R_desired.T @ R
        attitude_error = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        desired_rate = turn.T @ self._reference.rate_rad_s[row]
        desired_acceleration = turn.T @ self._reference.angular_acceleration_rad_s2[row] - _cross(rate, desired_rate)
        errors = self._stiffness * attitude_error + self._damping * (rate - desired_rate)
        return np.asarray(desired_acceleration - errors - self._torque_observer.disturbance)

    def _yaw_drag(self, torque_nm: float) -> float:
        """Return the part of a yaw torque that the drag of the rotors is to provide [N m].

        An acceleration of a rotor acts on the body immediately by its reaction torque and later by its drag: together
        (1 + T s) times the drag, with T = J / (2 k_m ω) (Smeur, Chu, de Croon 2016). The inverse of this is applied.
        """
        drone = self._quadrotor
        speed = max(float(self._drive.speeds_rad_s.mean()), IDLE_SHARE * drone.rotor_speed_max_rad_s)
        ratio = 2.0 * drone.torque_nm_per_rad2_s2 * speed / drone.rotor_inertia_kg_m2
        self._yaw_drag_nm += (1.0 - exp(-self._step_s * ratio)) * (torque_nm - self._yaw_drag_nm)
        return self._yaw_drag_nm


def _attitude(force: Array, yaw_rad: float) -> Array:
    """Return the attitude (3, 3) with z along a force (3,) and a yaw: a fast scalar version of `path.attitude`."""
    z = force / sqrt(force @ force)
    y = _cross(z, np.array([cos(yaw_rad), sin(yaw_rad), 0.0]))
    y /= sqrt(y @ y)
    R = np.empty((3, 3))
    R[:, 0], R[:, 1], R[:, 2] = _cross(y, z), y, z
    return R


def _cross(a: Array, b: Array) -> Array:
    """Return a × b of two (3,) vectors; ten times as fast as `np.cross` for single vectors."""
    ax, ay, az = a.tolist()
    bx, by, bz = b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])
