"""Submaps: pose graphs that grow with the odometry, are optimized when loops arrive, and are joined by common places.

After a loss, the odometry begins another *track*: its keyframes have another odometry frame. They form a submap of
their own until a place of another submap is recognized.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from dronevio.estimator.backend.keyframe_estimate import KeyframeEstimate
from dronevio.estimator.slam.odometry_factors import OdometryNode, RelativePose, odometry_factors, propagated
from dronevio.estimator.slam.pose_graph import (
    OptimizedGraph,
    PoseGraph,
    joined_graphs,
    marginal_covariance,
    optimize,
)
from dronevio.models.rotation import inverse_pose

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Submap:
    """A pose graph of one or several tracks of the odometry; immutable."""

    solution: OptimizedGraph
    """The graph with the poses of the last optimization. Loops that wait for the next one count as rejected."""
    tracks: frozenset[int]
    """Numbers of the tracks."""
    covariance: Array
    """(6, 6) Covariance of the newest keyframe's pose in the map: δθ, then δp, both in the IMU frame."""
    waiting: int = 0
    """Number of loops, the last ones of the graph, that wait for an optimization."""
    optimized_ns: int | None = None
    """Time of the newest keyframe at the last optimization [ns]; None before the first one."""

    @classmethod
    def begin(cls, number: int, estimate: KeyframeEstimate, track: int) -> "Submap":
        """Return the submap of the first keyframe of a track."""
        graph = PoseGraph(number, estimate.covariance, {number: estimate.T_odom_imu})
        return cls(OptimizedGraph(graph, frozenset()), frozenset({track}), estimate.covariance)

    @property
    def graph(self) -> PoseGraph:
        """The graph with all loops."""
        return self.solution.graph

    @property
    def judged(self) -> int:
        """Number of loops that an optimization has accepted or rejected."""
        return len(self.graph.loops) - self.waiting

    @property
    def closed_loops(self) -> tuple[RelativePose, ...]:
        """The loops that an optimization has accepted."""
        return self.solution.without_rejected.loops

    def extended(self, anchor: OdometryNode, number: int, estimate: KeyframeEstimate) -> tuple[OdometryNode, "Submap"]:
        """Return a new keyframe as a node of the odometry, and the submap with it.

        Args:
            anchor: The newest keyframe of the same track.
            number: Number of the new keyframe.
            estimate: The final estimate of the new keyframe.
        """
        graph = self.graph
        node, relative, gravity = odometry_factors(anchor, number, estimate)
        poses = {**graph.poses, number: graph.poses[relative.first] @ relative.T_first_second}
        directions = graph.gravity if gravity is None else (*graph.gravity, gravity)
        graph = replace(graph, poses=poses, odometry=(*graph.odometry, relative), gravity=directions)
        covariance = propagated(self.covariance, relative, gravity)
        return node, replace(self, solution=replace(self.solution, graph=graph), covariance=covariance)

    def with_loops(self, loops: Sequence[RelativePose]) -> "Submap":
        """Return the submap with loops that wait for the next optimization."""
        count = len(self.graph.loops)
        waiting = range(count, count + len(loops))
        solution = OptimizedGraph(self.graph.with_loops(loops), self.solution.rejected | frozenset(waiting))
        return replace(self, solution=solution, waiting=self.waiting + len(loops))

    def optimized(self, t_ns: int) -> "Submap":
        """Return the submap after an optimization, which judges the waiting loops.

        Args:
            t_ns: Time of the newest keyframe [ns].
        """
        solution, covariance = optimize(self.graph), self.covariance
        if solution.closed != self.solution.closed:
            covariance = marginal_covariance(solution.without_rejected, max(self.graph.poses))
        return Submap(solution, self.tracks, covariance, 0, t_ns)

    def joined(
        self, other: "Submap", loops: Sequence[RelativePose], t_ns: int, *, other_stays: bool
    ) -> "Submap | None":
        """Return both submaps as one, optimized; None if all loops between them are rejected.

        Args:
            other: The submap of the first keyframes of the loops.
            loops: Loops whose second keyframes are in this submap, one or more.
            t_ns: Time of the newest keyframe [ns].
            other_stays: Whether the map frame of the other submap remains, and not that of this one.
        """
        newest = loops[-1]
        T_self_match = self.graph.poses[newest.second] @ inverse_pose(newest.T_first_second)
        T_self_other = T_self_match @ inverse_pose(other.graph.poses[newest.first])
        if other_stays:
            graph = joined_graphs(other.graph, self.graph, inverse_pose(T_self_other))
        else:
            graph = joined_graphs(self.graph, other.graph, T_self_other)
        between = range(len(graph.loops), len(graph.loops) + len(loops))
        solution = optimize(graph.with_loops(loops))
        if solution.rejected.issuperset(between):
            return None
        covariance = marginal_covariance(solution.without_rejected, max(solution.graph.poses))
        return Submap(solution, self.tracks | other.tracks, covariance, 0, t_ns)
