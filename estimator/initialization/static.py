"""Static initialization: gravity determines roll and pitch, and the mean of the gyroscope its bias."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from dronevio.estimator.imu.buffer import Increments
from dronevio.estimator.types import GAUGE_SIGMA
from dronevio.models.arrays import Array
from dronevio.models.ranges import Range, Settings
from dronevio.models.rotation import pose_matrix
from dronevio.models.state import NavState


@dataclass(frozen=True)
class InitialSigmas(Settings):
    """Standard deviations of an initial state."""

    tilt_rad: Annotated[float, Range(1e-6, 10.0)] = 0.1
    """Standard deviation of roll and pitch [rad]; a static initialization attributes the accelerometer bias to them."""
    velocity_m_s: Annotated[float, Range(1e-6, 100.0)] = 0.05
    """Standard deviation of the velocity [m/s]."""
    gyro_bias_rad_s: Annotated[float, Range(1e-6, 10.0)] = 0.005
    """Standard deviation of the gyroscope bias [rad/s]."""
    accel_bias_m_s2: Annotated[float, Range(1e-6, 100.0)] = 0.1
    """Standard deviation of the accelerometer bias [m/s²]."""

    def covariance(self, R_world_imu: Array) -> Array:
        """Return the covariance (15, 15), in the order of `NavState`, for an orientation (3, 3)."""
        tilt, gauge = self.tilt_rad**2, GAUGE_SIGMA**2
        P = np.zeros((15, 15))
        P[:3, :3] = R_world_imu.T @ np.diag([tilt, tilt, gauge]) @ R_world_imu
        variances = [gauge, self.velocity_m_s**2, self.gyro_bias_rad_s**2, self.accel_bias_m_s2**2]
        P[3:, 3:] = np.diag(np.repeat(variances, 3))
        return P


def initialize_static(t_ns: int, stationary: Sequence[Increments]) -> NavState:
    """Return the state of a stationary IMU, at the origin of position and yaw.

    The accelerometer bias is not observable apart from tilt while stationary. It is taken as zero and estimated by the
    smoother later.

    Args:
        t_ns: Time of the state [ns].
        stationary: IMU increments of the stationary interval, at least one.
    """
    dt_s = np.concatenate([part.dt_s for part in stationary])[:, None]
    accel = np.concatenate([part.accel_m_s2 for part in stationary])
    up_imu = (accel * dt_s).sum(axis=0)
    pose = pose_matrix(level_rotation(up_imu), np.zeros(3))
    return NavState(t_ns, pose, np.zeros(3), mean_angular_velocity(stationary), np.zeros(3))


def mean_angular_velocity(increments: Sequence[Increments]) -> Array:
    """Return the mean angular velocity (3,) over increments [rad/s]: the gyroscope bias while stationary."""
    dt_s = np.concatenate([part.dt_s for part in increments])
    gyro = np.concatenate([part.gyro_rad_s for part in increments])
    return np.asarray(dt_s @ gyro / dt_s.sum())


def level_rotation(up_imu: Array) -> Array:
    """Return R_world_imu (3, 3) with the world's z axis along ``up_imu`` (3,).

    Yaw is arbitrary: the world's x axis is the horizontal projection of the IMU axis that is closest to horizontal.
    """
    z = up_imu / np.linalg.norm(up_imu)
    most_horizontal = np.eye(3)[int(np.argmin(np.abs(z)))]
    x = most_horizontal - z * (z @ most_horizontal)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])
