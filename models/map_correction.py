"""Correction of a trajectory of the odometry by the poses of the keyframes in the map."""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from dronevio.models.rotation import exp_so3, log_so3, pose_matrix, quat_wxyz_from_matrix
from dronevio.models.state import Trajectory

Array = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class MapCorrection:
    """The pose of the odometry frame in the map frame over time, known at the keyframes of the map."""

    t_ns: Times
    """(K,) Times of the keyframes by the clock of the trajectory, strictly increasing [ns]."""
    Ts_map_odom: Array
    """(K, 4, 4) Poses of the odometry frame in the map frame at the keyframes."""

    def at(self, t_ns: Times) -> Array:
        """Return the poses (N, 4, 4) of the odometry frame in the map frame at times (N,) [ns].

        Between keyframes, position and rotation are interpolated; before the first and after the last one, the
        correction is constant.
        """
        if len(self.t_ns) == 1:
            return np.tile(self.Ts_map_odom, (len(t_ns), 1, 1))
        after = np.clip(np.searchsorted(self.t_ns, t_ns), 1, len(self.t_ns) - 1)
        before = after - 1
        length = (self.t_ns[after] - self.t_ns[before]).astype(np.float64)
        ratio = np.clip((t_ns - self.t_ns[before]) / length, 0.0, 1.0)[:, None]
        T0, T1 = self.Ts_map_odom[before], self.Ts_map_odom[after]
        turn = log_so3(np.swapaxes(T0[:, :3, :3], 1, 2) @ T1[:, :3, :3])
        R = T0[:, :3, :3] @ exp_so3(ratio * turn)
        return pose_matrix(R, (1.0 - ratio) * T0[:, :3, 3] + ratio * T1[:, :3, 3])

    def applied(self, trajectory: Trajectory) -> Trajectory:
        """Return a trajectory of the odometry in the map frame.

        Velocities and covariances, which belong to the odometry frame, are left out.
        """
        Ts = self.at(trajectory.t_ns) @ trajectory.Ts_world_imu
        return replace(
            trajectory,
            p_world_imu=Ts[:, :3, 3],
            quat_wxyz=quat_wxyz_from_matrix(Ts[:, :3, :3]),
            velocity_m_s=None,
            covariance=None,
        )
