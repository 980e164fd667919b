"""The start from rest: gravity gives roll and pitch, the gyroscope's mean its bias. And how sure a start is."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.estimator.imu.buffer import Increments
from dronevio.estimator.types import GAUGE_SIGMA
from dronevio.models.rotation import pose_matrix
from dronevio.models.state import NavState

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class NotObservable:
    """The answer where a start cannot be told yet."""

    reason: str
    """Why, for people."""

    def __str__(self) -> str:
        return f"not observable yet: {self.reason}"


@dataclass(frozen=True)
class InitialSigmas:
    """How sure a start is of its state: standard deviations."""

    tilt_rad: float = 0.1
    """Roll and pitch [rad]; at rest, the accelerometer's bias hides in them."""
    velocity_m_s: float = 0.05
    """Velocity [m/s]."""
    gyro_bias_rad_s: float = 0.005
    """Gyroscope bias [rad/s]."""
    accel_bias_m_s2: float = 0.1
    """Accelerometer bias [m/s²]."""

    def covariance(self, R_world_imu: Array) -> Array:
        """Return the covariance (15, 15), in the order of `NavState`, for an orientation (3, 3)."""
        tilt, gauge = self.tilt_rad**2, GAUGE_SIGMA**2
        P = np.zeros((15, 15))
        P[:3, :3] = R_world_imu.T @ np.diag([tilt, tilt, gauge]) @ R_world_imu
        variances = [gauge, self.velocity_m_s**2, self.gyro_bias_rad_s**2, self.accel_bias_m_s2**2]
        P[3:, 3:] = np.diag(np.repeat(variances, 3))
        return P


def initialize_static(t_ns: int, rest: Sequence[Increments]) -> NavState:
    """Return the state of an IMU that stands still, as the origin of position and yaw.

    The accelerometer's bias cannot be told from tilt at rest; it is taken as zero, and the smoother sorts it out later.

    Args:
        t_ns: Time of the state.
        rest: IMU increments of the rest, at least one.
    """
    dt_s = np.concatenate([r.dt_s for r in rest])[:, None]
    accel = np.concatenate([r.accel_m_s2 for r in rest])
    up_imu = (accel * dt_s).sum(axis=0)
    return NavState(
        t_ns,
        pose_matrix(level_rotation(up_imu), np.zeros(3)),
        np.zeros(3),
        mean_gyro(rest),
        np.zeros(3),
    )


def mean_gyro(rest: Sequence[Increments]) -> Array:
    """Return the mean angular velocity (3,) over increments [rad/s]: at rest, the gyroscope's bias."""
    dt_s = np.concatenate([r.dt_s for r in rest])
    gyro = np.concatenate([r.gyro_rad_s for r in rest])
    return np.asarray(dt_s @ gyro / dt_s.sum())


def level_rotation(up_imu: Array) -> Array:
    """Return R_world_imu (3, 3) with the world's z axis along ``up_imu`` (3,).

    Yaw is free: the world's x axis is that IMU axis which lies flattest, seen from above.
    """
    z = up_imu / np.linalg.norm(up_imu)
    flattest = np.eye(3)[int(np.argmin(np.abs(z)))]
    x = flattest - z * (z @ flattest)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])
