"""Smooth motion through recorded poses, and the IMU samples along it.

Poses of a tracking system have jitter, which their second derivative amplifies. The poses are therefore approximated by
a quintic B-spline with a knot every few samples: positions componentwise, orientations as quaternions that are
normalized after evaluation. Velocity, acceleration and angular velocity are exact derivatives of one smooth curve (cf.
Furgale, Rehder and Siegwart, "Unified temporal and spatial calibration for multi-sensor systems", IROS 2013).
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.interpolate import BSpline, make_lsq_spline

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.imu import GRAVITY_M_S2, ImuSamples, Times
from dronevio.models.quaternions import components, conjugate, product
from dronevio.models.rotation import log_so3, matrix_from_quat_wxyz
from dronevio.models.state import Trajectory

KNOT_INTERVAL_S = 0.05
"""Time between knots [s]: the spline follows motion up to about 8 Hz, beyond the dynamics of a drone's body, and
averages the jitter of ten poses at 200 Hz."""
LONGEST_GAP_S = 0.25
"""Longest gap between poses that is interpolated [s]: at 90 °/s a drone rotates by 20° in it."""
_DEGREE = 5  # acceleration is a cubic spline
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class SmoothMotion:
    """Motion of a frame as splines over time."""

    origin_ns: int
    """Time stamp of the time 0 of the splines [ns]."""
    end_s: float
    """End time of the splines [s]."""
    position: BSpline
    """Function from times (M,) [s] to positions (M, 3) in the world [m]."""
    quaternion: BSpline
    """Function from times (M,) [s] to quaternions (M, 4), wxyz, not normalized."""

    @classmethod
    def through(cls, trajectory: Trajectory, knot_interval_s: float = KNOT_INTERVAL_S) -> Self:
        """Fit a smooth motion to poses by least squares.

        Args:
            trajectory: Poses at any times not more than `LONGEST_GAP_S` apart.
            knot_interval_s: Time between knots [s]; larger values are smoother.

        Raises:
            ConfigError: There are too few poses, or a gap between two is too long.
        """
        t = trajectory.t_s
        if len(t) <= _DEGREE + 1:
            raise ConfigError(f"trajectory of {len(t)} poses; expected more than {_DEGREE + 1} for a smooth motion")
        gaps_s = np.diff(t)
        if gaps_s.max() > LONGEST_GAP_S:
            where = float(t[int(gaps_s.argmax())])
            raise ConfigError(
                f"trajectory with a gap of {gaps_s.max():.2f} s, {where:.2f} s after its start; expected poses at least"
                f" every {LONGEST_GAP_S:g} s"
            )
        knots = _knots(t, knot_interval_s)
        position = make_lsq_spline(t, trajectory.p_world_imu, knots, _DEGREE)
        quaternion = make_lsq_spline(t, _continuous(trajectory.quat_wxyz), knots, _DEGREE)
        return cls(int(trajectory.t_ns[0]), float(t[-1]), position, quaternion)

    def trajectory(self, t_ns: Times) -> Trajectory:
        """Return poses and velocities at times (M,) [ns] within the motion.

        Raises:
            ConfigError: A time is outside the motion.
        """
        t = self._seconds(t_ns)
        quat = self.quaternion(t)
        quat = quat / np.linalg.norm(quat, axis=1, keepdims=True)
        return Trajectory(t_ns, self.position(t), quat, velocity_m_s=self.position(t, 1))

    def angular_velocity_rad_s(self, t_ns: Times) -> Array:
        """Return (M, 3) angular velocities in the moving frame [rad/s]: twice the vector part of q⁻¹ q̇."""
        t = self._seconds(t_ns)
        q, dq = self.quaternion(t), self.quaternion(t, 1)
        _, *vector = product(conjugate(components(q)), components(dq))
        return np.asarray(2.0 * np.stack(vector, axis=-1) / np.sum(q * q, axis=1, keepdims=True))

    def points(self, t_ns: Times) -> ImuSamples:
        """Return the samples of a noise-free IMU in the moving frame at times (M,) [ns]."""
        t = self._seconds(t_ns)
        R = matrix_from_quat_wxyz(self.trajectory(t_ns).quat_wxyz)
        force = np.einsum("nji,nj->ni", R, self.position(t, 2) + GRAVITY_M_S2 * _UP)
        return ImuSamples(t_ns, self.angular_velocity_rad_s(t_ns), force, "point")

    def increments(self, t_ns: Times) -> ImuSamples:
        """Return the increments of a noise-free IMU over the M − 1 intervals between times (M,) [ns]."""
        motion = self.trajectory(t_ns)
        assert motion.velocity_m_s is not None
        R = motion.rotations
        dt_s = np.diff(t_ns)[:, None] * 1e-9
        turn = log_so3(np.swapaxes(R[:-1], 1, 2) @ R[1:])
        gained = np.diff(motion.velocity_m_s, axis=0) / dt_s + GRAVITY_M_S2 * _UP
        return ImuSamples(t_ns[1:], turn / dt_s, np.einsum("nji,nj->ni", R[:-1], gained), "increment")

    def _seconds(self, t_ns: Times) -> Array:
        """Return times (M,) of the splines [s], or raise ConfigError outside the motion."""
        t = np.asarray((t_ns - self.origin_ns) * 1e-9)
        if len(t) and (t.min() < -1e-9 or t.max() > self.end_s + 1e-9):
            raise ConfigError(
                f"motion asked for {t.min():.3f} to {t.max():.3f} s after its start; expected 0 to {self.end_s:.3f} s"
            )
        return t


def _continuous(quat_wxyz: Array) -> Array:
    """Return the quaternions (N, 4) with signs such that consecutive ones have a non-negative scalar product."""
    same_side = np.sum(quat_wxyz[1:] * quat_wxyz[:-1], axis=1) >= 0.0
    signs = np.cumprod(np.concatenate([[1.0], np.where(same_side, 1.0, -1.0)]))
    return np.asarray(quat_wxyz * signs[:, None])


def _knots(t: Array, interval_s: float) -> Array:
    """Return the knots for times (N,) [s], about ``interval_s`` apart but not closer than the poses."""
    spans = int(max(1, min(round((t[-1] - t[0]) / interval_s), len(t) - _DEGREE - 1)))
    every = np.linspace(0, len(t) - 1, spans + 1)[1:-1]  # by number of poses, so that every knot is supported
    inner = np.interp(every, np.arange(len(t)), t)
    return np.concatenate([np.full(_DEGREE + 1, t[0]), inner, np.full(_DEGREE + 1, t[-1])])
