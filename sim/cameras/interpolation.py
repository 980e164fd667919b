"""Interpolation of poses between the time stamps of a trajectory."""

from collections.abc import Callable

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.imu import Times
from dronevio.models.quaternions import slerp_quat_wxyz
from dronevio.models.rig import RigCamera
from dronevio.models.rotation import matrix_from_quat_wxyz, pose_matrix
from dronevio.models.state import Trajectory


def camera_poses(trajectory: Trajectory, camera: RigCamera) -> Callable[[Times], Array]:
    """Return the poses T_world_cam (M, 4, 4) of a camera as a function of the times (M,) of frames [ns].

    A camera with a time offset of its own is later in its motion by it.

    Args:
        trajectory: Trajectory of the IMU.
        camera: The camera.
    """
    offset_ns = round(1e9 * camera.time_offset_s)

    def poses_at(t_ns: Times) -> Array:
        return np.asarray(interpolated_poses(trajectory, t_ns + offset_ns) @ camera.T_imu_cam)

    return poses_at


def interpolated_poses(trajectory: Trajectory, t_ns: Times) -> Array:
    """Return poses (M, 4, 4) at times (M,) [ns]: linear in position, spherical linear (slerp) in rotation.

    For an interval h and an acceleration a, the position error is at most a h² / 8: 31 µm at 10 m/s² and 200 Hz.
    Outside the trajectory, the motion of the nearest interval is extrapolated.
    """
    after = np.clip(np.searchsorted(trajectory.t_ns, t_ns, side="right"), 1, len(trajectory) - 1)
    start, end = trajectory.t_ns[after - 1], trajectory.t_ns[after]
    fraction = (t_ns - start) / (end - start)
    p0, p1 = trajectory.p_world_imu[after - 1], trajectory.p_world_imu[after]
    quat = slerp_quat_wxyz(trajectory.quat_wxyz[after - 1], trajectory.quat_wxyz[after], fraction)
    return pose_matrix(matrix_from_quat_wxyz(quat), p0 + fraction[:, None] * (p1 - p0))
