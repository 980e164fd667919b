"""The scale of the odometry for an adjusted map, where one camera and the IMU do not determine a better one.

The relative poses of the odometry hold the scale of each part of the map, and IMU factors over a second still pull at
it. The path of the odometry as a whole is little affected by the errors of its parts: the map is scaled such that its
keyframes fit it best.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence

import numpy as np

from dronevio.estimator.slam.adjustment.bundle_adjustment import AdjustmentInputs, AdjustmentKeyframe
from dronevio.estimator.slam.map.map_frame import frame_change
from dronevio.models.arrays import Array

MIN_SIZE_M = 1.0
"""Smallest RMS distance of the keyframes of a track from their mean position at which they determine the scale [m]."""


def with_scale_of_odometry(inputs: AdjustmentInputs, poses: Mapping[int, Array]) -> Mapping[int, Array]:
    """Return an adjusted map with the scale of the odometry; its first keyframe stays.

    A map that contains a loaded one has the scale of that one, and stays.

    Args:
        inputs: The measurements of the map.
        poses: Adjusted poses (4, 4) of its keyframes by their numbers.
    """
    if inputs.saved is not None:
        return poses
    scale = odometry_scale(inputs.keyframes, poses)
    origin, scaled = poses[inputs.first][:3, 3], {number: T.copy() for number, T in poses.items()}
    for T in scaled.values():
        T[:3, 3] = origin + scale * (T[:3, 3] - origin)
    return scaled


def odometry_scale(keyframes: Sequence[AdjustmentKeyframe], poses: Mapping[int, Array]) -> float:
    """Return the factor by which the lengths of a map are those of the odometry; 1 where no track is large enough.

    It is the regression of the positions by the odometry, which drift, on those of the map, after an alignment of yaw
    and position for each track.

    Args:
        keyframes: Keyframes of the map.
        poses: Their poses (4, 4) in the map by their numbers.
    """
    tracks: dict[int, dict[int, Array]] = defaultdict(dict)
    for keyframe in keyframes:
        tracks[keyframe.track][keyframe.number] = keyframe.estimate.T_odom_imu
    products, squares = 0.0, 0.0
    for odometry in tracks.values():
        T_odom_map = frame_change({number: poses[number] for number in odometry}, odometry)
        p_map, p_odom = (
            np.array([T[:3, 3] for T in path])
            for path in ([T_odom_map @ poses[number] for number in odometry], odometry.values())
        )
        p_map, p_odom = p_map - p_map.mean(axis=0), p_odom - p_odom.mean(axis=0)
        if np.sum(p_map**2) >= len(p_map) * MIN_SIZE_M**2:
            products, squares = products + float(np.sum(p_map * p_odom)), squares + float(np.sum(p_map**2))
    return products / squares if squares else 1.0
