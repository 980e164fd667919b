"""The pose graph of a final map for other programs: odometry and loops as the final map measures them.

During a flight, edges of the odometry and loops are measurements of different times: the odometry when a keyframe left
the window, a loop by the landmarks and the scale estimated at that time. Bundle adjustment uses all images and IMU
samples anew, and its poses agree with neither. Here, both are measured again in the adjusted map: the odometry at the
final poses, with the covariances that it stated, and a loop by its own observations of the final landmarks.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from dronevio.estimator.slam.adjustment.bundle_adjustment import (
    AdjustmentConfig,
    AdjustmentInputs,
    map_observations,
    triangulated,
)
from dronevio.estimator.slam.map.odometry_factors import RelativePose
from dronevio.estimator.slam.map.pose_graph import ADJUSTED_VARIANCE, PoseGraph, optimize
from dronevio.estimator.slam.places.matching import Correspondences
from dronevio.estimator.slam.places.relative_pose import RelativePoseConfig, Views, refine
from dronevio.models.arrays import Array
from dronevio.models.rotation import inverse_pose

MIN_OBSERVATIONS = 6
"""Smallest number of observations of final landmarks by which a loop is measured again."""
GAUGE_VARIANCE = 1e-12
"""Variance of the pose of the first keyframe [rad²] and [m²]: other programs keep it fixed."""


def measured_in_map(
    graph: PoseGraph,
    inputs: AdjustmentInputs,
    adjustment: AdjustmentConfig,
    pose: RelativePoseConfig,
    adjusted_until: int = -1,
) -> PoseGraph:
    """Return a pose graph whose odometry and loops are measured in the final map.

    Args:
        graph: The graph, with the final poses and without rejected loops.
        inputs: The measurements of the same keyframes and loops, with the same poses.
        adjustment: Settings of the landmarks.
        pose: Assumed errors of a loop, but for the standard deviations of its observations.
        adjusted_until: Number of the keyframe up to which bundle adjustment during the flight has made the covariances
            of the odometry smaller, see `remeasured`.
    """
    _, landmarks = triangulated(map_observations(inputs, adjustment), inputs, adjustment)

    saved = {} if inputs.saved is None else inputs.saved.graph.poses

    def at_poses(relative: RelativePose) -> RelativePose:
        T = inverse_pose(graph.poses[relative.first]) @ graph.poses[relative.second]
        is_smaller = relative.second <= adjusted_until and relative.second not in saved
        stated = relative.covariance / (ADJUSTED_VARIANCE if is_smaller else 1.0)
        return replace(relative, T_first_second=T, covariance=stated)

    rig = inputs.calibration.Ts_imu_cam, inputs.calibration.focal_px
    loops = tuple(_by_landmarks(loop, graph.poses, landmarks, rig, pose) for loop in graph.loops)
    return replace(graph, odometry=tuple(at_poses(each) for each in graph.odometry), loops=loops)


def at_optimum(graph: PoseGraph) -> PoseGraph:
    """Return a pose graph at the optimum of its relative poses alone, where the first keyframe stays where it is.

    Directions of gravity, priors on positions and fixed keyframes are left out, as in other programs.
    """
    gauge = GAUGE_VARIANCE * np.eye(6)
    relative = replace(graph, first_covariance=gauge, gravity=(), positions=(), fixed=())
    return optimize(relative, robust=False).graph


def _by_landmarks(
    loop: RelativePose,
    poses: Mapping[int, Array],
    landmarks: Mapping[int, Array],
    rig: tuple[Array, Array],
    config: RelativePoseConfig,
) -> RelativePose:
    """Return a loop by its observations of the final landmarks; as it is, if they do not determine it.

    Args:
        loop: The loop.
        poses: Final poses (4, 4) of the keyframes by their numbers.
        landmarks: Final positions (3,) of the landmarks by their identities [m].
        rig: Poses (C, 4, 4) of the cameras in the IMU frame, and their focal lengths (C,) [px].
        config: Assumed errors.
    """
    table = loop.observations
    table = table[np.array([identity in landmarks for identity in table.landmark.tolist()], dtype=np.bool_)]
    if len(table) < MIN_OBSERVATIONS:
        return loop
    T_first, T_second = poses[loop.first], poses[loop.second]
    positions = np.stack([landmarks[identity] for identity in table.landmark.tolist()])
    is_old = table.keyframe == loop.second  # landmarks of the first keyframe, which the second one sees

    def seen(rows: npt.NDArray[np.bool_], T_map_owner: Array) -> Correspondences:
        points = (positions[rows] - T_map_owner[:3, 3]) @ T_map_owner[:3, :3]
        return Correspondences(table.landmark[rows], points, table.camera[rows], table.xy[rows], table.camera[rows])

    config = replace(config, pixel_sigma=float(np.median(table.sigma_scale)))
    views = Views(*rig, T_first[:3, :3], T_second[:3, :3])
    predicted = inverse_pose(T_first) @ T_second
    fit = refine(predicted, seen(is_old, T_first), seen(~is_old, T_second), views, config)
    if fit is None:
        return loop
    return RelativePose.measured(loop.first, loop.second, fit.T_match_query, fit.covariance, loop.observations)
