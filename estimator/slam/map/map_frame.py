"""The map frame: yaw and position of a map, which no measurement determines.

An optimization moves all poses of a map, also those that were published before. The map frame is chosen such that it
moves them as little as possible. Were the first keyframe held instead, the drift of the odometry since then would be an
offset between what was published before and after a loop is closed or the map is adjusted.
"""

from collections.abc import Mapping

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.rotation import inverse_pose, log_so3, rotation_z, yaw_rad_from_matrix

LEVER_M = 1.0
"""Distance from each keyframe of the points on its axes that are aligned as well as its position [m], so that yaw is
determined without motion, too."""


def frame_change(poses: Mapping[int, Array], reference: Mapping[int, Array]) -> Array:
    """Return the rotation about the vertical and translation (4, 4) that move poses as near as possible to a reference.

    Nearest are, by least squares, the origins and the points one metre along the axes of the poses in both.

    Args:
        poses: Poses (4, 4) by the numbers of keyframes.
        reference: Poses (4, 4) by numbers; those without a counterpart are not used. Without any, nothing is moved.
    """
    common, T = sorted(poses.keys() & reference.keys()), np.eye(4)
    if not common:
        return T
    old, new = (_points(np.stack([source[number] for number in common])) for source in (reference, poses))
    old_mean, new_mean = old.mean(axis=0), new.mean(axis=0)
    T[:3, :3] = rotation_z(yaw_rad_from_matrix((old - old_mean).T @ (new - new_mean)))
    T[:3, 3] = old_mean - T[:3, :3] @ new_mean
    return T


def with_frame_offset(covariance: Array, T_map_imu: Array, T_map_first: Array) -> Array:
    """Return the covariance of a pose where yaw and position of the first pose are known, with the offset of the map.

    The pose in the map differs by a known transformation from that in the frame of the first pose. The second moment of
    the error is the covariance, plus the outer product of this offset.

    Args:
        covariance: (6, 6) Covariance in the frame of the first pose: δθ, then δp, both in the IMU frame.
        T_map_imu: (4, 4) The pose in the map.
        T_map_first: (4, 4) Pose of the frame of the first pose in the map.
    """
    step = inverse_pose(T_map_imu) @ inverse_pose(T_map_first) @ T_map_imu
    offset = np.concatenate([log_so3(step[:3, :3]), step[:3, 3]])
    return np.asarray(covariance + np.outer(offset, offset))


def _points(T: Array) -> Array:
    """Return the origins and the points on the axes of poses (K, 4, 4), together (4 K, 3)."""
    origin = T[:, None, :3, 3]
    return np.concatenate([origin, origin + LEVER_M * np.swapaxes(T[:, :3, :3], 1, 2)], axis=1).reshape(-1, 3)
