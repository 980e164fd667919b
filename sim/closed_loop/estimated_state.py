"""The estimated state in the world of the simulator, for controllers that fly on the output of an estimator.

The frame of an odometry starts where the estimator does: its z axis is vertical, its yaw and origin are arbitrary. A
vehicle that starts on a landing pad knows where the pad is, so that the planned pose on the pad determines the four
unknown degrees of freedom at the first state. The true state is not used.
"""

from dataclasses import replace

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.protocols import Estimator
from dronevio.models.rotation import pose_matrix, rotation_z, yaw_rad_from_matrix
from dronevio.models.state import NavState


def world_from_odometry(T_world_imu: Array, T_odom_imu: Array) -> Array:
    """Return the pose T_world_odom (4, 4) of a gravity-aligned odometry frame: a rotation about z and a translation.

    Args:
        T_world_imu: (4, 4) Known pose of the IMU in the world.
        T_odom_imu: (4, 4) Its estimate at the same time. Roll and pitch may differ; the yaw of the result minimizes the
            rotation between the two.
    """
    R_world_odom = rotation_z(yaw_rad_from_matrix(T_world_imu[:3, :3] @ T_odom_imu[:3, :3].T))
    return np.asarray(pose_matrix(R_world_odom, T_world_imu[:3, 3] - R_world_odom @ T_odom_imu[:3, 3]))


def transformed(T_world_odom: Array, state: NavState) -> NavState:
    """Return a state of the odometry frame in the world, without its covariance."""
    R = T_world_odom[:3, :3]
    return replace(
        state, T_world_imu=T_world_odom @ state.T_world_imu, velocity_m_s=R @ state.velocity_m_s, covariance=None
    )


class EstimatedState:
    """State of a vehicle in the world, as an estimator knows it."""

    def __init__(self, estimator: Estimator, T_world_imu: Array | None = None) -> None:
        """Begin before the first measurement.

        Args:
            estimator: The estimator, which receives its measurements elsewhere.
            T_world_imu: (4, 4) Known pose of the IMU at the first state, such as that of the landing pad; if there is
                none, `start_at` has to be called.
        """
        self._estimator, self._T_world_imu = estimator, T_world_imu
        self._T_world_odom: Array | None = None

    @property
    def T_world_odom(self) -> Array | None:
        """(4, 4) Pose of the odometry frame in the world, constant from the first state on; None before."""
        return self._T_world_odom

    def at(self, t_ns: int) -> NavState | None:
        """Return the estimated state of the IMU in the world at its last sample not after a time [ns].

        Returns:
            The state with its angular velocity; None before the first state, and while no pose places it in the world.
        """
        state = self._estimator.state_at(t_ns)
        if state is None or self._T_world_imu is None:
            return None
        if self._T_world_odom is None:
            self._T_world_odom = world_from_odometry(self._T_world_imu, state.T_world_imu)
        return transformed(self._T_world_odom, state)

    def start_at(self, T_world_imu: Array) -> None:
        """Set the pose (4, 4) of the IMU that belongs to the first state, if there has been none yet."""
        self._T_world_imu = T_world_imu
