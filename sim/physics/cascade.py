"""Cascade of control loops on SE(3): specific force, attitude, body rates, torque, and rotor commands.

Lee, Leok, McClamroch, "Geometric tracking control of a quadrotor UAV on SE(3)", CDC 2010. Each stage can be called
alone, so that a command may enter at any of them. All functions broadcast over leading axes, for one vehicle or many;
states are explicit, so that rows of many vehicles can be reset one by one.
"""

from math import cos, exp, sin
from typing import NamedTuple

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.quadrotor import AIR_DENSITY_KG_M3, Quadrotor
from dronevio.models.rotation import cross
from dronevio.sim.physics.disturbance import DisturbanceObserver, ObserverState
from dronevio.sim.physics.drive import IDLE_SHARE, DriveState, Mixer, RotorDrive
from dronevio.sim.physics.gains import Gains
from dronevio.sim.physics.ground_effect import GroundEffect

_GRAVITY = np.array([0.0, 0.0, GRAVITY_M_S2])
_ZERO = np.zeros(3)


class Body(NamedTuple):
    """Motion of the vehicle frame at the centre of mass, of one vehicle or many."""

    position_m: Array
    """(…, 3) Position in the world, with the floor at z = 0 [m]."""
    R_world_vehicle: Array
    """(…, 3, 3) Rotation from the vehicle frame to the world."""
    velocity_m_s: Array
    """(…, 3) Velocity in the world frame [m/s]."""
    rate_rad_s: Array
    """(…, 3) Angular velocity in the vehicle frame [rad/s]."""


class CascadeState(NamedTuple):
    """State of the control loops of one vehicle or many."""

    drive: DriveState
    """Modelled state of the rotors."""
    force: ObserverState
    """Observer of the acceleration of the centre of mass, in the world frame [m/s, m/s²]."""
    torque: ObserverState
    """Observer of the angular acceleration, in the vehicle frame [rad/s, rad/s²]."""
    yaw_drag_nm: Array | float
    """(…) Part of the yaw torque that the drag of the rotors provides [N m]."""


class Loads(NamedTuple):
    """Loads on the body that depend on its motion."""

    gyroscopic_nm: Array
    """(…, 3) Torque that the rotation of body and rotors requires [N m]."""
    lift: Array
    """(…) Ratio of thrust near the ground to that in free air."""


class Cascade:
    """The control loops of one vehicle type, called once in every control interval."""

    def __init__(self, quadrotor: Quadrotor, gains: Gains, interval_s: float) -> None:
        """Define vehicle, gains and the time between two calls [s]."""
        self.quadrotor = quadrotor
        self._gains = gains
        self._interval_s = interval_s
        self._mixer = Mixer(quadrotor)
        self._ground = GroundEffect(quadrotor)
        self._rotor_count = float(quadrotor.rotor_count)
        self._drive = RotorDrive(quadrotor, gains.rotor_response_s, interval_s)
        self._force = DisturbanceObserver(gains.force_observer_rad_s, gains.force_max_m_s2, interval_s)
        self._torque = DisturbanceObserver(gains.torque_observer_rad_s, gains.torque_max_rad_s2, interval_s)
        self._hover_speed = quadrotor.hover_speed_rad_s
        self._torques = quadrotor.allocation[1:]
        self._inertia = np.array(quadrotor.inertia_kg_m2)
        self._stiffness = np.array([gains.tilt_per_s2, gains.tilt_per_s2, gains.yaw_per_s2])
        self._damping = np.array([gains.tilt_rate_per_s, gains.tilt_rate_per_s, gains.yaw_rate_per_s])
        self._spins = quadrotor.rotor_directions

    def at(self, rotor_speeds_rad_s: Array, velocity_m_s: Array, rate_rad_s: Array) -> CascadeState:
        """Return the state of vehicles in steady motion.

        Args:
            rotor_speeds_rad_s: (…, R) Rotor speeds [rad/s].
            velocity_m_s: (…, 3) Velocities in the world frame [m/s].
            rate_rad_s: (…, 3) Angular velocities in the vehicle frame [rad/s].
        """
        force, torque = self._force.at(velocity_m_s), self._torque.at(rate_rad_s)
        return CascadeState(self._drive.at(rotor_speeds_rad_s), force, torque, 0.0 * rotor_speeds_rad_s[..., 0])

    def loads(self, state: CascadeState, body: Body) -> Loads:
        """Return the loads on the body."""
        momentum = self._inertia * body.rate_rad_s
        momentum[..., 2] += self.quadrotor.rotor_inertia_kg_m2 * np.vecdot(state.drive.speeds_rad_s, self._spins)
        return Loads(cross(body.rate_rad_s, momentum), self._ground.mean_ratio(body.position_m[..., 2]))

    def observe(self, state: CascadeState, body: Body, loads: Loads) -> CascadeState:
        """Return the state after an update of the disturbance observers, for vehicles that fly freely."""
        linear, angular = self._modelled_acceleration(state, body, loads), self._modelled_rotation(state, loads)
        force = self._force.update(state.force, body.velocity_m_s, linear)
        return CascadeState(
            state.drive, force, self._torque.update(state.torque, body.rate_rad_s, angular), state.yaw_drag_nm
        )

    def specific_force(
        self, state: CascadeState, body: Body, position_m: Array, velocity_m_s: Array, acceleration_m_s2: Array = _ZERO
    ) -> Array:
        """Return the desired specific force (…, 3) of the rotors in the world frame [m/s²] (Lee 2010, eq. 15).

        Args:
            state: State of the control loops.
            body: Motion of the vehicles.
            position_m: (…, 3) Desired position [m]; that of the body to control the velocity alone.
            velocity_m_s: (…, 3) Desired velocity in the world frame [m/s].
            acceleration_m_s2: (…, 3) Desired acceleration in the world frame, fed forward [m/s²].
        """
        force = (
            self._gains.position_per_s2 * (position_m - body.position_m)
            + self._gains.velocity_per_s * (velocity_m_s - body.velocity_m_s)
            + acceleration_m_s2
            - state.force.disturbance
            + _GRAVITY
        )
        size = np.sqrt(np.vecdot(force, force))
        speeds = self._rotor_count * self._hover_speed * np.sqrt(size / GRAVITY_M_S2)
        return np.asarray(force - self._drag(force / size[..., None], velocity_m_s, speeds))

    def angular_acceleration(
        self,
        state: CascadeState,
        body: Body,
        R_desired: Array,
        rate_rad_s: Array = _ZERO,
        acceleration_rad_s2: Array = _ZERO,
    ) -> Array:
        """Return the desired angular acceleration (…, 3) in the vehicle frame [rad/s²] (Lee 2010, eq. 16).

        Args:
            state: State of the control loops.
            body: Motion of the vehicles.
            R_desired: (…, 3, 3) Desired attitude; that of the body to control the rates alone.
            rate_rad_s: (…, 3) Desired angular velocity in the frame of the desired attitude [rad/s].
            acceleration_rad_s2: (…, 3) Desired angular acceleration in that frame [rad/s²].
        """
        turn = R_desired.mT @ body.R_world_vehicle
        desired_rate = np.vecmat(rate_rad_s, turn)
        desired = np.vecmat(acceleration_rad_s2, turn) - cross(body.rate_rad_s, desired_rate)
        errors = self._stiffness * _attitude_error(turn) + self._damping * (body.rate_rad_s - desired_rate)
        return np.asarray(desired - errors - state.torque.disturbance)

    def commands(
        self, state: CascadeState, loads: Loads, thrust_n: Array, angular_acceleration_rad_s2: Array
    ) -> tuple[Array, CascadeState]:
        """Return the commands (…, R) of rotor speeds [rad/s] for the next interval, and the state after it.

        Args:
            state: State of the control loops.
            loads: Loads on the body.
            thrust_n: (…) Desired thrust in free air [N].
            angular_acceleration_rad_s2: (…, 3) Desired angular acceleration in the vehicle frame [rad/s²].
        """
        torque = self._inertia * angular_acceleration_rad_s2 + loads.gyroscopic_nm
        yaw_drag = self._yaw_drag(state, torque[..., 2])
        torque[..., 2] = yaw_drag
        command, drive = self._drive.towards(state.drive, self._mixer.speeds(thrust_n, torque))
        return command, CascadeState(drive, state.force, state.torque, yaw_drag)

    def stopped(self, state: CascadeState) -> CascadeState:
        """Return the state after an interval with commands of 0."""
        _, drive = self._drive.towards(state.drive, np.zeros_like(state.drive.speeds_rad_s))
        return CascadeState(drive, state.force, state.torque, state.yaw_drag_nm)

    def _modelled_acceleration(self, state: CascadeState, body: Body, loads: Loads) -> Array:
        """Return the modelled acceleration (…, 3) by rotors, gravity and still air in the world frame [m/s²]."""
        speeds, drone = state.drive.speeds_rad_s, self.quadrotor
        up = body.R_world_vehicle[..., 2]
        thrust = loads.lift * drone.thrust_n_per_rad2_s2 * np.vecdot(speeds, speeds) / drone.mass_kg
        drag = self._drag(up, body.velocity_m_s, np.add.reduce(speeds, axis=-1))
        return np.asarray(thrust[..., None] * up - _GRAVITY + drag)

    def _modelled_rotation(self, state: CascadeState, loads: Loads) -> Array:
        """Return the modelled angular acceleration (…, 3) by the rotors in the vehicle frame [rad/s²]."""
        torque = np.matvec(self._torques, state.drive.speeds_rad_s**2)
        reaction = np.vecdot(state.drive.acceleration_rad_s2, self._spins)
        torque[..., 2] -= self.quadrotor.rotor_inertia_kg_m2 * reaction
        return np.asarray((torque - loads.gyroscopic_nm) / self._inertia)

    def _drag(self, up: Array, velocity: Array, speeds: Array) -> Array:
        """Return the acceleration (…, 3) by drag in still air in the world frame [m/s²]; see `Rotors`.

        Args:
            up: (…, 3) The z axis of the vehicle in the world frame.
            velocity: (…, 3) Velocity in the world frame [m/s].
            speeds: (…) Sum of the rotor speeds [rad/s].
        """
        drone = self.quadrotor
        body = 0.5 * AIR_DENSITY_KG_M3 * np.sqrt(np.vecdot(velocity, velocity))
        across = drone.drag_n_s2_per_rad_m * speeds + body * drone.drag_area_m2[0]
        along = drone.inflow_n_s2_per_rad_m * speeds + body * drone.drag_area_m2[2]
        along_up = (along - across) * np.vecdot(up, velocity)
        return np.asarray((across[..., None] * velocity + along_up[..., None] * up) / -drone.mass_kg)

    def _yaw_drag(self, state: CascadeState, torque_nm: Array) -> Array:
        """Return the part (…) of yaw torques (…) that the drag of the rotors is to provide [N m].

        An acceleration of a rotor acts on the body immediately by its reaction torque and later by its drag: together
        (1 + T s) times the drag, with T = J / (2 k_m ω) (Smeur, Chu, de Croon 2016). The inverse of this is applied.
        """
        drone = self.quadrotor
        mean = np.add.reduce(state.drive.speeds_rad_s, axis=-1) / self._rotor_count
        speed = np.maximum(mean, IDLE_SHARE * drone.rotor_speed_max_rad_s)
        ratio = 2.0 * drone.torque_nm_per_rad2_s2 * speed / drone.rotor_inertia_kg_m2
        decay = -self._interval_s * ratio
        follows = 1.0 - (exp(decay) if isinstance(decay, float) else np.exp(decay))
        return state.yaw_drag_nm + follows * (torque_nm - state.yaw_drag_nm)


def attitude_along(force: Array, yaw_rad: Array | float) -> Array:
    """Return attitudes (…, 3, 3) with z along forces (…, 3) and yaws (…) [rad]; see `path.attitude`."""
    z = force / np.sqrt(np.vecdot(force, force))[..., None]
    y = cross(z, _heading(yaw_rad))
    y = y / np.sqrt(np.vecdot(y, y))[..., None]
    R = np.empty((*z.shape, 3))
    R[..., 0], R[..., 1], R[..., 2] = cross(y, z), y, z
    return R


def _heading(yaw_rad: Array | float) -> Array:
    """Return horizontal unit vectors (…, 3) of yaws (…) [rad]; `math` is faster for one yaw."""
    if isinstance(yaw_rad, float):
        return np.array([cos(yaw_rad), sin(yaw_rad), 0.0])
    return np.stack([np.cos(yaw_rad), np.sin(yaw_rad), np.zeros_like(yaw_rad)], axis=-1)


def _attitude_error(turn: Array) -> Array:
    """Return the attitude errors (…, 3) of rotations (…, 3, 3) from the desired to the true attitude."""
    if turn.ndim == 2:
        return 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    difference = turn - turn.mT
    return 0.5 * np.stack([difference[..., 2, 1], difference[..., 0, 2], difference[..., 1, 0]], axis=-1)
