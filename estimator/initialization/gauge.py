"""Where a start puts position and yaw, which nothing observes: at zero, or where the drone was when it was lost."""

from dataclasses import replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from dronevio.estimator.imu.buffer import Increments
from dronevio.estimator.initialization.static import InitialSigmas
from dronevio.models.rotation import pose_matrix, rotation_z, yaw_rad_from_matrix
from dronevio.models.state import NavState

Array = npt.NDArray[np.float64]

LEAST_SPEED_M_S = 1.0
"""While nothing is known of where it goes, a drone may be at least so fast [m/s]: one that hovered may have left."""
GYRO_BIAS_SIGMA_RAD_S = 0.003
"""How well the gyroscope's bias is known after a flight [rad/s]."""


class Origin(Protocol):
    """Gives a start its position and yaw."""

    def turn(self, increments: Increments) -> None:
        """Take the IMU since the last call."""

    def place(self, start: NavState, since: Increments) -> NavState:
        """Return a start, moved to where it belongs.

        Args:
            start: A state at any position and of any yaw.
            since: The IMU between it and what `turn` took last.
        """

    def covariance(self, start: NavState, sigmas: InitialSigmas) -> Array:
        """Return how sure a placed start is: a covariance (15, 15) in the order of `NavState`."""


class Zero:
    """The first start is where the world begins."""

    def turn(self, increments: Increments) -> None:
        """Take the IMU since the last call, for nothing."""

    def place(self, start: NavState, since: Increments) -> NavState:
        """Return a start as it is."""
        return start

    def covariance(self, start: NavState, sigmas: InitialSigmas) -> Array:
        """Return how sure a start is; of position and yaw it is by definition."""
        return sigmas.covariance(start.T_world_imu[:3, :3])


class LastBelieved:
    """After a loss, the odometry goes on from the last pose that was believed, turned by what the gyroscope says.

    What the drone flew while it was lost is missing from the position: nothing knows it, and the covariance says so.
    """

    def __init__(self, believed: NavState) -> None:
        self._believed = believed
        self._R_world_imu = believed.T_world_imu[:3, :3]
        self._doubt_rad2 = 0.0  # variance of what a gyroscope at its limit has not told of the turn since

    def turn(self, increments: Increments) -> None:
        """Take the IMU since the last call."""
        self._R_world_imu = self._R_world_imu @ increments.rotation(self._believed.gyro_bias_rad_s)
        self._doubt_rad2 += float((increments.dt_s @ increments.excess_density[:, :3]).max())

    def place(self, start: NavState, since: Increments) -> NavState:
        """Return a start at the last position, and of the yaw that makes its end that of the gyroscope."""
        R_start = start.T_world_imu[:3, :3]
        error = self._R_world_imu @ (R_start @ since.rotation(start.gyro_bias_rad_s)).T
        turned = rotation_z(yaw_rad_from_matrix(error))
        pose = pose_matrix(turned @ R_start, self._believed.T_world_imu[:3, 3])
        return replace(start, T_world_imu=pose, velocity_m_s=turned @ start.velocity_m_s)

    def covariance(self, start: NavState, sigmas: InitialSigmas) -> Array:
        """Return how sure a placed start is."""
        R, believed = start.T_world_imu[:3, :3], self._believed
        lost_s = (start.t_ns - believed.t_ns) * 1e-9
        away_m = lost_s * max(float(np.linalg.norm(believed.velocity_m_s)), LEAST_SPEED_M_S)
        P = sigmas.covariance(R)
        known = believed.covariance if believed.covariance is not None else np.zeros((15, 15))
        P[3:6, 3:6] += known[3:6, 3:6] + away_m**2 * np.eye(3)
        up_then, up = believed.T_world_imu[2, :3], R[2]
        yaw_variance = up_then @ known[:3, :3] @ up_then + (GYRO_BIAS_SIGMA_RAD_S * lost_s) ** 2 + self._doubt_rad2
        P[:3, :3] += yaw_variance * np.outer(up, up)
        return P
