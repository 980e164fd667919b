"""The map frame: yaw and position of a map, which no measurement determines.

Bundle adjustment moves all poses of a map, also those that were published before. The map frame is chosen such that it
moves them as little as possible. Were the first keyframe held instead, the error of the odometry in its first seconds
would move the place where the drone is.
"""

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from dronevio.models.rotation import rotation_z, yaw_rad_from_matrix

Array = npt.NDArray[np.float64]

LEVER_M = 1.0
"""Distance from each keyframe of the points on its axes that are aligned as well as its position [m], so that yaw is
determined without motion, too."""


def aligned_with(poses: Mapping[int, Array], reference: Mapping[int, Array]) -> dict[int, Array]:
    """Return poses, rotated about the vertical and translated such that they are nearest to those of a reference.

    Nearest are, by least squares, the origins and the points one metre along the axes of the poses in both.

    Args:
        poses: Poses (4, 4) by the numbers of keyframes.
        reference: Poses (4, 4) by numbers; those without a counterpart are not used.
    """
    common = sorted(poses.keys() & reference.keys())
    if not common:
        return dict(poses)
    old, new = (np.stack([source[number] for number in common]) for source in (reference, poses))
    old_points, new_points = (_points(T) for T in (old, new))
    old_mean, new_mean = old_points.mean(axis=0), new_points.mean(axis=0)
    T = np.eye(4)
    T[:3, :3] = rotation_z(yaw_rad_from_matrix((old_points - old_mean).T @ (new_points - new_mean)))
    T[:3, 3] = old_mean - T[:3, :3] @ new_mean
    return {number: T @ pose for number, pose in poses.items()}


def _points(T: Array) -> Array:
    """Return the origins and the points on the axes of poses (K, 4, 4), together (4 K, 3)."""
    origin = T[:, None, :3, 3]
    return np.concatenate([origin, origin + LEVER_M * np.swapaxes(T[:, :3, :3], 1, 2)], axis=1).reshape(-1, 3)
