"""The pose graph of a map and its optimization: keyframes, connected by the odometry, by gravity and by loops."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from dronevio.estimator.slam.map.odometry_factors import (
    AbsolutePosition,
    GravityDirection,
    OdometryFactors,
    RelativePose,
    scaled,
    tilt_axes,
)
from dronevio.models.arrays import Array
from dronevio.models.rotation import inverse_pose

INLIER_PROBABILITY = 0.99
"""Probability of the χ² bound below which graduated non-convexity takes a loop as an inlier."""
FREE_ROTATION_SIGMA_RAD, FREE_POSITION_SIGMA_M = 1.0, 100.0
"""Standard deviations of the pose of the first keyframe of a joined track [rad] and [m]: loops alone determine its yaw
and position, and the solution stays unique where all of them are rejected."""
TESTED_ROTATION_SIGMA_RAD, TESTED_POSITION_SIGMA_M = 0.005, 0.01
"""Standard deviations that are added to those of a loop where it is tested [rad] and [m]. The graph contains the growth
of the odometry's covariance since the start, which is less than the error between two keyframes in between. A place
mistaken for another one errs by far more."""
ADJUSTED_VARIANCE = 0.1
"""Ratio of the covariance of a relative pose after bundle adjustment to that by the odometry alone."""
FIXED_SIGMA = 1e-4
"""Standard deviation of a fixed pose [rad] and [m]; loops of some millimetres move it by micrometres."""


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """Keyframes and the factors between them; immutable.

    Attributes are tuples, so that a graph can be passed to another process.
    """

    first: int
    """Number of the keyframe whose pose has a prior, also on yaw and position: that of the graph."""
    first_covariance: Array
    """(6, 6) Prior covariance of its pose: δθ, then δp, both in the IMU frame."""
    poses: Mapping[int, Array]
    """Poses (4, 4) of the keyframes in the map frame, `T_map_imu`, by their numbers."""
    odometry: tuple[RelativePose, ...] = ()
    """Relative poses by the odometry."""
    gravity: tuple[GravityDirection, ...] = ()
    """Directions of gravity by the odometry."""
    positions: tuple[AbsolutePosition, ...] = ()
    """Positions by the odometry of keyframes in the first track."""
    loops: tuple[RelativePose, ...] = ()
    """Relative poses by places that were recognized again."""
    joined: tuple[int, ...] = ()
    """Numbers of the keyframes at which other tracks of the odometry begin. Yaw and position there are free: loops
    connect these tracks with the others."""
    fixed: tuple[int, ...] = ()
    """Numbers of the keyframes with fixed poses."""

    def with_keyframe(self, T_map_imu: Array, factors: OdometryFactors) -> "PoseGraph":
        """Return the graph with one more keyframe, by the odometry.

        Args:
            T_map_imu: (4, 4) Its pose in the map frame.
            factors: The factors by the odometry that connect it with the keyframe before it.
        """
        return replace(
            self,
            poses={**self.poses, factors.relative.second: T_map_imu},
            odometry=(*self.odometry, factors.relative),
            gravity=self.gravity if factors.gravity is None else (*self.gravity, factors.gravity),
            positions=self.positions if factors.position is None else (*self.positions, factors.position),
        )

    def with_loops(self, loops: Sequence[RelativePose]) -> "PoseGraph":
        """Return the graph with more loops."""
        return replace(self, loops=(*self.loops, *loops))

    def between(self, numbers: Collection[int]) -> "PoseGraph":
        """Return the graph with those of its loops whose keyframes are among some, by their numbers."""
        return replace(self, loops=tuple(each for each in self.loops if {each.first, each.second} <= set(numbers)))

    def among(self, numbers: Collection[int]) -> "PoseGraph":
        """Return the graph of some of its keyframes, by their numbers, and the factors between them."""
        relative = tuple(each for each in self.odometry if {each.first, each.second} <= set(numbers))
        return replace(
            self.between(numbers),
            poses={number: T for number, T in self.poses.items() if number in numbers},
            odometry=relative,
            gravity=tuple(each for each in self.gravity if each.keyframe in numbers),
            positions=tuple(each for each in self.positions if each.keyframe in numbers),
            joined=tuple(number for number in self.joined if number in numbers),
            fixed=tuple(number for number in self.fixed if number in numbers),
        )


@dataclass(frozen=True, eq=False)
class OptimizedGraph:
    """The solution of a pose graph."""

    graph: PoseGraph
    """The graph with the optimized poses."""
    rejected: frozenset[int]
    """Indices of the loops that contradict the others; the solution does not contain them."""

    @property
    def closed(self) -> frozenset[int]:
        """Indices of the loops of the solution."""
        return frozenset(range(len(self.graph.loops))) - self.rejected

    @property
    def without_rejected(self) -> PoseGraph:
        """The graph without the rejected loops."""
        loops = tuple(loop for i, loop in enumerate(self.graph.loops) if i not in self.rejected)
        return replace(self.graph, loops=loops)


def optimize(graph: PoseGraph, *, robust: bool = True) -> OptimizedGraph:
    """Return the most probable poses of the keyframes.

    Args:
        graph: The graph; its poses are the initial estimates.
        robust: Whether loops may be wrong, which graduated non-convexity then rejects, with a truncated quadratic loss
            (Yang et al., "Graduated non-convexity for robust spatial perception", RA-L 2020).
    """
    values = gtsam.Values()
    for k, T in graph.poses.items():
        values.insert(X(k), gtsam.Pose3(T))
    rejected = _rejected_loops(graph, values) if robust and graph.loops else frozenset[int]()
    inliers = OptimizedGraph(graph, rejected).without_rejected
    solution = gtsam.LevenbergMarquardtOptimizer(factor_graph(inliers), values).optimize()
    poses = {k: solution.atPose3(X(k)).matrix() for k in graph.poses}
    return OptimizedGraph(replace(graph, poses=poses), rejected)


def remeasured(graph: PoseGraph, poses: Mapping[int, Array], scale: float, known: int = -1) -> PoseGraph:
    """Return a graph whose odometry measures improved poses of some keyframes.

    Other keyframes are moved with the newest of the better ones, and the odometry after it is scaled. Loops stay.

    Args:
        graph: The graph.
        poses: Poses (4, 4) in the map frame by the numbers of the keyframes, one or more of which are in the graph.
        scale: Ratio of the lengths of the map to those of the odometry.
        known: Number of the keyframe up to which the covariances are those of better poses already.
    """
    newest = max(number for number in poses if number in graph.poses)
    moved = poses[newest] @ inverse_pose(graph.poses[newest])
    after = {number: poses[number] if number in poses else moved @ T for number, T in graph.poses.items()}

    def better(relative: RelativePose) -> RelativePose:
        if relative.first in poses and relative.second in poses:
            T = inverse_pose(after[relative.first]) @ after[relative.second]
            covariance = (1.0 if relative.second <= known else ADJUSTED_VARIANCE) * relative.covariance
            return replace(relative, T_first_second=T, covariance=covariance)
        return scaled(relative, scale) if relative.second > newest else relative

    return replace(
        graph,
        poses=after,
        odometry=tuple(better(each) for each in graph.odometry),
        gravity=tuple(replace(each, up_imu=after[each.keyframe][2, :3]) for each in graph.gravity),
        positions=tuple(replace(each, p_map=after[each.keyframe][:3, 3]) for each in graph.positions),
    )


def moved(graph: PoseGraph, T: Array) -> PoseGraph:
    """Return a graph in another map frame.

    Args:
        graph: The graph.
        T: (4, 4) Pose of its map frame in the other one, a rotation about the vertical and a translation.
    """
    poses = {number: T @ pose for number, pose in graph.poses.items()}
    return replace(graph, poses=poses, positions=tuple(each.moved(T) for each in graph.positions))


def joined_graphs(graph: PoseGraph, other: PoseGraph, T_graph_other: Array) -> PoseGraph:
    """Return two graphs as one, in the map frame of the first; the loops of the second come last.

    The second graph keeps what it knows of the direction of gravity. Its yaw and position are free, so positions in its
    own map frame are left out.

    Args:
        graph: The first graph.
        other: The second graph, with other keyframes.
        T_graph_other: (4, 4) Initial estimate of the second map frame in the first one.
    """
    T_first = other.poses[other.first]
    up, sigma_rad = T_first[2, :3], float(np.sqrt(tilt_variance(T_first[2, :3], other.first_covariance)))
    return PoseGraph(
        graph.first,
        graph.first_covariance,
        {**graph.poses, **{number: T_graph_other @ T for number, T in other.poses.items()}},
        (*graph.odometry, *other.odometry),
        (*graph.gravity, GravityDirection(other.first, up, sigma_rad), *other.gravity),
        graph.positions,
        (*graph.loops, *other.loops),
        (*graph.joined, other.first, *other.joined),
        (*graph.fixed, *other.fixed),
    )


def tilt_variance(up_imu: Array, covariance: Array) -> float:
    """Return the mean variance of the direction of gravity, by the covariance (6, 6) of a pose in the IMU frame."""
    tilt = tilt_axes(up_imu)
    return float(np.trace(tilt @ covariance[:3, :3] @ tilt.T)) / 2.0


def factor_graph(graph: PoseGraph) -> gtsam.NonlinearFactorGraph:
    """Return the factors of a graph, with the symbols X(number); the loops come last.

    Factors of fixed keyframes alone are left out, since they are constant.
    """
    factors, is_fixed = gtsam.NonlinearFactorGraph(), frozenset(graph.fixed)
    if graph.first in graph.poses:
        prior = gtsam.noiseModel.Gaussian.Covariance(graph.first_covariance)
        factors.add(gtsam.PriorFactorPose3(X(graph.first), gtsam.Pose3(graph.poses[graph.first]), prior))
    free = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([FREE_ROTATION_SIGMA_RAD, FREE_POSITION_SIGMA_M], 3))
    for number in graph.joined:
        factors.add(gtsam.PriorFactorPose3(X(number), gtsam.Pose3(graph.poses[number]), free))
    fixed = gtsam.noiseModel.Isotropic.Sigma(6, FIXED_SIGMA)
    for number in graph.fixed:
        factors.add(gtsam.PriorFactorPose3(X(number), gtsam.Pose3(graph.poses[number]), fixed))
    up = gtsam.Unit3(np.array([0.0, 0.0, 1.0]))
    for direction in graph.gravity:
        if direction.keyframe not in is_fixed:
            tilt_noise = gtsam.noiseModel.Isotropic.Sigma(2, direction.sigma_rad)
            factors.add(gtsam.AttitudeFactorPose3(X(direction.keyframe), up, tilt_noise, gtsam.Unit3(direction.up_imu)))
    for position in graph.positions:
        if position.keyframe not in is_fixed:
            noise = gtsam.noiseModel.Gaussian.Covariance(position.covariance)
            factors.add(gtsam.PoseTranslationPrior3D(X(position.keyframe), position.p_map, noise))
    for relative in (*graph.odometry, *graph.loops):
        if not {relative.first, relative.second} <= is_fixed:
            noise = gtsam.noiseModel.Gaussian.Covariance(relative.covariance)
            T = gtsam.Pose3(relative.T_first_second)
            factors.add(gtsam.BetweenFactorPose3(X(relative.first), X(relative.second), T, noise))
    return factors


def _rejected_loops(graph: PoseGraph, values: gtsam.Values) -> frozenset[int]:
    """Return the indices of the loops that graduated non-convexity rejects.

    Loops between fixed keyframes are accepted.
    """
    is_fixed = frozenset(graph.fixed)
    free = [i for i, loop in enumerate(graph.loops) if not {loop.first, loop.second} <= is_fixed]
    if not free:
        return frozenset()
    added = np.diag(np.repeat([TESTED_ROTATION_SIGMA_RAD**2, TESTED_POSITION_SIGMA_M**2], 3))
    loops = (graph.loops[i] for i in free)
    tested = replace(graph, loops=tuple(replace(loop, covariance=loop.covariance + added) for loop in loops))
    factors = factor_graph(tested)
    params = gtsam.GncLMParams(gtsam.LevenbergMarquardtParams())
    params.setLossType(gtsam.GncLossType.TLS)
    params.setKnownInliers(list(range(factors.size() - len(free))))
    optimizer = gtsam.GncLMOptimizer(factors, values, params)
    optimizer.setInlierCostThresholdsAtProbability(INLIER_PROBABILITY)
    optimizer.optimize()
    return frozenset(free[i] for i in np.flatnonzero(optimizer.getWeights()[-len(free) :] < 0.5).tolist())
