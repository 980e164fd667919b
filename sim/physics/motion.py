"""True motion of the vehicle, and the samples of a noise-free IMU.

MuJoCo's Euler integrator is semi-implicit (leapfrog): the velocity stored with a pose belongs to half a step earlier.
Here every pose is moved back by half a step, so that positions, velocities and forces belong to the same time to second
order in the step, and dead reckoning of the samples reproduces the truth. All functions operate on whole flights.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.interpolate import make_interp_spline

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples, Times
from dronevio.models.rotation import exp_so3, log_so3, matrix_from_quat_wxyz, quat_wxyz_from_matrix
from dronevio.models.state import Trajectory
from dronevio.sim.physics.batch_motion import specific_forces


def middle_of_interval(before: Array, after: Array, steps: int) -> Array:
    """Return the state of the physics in the middle of an interval.

    Args:
        before: State after half of the steps, rounded down.
        after: State one step later.
        steps: Number of steps of the interval; the middle of an odd number is between two of them.
    """
    return 0.5 * (before + after) if steps % 2 else before


def extrapolated_back(at: Array, middle: Array) -> Array:
    """Return the state half an interval before the first one, given those at and half an interval after it."""
    return 2.0 * at - middle


@dataclass(frozen=True, eq=False)
class Motion:
    """States of the physics at the IMU time stamps, and at the middle between them.

    Linear quantities are in the world frame, angular velocities in the vehicle frame, as in MuJoCo's free joint.
    """

    t_ns: Times
    """(N,) Time stamps of the IMU [ns]."""
    step_s: float
    """Time step of the physics [s]."""
    pose: Array
    """(N, 7) Position of the centre of mass [m] and orientation quat_wxyz of the vehicle."""
    twist: Array
    """(N, 6) Velocity [m/s] and angular velocity [rad/s]."""
    pose_between: Array
    """(N + 1, 7) Poses half an IMU interval before each time stamp, and after the last one."""
    twist_between: Array
    """(N + 1, 6) Twists at the times of ``pose_between``."""
    rotor_speeds_rad_s: Array
    """(N, R) Rotor speeds from each time stamp to the next [rad/s]."""

    def at_interval(self, interval_ns: int) -> "Motion":
        """Return the motion at the time stamps of an IMU with another rate.

        States between those of half an interval are interpolated linearly, since forces are constant over an interval.

        Args:
            interval_ns: Time between the stamps [ns]: a multiple of that of this motion, or half of it.

        Raises:
            ConfigError: It is neither.
        """
        own_ns = int(self.t_ns[1] - self.t_ns[0])
        if interval_ns == own_ns:
            return self
        if not can_be_resampled(own_ns, interval_ns):
            raise ConfigError(
                f"an IMU interval of {interval_ns * 1e-6:g} ms with a control interval of {own_ns * 1e-6:g} ms; "
                "expected a multiple of the latter, or half of it"
            )
        halves = 2 * interval_ns // own_ns  # times are in half intervals of this motion from here on
        at = np.arange(0, 2 * len(self.t_ns) - 1, halves)
        between = np.append(at, at[-1] + halves) - 0.5 * halves
        poses = _line_through(self.pose_between, self.pose)
        twists = _line_through(self.twist_between, self.twist)
        return Motion(
            self.t_ns[0] + at * (own_ns // 2),
            self.step_s,
            _unit(poses(at)),
            twists(at),
            _unit(poses(between)),
            twists(between),
            self.rotor_speeds_rad_s[at // 2],
        )

    def trajectory(self, T_vehicle_sensor: Array) -> Trajectory:
        """Return the trajectory of a frame fixed to the vehicle, with its velocity in the world frame."""
        R = _rotations(self.pose, self.twist, self.step_s)
        lever = T_vehicle_sensor[:3, 3]
        p = self.pose[:, :3] - 0.5 * self.step_s * self.twist[:, :3] + R @ lever
        v = _velocity_of(lever, self.twist, R)
        return Trajectory(self.t_ns, p, quat_wxyz_from_matrix(R @ T_vehicle_sensor[:3, :3]), velocity_m_s=v)

    def angular_velocity_rad_s(self, T_vehicle_sensor: Array) -> Array:
        """Return (N, 3) angular velocities in the frame of a sensor [rad/s]."""
        return np.asarray(self.twist[:, 3:] @ T_vehicle_sensor[:3, :3])

    def points(self, T_vehicle_imu: Array, interval_s: float) -> ImuSamples:
        """Return the point samples of a noise-free IMU at each time stamp.

        The gyroscope measures the angular rate at the time stamp. The accelerometer measures the mean over one interval
        centred on it, as the filter of a real one does: force steps of the rotors and landing shocks are shorter than
        an interval, and instantaneous values would alias them into a permanent velocity error. The midpoint rule on
        neighbouring samples then errs by sampling only:

        - The angular rate is known at both ends of an interval only. The error of its mean is dt²/12 ω̈, and the
          rotation also has the coning error dt²/12 ω₀ × ω₁ (Bortz, "A new mathematical formulation for strapdown
          inertial navigation", 1971). Both accumulate: about 2e-3 rad over a minute at 3 rad/s, and
          negligibly at 1 rad/s.
        - A step of the acceleration at a time stamp causes a velocity error of dt/4 of the step, which does not
          accumulate, except through the attitude error.

        Increments have none of these errors.

        Args:
            T_vehicle_imu: (4, 4) Mounting of the IMU.
            interval_s: Time between the stamps [s].
        """
        lever = T_vehicle_imu[:3, 3]
        between = _velocity_of(
            lever, self.twist_between, _rotations(self.pose_between, self.twist_between, self.step_s)
        )
        R_imu = _rotations(self.pose, self.twist, self.step_s) @ T_vehicle_imu[:3, :3]
        force = _specific_forces(R_imu, between, interval_s)
        return ImuSamples(self.t_ns, self.angular_velocity_rad_s(T_vehicle_imu), force, "point")

    def increments(self, T_vehicle_imu: Array) -> ImuSamples:
        """Return the increments of a noise-free integrating IMU over the N − 1 intervals between the time stamps.

        They are exact by construction: R₁ = R₀ exp(gyro · dt) and v₁ = v₀ + R₀ accel · dt + g dt to rounding.
        """
        R = _rotations(self.pose, self.twist, self.step_s)
        v = _velocity_of(T_vehicle_imu[:3, 3], self.twist, R)
        R_imu = R @ T_vehicle_imu[:3, :3]
        dt_s = np.diff(self.t_ns) * 1e-9
        turn = log_so3(np.swapaxes(R_imu[:-1], 1, 2) @ R_imu[1:])
        force = _specific_forces(R_imu[:-1], v, dt_s)
        return ImuSamples(self.t_ns[1:], turn / dt_s[:, None], force, "increment")


def can_be_resampled(own_ns: int, interval_ns: int) -> bool:
    """Return whether a motion with one interval has states at those of another [ns]; see `Motion.at_interval`."""
    return interval_ns % own_ns == 0 or 2 * interval_ns == own_ns


def _line_through(between: Array, at: Array) -> Callable[[npt.NDArray[Any]], Array]:
    """Return linear interpolation, over half intervals, of states at the stamps (N, K) and between (N + 1, K)."""
    states = np.empty((len(at) + len(between), at.shape[1]))
    states[::2], states[1::2] = between, at
    line = make_interp_spline(np.arange(-1, len(states) - 1), states, k=1)  # extrapolates, too
    return lambda half_intervals: np.asarray(line(half_intervals))


def _unit(pose: Array) -> Array:
    """Return poses (N, 7) with unit quaternions."""
    return np.hstack([pose[:, :3], pose[:, 3:] / np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)])


def _rotations(pose: Array, twist: Array, step_s: float) -> Array:
    """Return (N, 3, 3) orientations of the vehicle at the times of the velocities."""
    return np.asarray(matrix_from_quat_wxyz(pose[:, 3:]) @ exp_so3(-0.5 * step_s * twist[:, 3:]))


def _velocity_of(lever: Array, twist: Array, R: Array) -> Array:
    """Return (N, 3) world velocities of a point fixed to the vehicle."""
    return np.asarray(twist[:, :3] + (R @ np.cross(twist[:, 3:], lever)[..., None])[..., 0])


def _specific_forces(R: Array, v: Array, interval_s: Array | float) -> Array:
    """Return (N, 3) mean specific forces between N + 1 velocities, in frames of orientations (N, 3, 3)."""
    return specific_forces(R.transpose(1, 2, 0), v[:-1].T, v[1:].T, interval_s).T
