"""Covariances of keyframes in the map by the best path to each of them, through odometry and loops.

The errors of an odometry are correlated over minutes, for example by an error of scale. A pose graph assumes
independent factors, so that loops seem to remove errors that they do not: in a corridor that was flown twice, its
marginal covariances are too small by a factor of 100. Where correlations are not known, each single path through the
graph is consistent, which is covariance intersection with a weight of one (Julier and Uhlmann, "A non-divergent
estimation algorithm in the presence of unknown correlations", ACC 1997). The path with the smallest position variance
is used.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping

import numpy as np

from dronevio.estimator.slam.map.odometry_factors import (
    AbsolutePosition,
    RelativePose,
    position_variance,
    propagated,
    reversed_pose,
)
from dronevio.estimator.slam.map.pose_graph import (
    FIXED_SIGMA,
    FREE_POSITION_SIGMA_M,
    FREE_ROTATION_SIGMA_RAD,
    PoseGraph,
)
from dronevio.models.arrays import Array

UNKNOWN = np.diag(np.repeat([FREE_ROTATION_SIGMA_RAD**2, FREE_POSITION_SIGMA_M**2], 3))
"""(6, 6) Covariance of an unknown pose."""


def covariances_with_loops(
    graph: PoseGraph, covariances: Mapping[int, Array], loops: Iterable[RelativePose]
) -> Mapping[int, Array]:
    """Return the covariances of keyframes with paths through new loops, and through the odometry after them.

    Args:
        graph: The graph of the keyframes.
        covariances: Covariances (6, 6) by the numbers of the keyframes without these loops, `UNKNOWN` for keyframes
            that nothing connects with the first one: δθ, then δp, both in the IMU frame.
        loops: Accepted loops.
    """
    # Keyframes that loops reach
    reached: dict[int, list[RelativePose]] = defaultdict(list)
    for loop in loops:
        reached[loop.second].append(loop)
        if is_unknown(covariances[loop.first]):
            reached[loop.first].append(reversed_pose(loop))
    if not reached:
        return covariances
    # Best path to each keyframe, in the order of time: as before, by a loop, or by the odometry
    best, steps = dict(covariances), {relative.second: relative for relative in graph.odometry}
    gravity = {direction.keyframe: direction for direction in graph.gravity}
    positions = {position.keyframe: position for position in graph.positions}
    for number in sorted(k for k in best if k >= min(reached)):
        paths = [best[number], *(propagated(best[loop.first], loop, None) for loop in reached[number])]
        step = steps.get(number)
        if step is not None:
            paths.append(propagated(best[step.first], step, gravity.get(number)))
        if number in positions:
            paths.append(with_position(paths[-1], positions[number], graph.poses[number]))
        best[number] = min(paths, key=position_variance)
    # The first loop of another track also determines the keyframes before it
    for number in sorted(steps, reverse=True):
        step = steps[number]
        if is_unknown(best[step.first]):
            best[step.first] = min(
                best[step.first], propagated(best[number], reversed_pose(step), None), key=position_variance
            )
    return best


def covariances_of(graph: PoseGraph) -> Mapping[int, Array]:
    """Return the covariances of all keyframes of a graph, of which all loops are right."""
    fixed = dict.fromkeys(graph.fixed, FIXED_SIGMA**2 * np.eye(6))
    known = {**dict.fromkeys(graph.poses, UNKNOWN), **fixed, graph.first: graph.first_covariance}
    first_step = [relative for relative in graph.odometry if relative.first == graph.first]
    return covariances_with_loops(graph, known, [*graph.loops, *first_step])  # the first step begins the paths


def with_position(covariance: Array, position: AbsolutePosition, T_map_imu: Array) -> Array:
    """Return the covariance (6, 6) of a pose by the prior on its position, and by a path for its rotation.

    Args:
        covariance: (6, 6) Covariance by the path.
        position: The prior.
        T_map_imu: (4, 4) The pose.
    """
    R, known = T_map_imu[:3, :3], covariance.copy()
    known[:3, 3:], known[3:, :3], known[3:, 3:] = 0.0, 0.0, R.T @ position.covariance @ R
    return known


def is_unknown(covariance: Array) -> bool:
    """Return whether a position is unknown."""
    return position_variance(covariance) > FREE_POSITION_SIGMA_M**2
