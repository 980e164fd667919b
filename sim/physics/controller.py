"""Geometric tracking controller on SE(3), down to the speed of each rotor.

Lee, Leok, McClamroch, "Geometric tracking control of a quadrotor UAV on SE(3)", CDC 2010. The position error determines
a force; force and heading determine an attitude; the errors of attitude and angular rate determine a torque.
Acceleration, angular rate and angular acceleration of the reference are fed forward, as are the drag in still air and
the ground effect of a floor at z = 0. Other disturbances (wind, a wrong mass) are estimated by observers and
compensated. The stages are those of `Cascade`.
"""

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.quadrotor import RESEARCH, Quadrotor
from dronevio.models.rotation import cross, inverse_pose
from dronevio.models.state import NavState
from dronevio.sim.paths.course import Course, ReferencePoint
from dronevio.sim.physics.cascade import Body, Cascade, Loads, attitude_along
from dronevio.sim.physics.gains import Gains

_CLEAR_OF_GROUND_M = 0.05  # height above the start from which no foot carries weight


class SE3Controller:
    """Tracks a course; implements `Controller`.

    It controls the vehicle frame at the centre of mass from the state of the IMU, wherever that is mounted. It models
    the rotor speeds itself (starting at hover speed if the course begins in the air), and must be called for every
    interval of the course in order.
    """

    def __init__(
        self, course: Course, T_vehicle_imu: Array, quadrotor: Quadrotor | None = None, gains: Gains | None = None
    ) -> None:
        """Define course, vehicle and gains.

        Args:
            course: What is tracked, such as a reference trajectory.
            T_vehicle_imu: (4, 4) Mounting of the IMU.
            quadrotor: Parameters of the vehicle; the research quadrotor of 1.5 kg by default.
            gains: Gains of the controller.
        """
        self._course = course
        start = course.point(0)
        self._cascade = Cascade(quadrotor or RESEARCH, gains or Gains(), course.interval_ns * 1e-9)
        self._ground_m, self._airborne = float(start.position_m[2]), start.flying
        speed = self._cascade.quadrotor.hover_speed_rad_s if self._airborne else 0.0
        self._state = self._cascade.at(np.full(self._cascade.quadrotor.rotor_count, speed), np.zeros(3), np.zeros(3))
        self._observing = False
        self._T_imu_vehicle = inverse_pose(T_vehicle_imu)
        self._R_vehicle_imu = T_vehicle_imu[:3, :3]
        self._lever = T_vehicle_imu[:3, 3]

    def command(self, state: NavState, t_ns: int) -> Array:
        """Return rotor speeds (R,) [rad/s] for the state at ``t_ns``; zeros while the drone is to stand.

        Raises:
            ConfigError: The state has no angular velocity, or the reference ends before ``t_ns``.
        """
        point, cascade = self._course.point(t_ns), self._cascade
        if not point.flying:
            self._state = cascade.stopped(self._state)
            return np.zeros_like(self._state.drive.speeds_rad_s)
        body = self._body(state)
        loads = cascade.loads(self._state, body)
        if self._has_taken_off(point):
            self._observe(body, loads)
        force = cascade.specific_force(self._state, body, point.position_m, point.velocity_m_s, point.acceleration_m_s2)
        R_desired = attitude_along(force, point.yaw_rad)
        acceleration = cascade.angular_acceleration(
            self._state, body, R_desired, point.rate_rad_s, point.angular_acceleration_rad_s2
        )
        thrust_n = cascade.quadrotor.mass_kg * np.vecdot(force, body.R_world_vehicle[:, 2]) / loads.lift
        command, self._state = cascade.commands(self._state, loads, thrust_n, acceleration)
        return command

    def _body(self, state: NavState) -> Body:
        """Return the motion of the vehicle, given the state of the IMU.

        Raises:
            ConfigError: The state has no angular velocity.
        """
        if state.angular_velocity_rad_s is None:
            raise ConfigError("state without angular velocity; expected one, since the controller damps the rates")
        T = state.T_world_imu @ self._T_imu_vehicle
        R = T[:3, :3]
        rate = self._R_vehicle_imu @ state.angular_velocity_rad_s
        return Body(T[:3, 3], R, state.velocity_m_s - R @ cross(rate, self._lever), rate)

    def _has_taken_off(self, point: ReferencePoint) -> bool:
        """Return whether the drone has left the ground, whose contact forces are no disturbance."""
        self._airborne = self._airborne or bool(point.position_m[2] - self._ground_m > _CLEAR_OF_GROUND_M)
        return self._airborne

    def _observe(self, body: Body, loads: Loads) -> None:
        """Update the disturbance observers, which start with the motion at the take-off."""
        if not self._observing:
            started = self._cascade.at(self._state.drive.speeds_rad_s, body.velocity_m_s, body.rate_rad_s)
            self._state = self._state._replace(force=started.force, torque=started.torque)
            self._observing = True
        self._state = self._cascade.observe(self._state, body, loads)
