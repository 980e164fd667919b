"""The gauge of an initialization: position and yaw, which are not observable, and what is known of the biases.

The first initialization is at the origin. After a loss, the odometry continues from the last published pose.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from dronevio.estimator.imu.buffer import NO_INCREMENTS, Increments
from dronevio.estimator.initialization.static import InitialSigmas
from dronevio.models.arrays import Array
from dronevio.models.rotation import pose_matrix, rotation_z, yaw_rad_from_matrix
from dronevio.models.state import NavState

MIN_SPEED_M_S = 1.0
"""Lower bound of the speed at which the position uncertainty grows after a loss [m/s]: a hovering vehicle may have
accelerated since."""
GYRO_BIAS_SIGMA_RAD_S = 0.003
"""Standard deviation of the gyroscope bias after a flight [rad/s]."""
MIN_ACCEL_BIAS_SIGMA_M_S2 = 0.03
"""Smallest standard deviation of the accelerometer bias after a flight [m/s²]."""


@dataclass(frozen=True, eq=False)
class BiasPrior:
    """What is known of a bias of the IMU."""

    mean: Array
    """(3,) Expected value, in the unit of the sensor."""
    sigma: float
    """Standard deviation on each axis, in the same unit."""


class Gauge(Protocol):
    """Determines position and yaw of an initial state."""

    @property
    def gyro_bias(self) -> BiasPrior:
        """What is known of the gyroscope bias before the initialization [rad/s]."""

    @property
    def accel_bias(self) -> BiasPrior:
        """What is known of the accelerometer bias before the initialization [m/s²]."""

    def propagated(self, increments: Increments) -> "Gauge":
        """Return the gauge after the IMU increments since the last call."""

    def align(self, start: NavState, since: Increments) -> NavState:
        """Return an initial state with the gauge's position and yaw.

        Args:
            start: A state of arbitrary position and yaw.
            since: The IMU increments from it to the end of those that the gauge was propagated over.
        """

    def covariance(self, start: NavState, sigmas: InitialSigmas) -> Array:
        """Return the covariance (15, 15) of an aligned state, in the order of `NavState`."""


@dataclass(frozen=True, eq=False)
class WorldOrigin:
    """The gauge of the first initialization: the initial state defines the world frame."""

    gyro_bias_sigma_rad_s: float
    """Standard deviation of a gyroscope bias of which nothing is known yet [rad/s]."""
    accel_bias_sigma_m_s2: float
    """Standard deviation of such an accelerometer bias [m/s²]."""

    @property
    def gyro_bias(self) -> BiasPrior:
        """The gyroscope bias before it is estimated: zero."""
        return BiasPrior(np.zeros(3), self.gyro_bias_sigma_rad_s)

    @property
    def accel_bias(self) -> BiasPrior:
        """The accelerometer bias before it is estimated: zero."""
        return BiasPrior(np.zeros(3), self.accel_bias_sigma_m_s2)

    def propagated(self, increments: Increments) -> "WorldOrigin":
        """Return the gauge unchanged."""
        return self

    def align(self, start: NavState, since: Increments) -> NavState:
        """Return the initial state unchanged."""
        return start

    def covariance(self, start: NavState, sigmas: InitialSigmas) -> Array:
        """Return the covariance (15, 15) of an initial state; position and yaw are known by definition."""
        return sigmas.covariance(start.T_world_imu[:3, :3])


@dataclass(frozen=True, eq=False)
class LastPublished:
    """The gauge after a loss: the last published pose, rotated by the gyroscope since.

    The distance flown while lost is missing from the position. It is unknown, and the covariance accounts for it.
    """

    published: NavState
    """The last published state."""
    R_world_before: Array
    """(3, 3) The published orientation, propagated by the gyroscope up to the last increments."""
    variance_before_rad2: float = 0.0
    """Variance of the rotation up to there, due to saturation and gaps of the gyroscope [rad²]."""
    increments: Increments = NO_INCREMENTS
    """The last increments. They are integrated when this is used: while nothing is lost, the next state replaces it."""

    @classmethod
    def of(cls, published: NavState) -> "LastPublished":
        """Return the gauge at a published state."""
        return cls(published, published.T_world_imu[:3, :3])

    @property
    def gyro_bias(self) -> BiasPrior:
        """The published gyroscope bias [rad/s]."""
        return BiasPrior(self.published.gyro_bias_rad_s, GYRO_BIAS_SIGMA_RAD_S)

    @property
    def accel_bias(self) -> BiasPrior:
        """The published accelerometer bias [m/s²], with the standard deviation along the axis that is known least."""
        P = self.published.covariance
        variance = 0.0 if P is None else float(np.linalg.eigvalsh(P[12:, 12:])[-1])
        return BiasPrior(self.published.accel_bias_m_s2, max(MIN_ACCEL_BIAS_SIGMA_M_S2, float(np.sqrt(variance))))

    def propagated(self, increments: Increments) -> "LastPublished":
        """Return the gauge after the IMU increments since the last call."""
        return LastPublished(self.published, self.R_world_imu, self.excess_variance_rad2, increments)

    @cached_property
    def R_world_imu(self) -> Array:
        """(3, 3) The published orientation, propagated by the gyroscope."""
        if not len(self.increments.dt_s):
            return self.R_world_before
        return self.R_world_before @ self.increments.rotation(self.published.gyro_bias_rad_s)

    @property
    def excess_variance_rad2(self) -> float:
        """Variance of the rotation since, due to saturation and gaps of the gyroscope [rad²]."""
        variance, increments = self.variance_before_rad2, self.increments
        if increments.is_degraded:
            variance += float((increments.dt_s @ increments.excess_density[:, :3]).max())
        return variance

    def align(self, start: NavState, since: Increments) -> NavState:
        """Return an initial state at the last position, with the yaw that agrees with the gyroscope at its end."""
        R_start = start.T_world_imu[:3, :3]
        error = self.R_world_imu @ (R_start @ since.rotation(start.gyro_bias_rad_s)).T
        R_yaw = rotation_z(yaw_rad_from_matrix(error))
        pose = pose_matrix(R_yaw @ R_start, self.published.T_world_imu[:3, 3])
        return replace(start, T_world_imu=pose, velocity_m_s=R_yaw @ start.velocity_m_s)

    def covariance(self, start: NavState, sigmas: InitialSigmas) -> Array:
        """Return the covariance (15, 15) of an aligned state."""
        R, published = start.T_world_imu[:3, :3], self.published
        lost_s = (start.t_ns - published.t_ns) * 1e-9
        distance_m = lost_s * max(float(np.linalg.norm(published.velocity_m_s)), MIN_SPEED_M_S)
        P = sigmas.covariance(R)
        known = published.covariance if published.covariance is not None else np.zeros((15, 15))
        P[3:6, 3:6] += known[3:6, 3:6] + distance_m**2 * np.eye(3)
        up_then, up = published.T_world_imu[2, :3], R[2]
        yaw_variance = (
            up_then @ known[:3, :3] @ up_then + (GYRO_BIAS_SIGMA_RAD_S * lost_s) ** 2 + self.excess_variance_rad2
        )
        P[:3, :3] += yaw_variance * np.outer(up, up)
        return P
