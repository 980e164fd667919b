"""Submaps: pose graphs that grow with the odometry, are optimized when loops arrive, and are joined by common places.

A keyframe that shows a known place can be culled: the graph that is optimized during the flight then grows with new
ground, not with time. All keyframes and factors remain in the history, for the final map.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from dronevio.estimator.backend.keyframe_estimate import KeyframeEstimate
from dronevio.estimator.slam.map.covariance import UNKNOWN, covariances_of, covariances_with_loops, with_position
from dronevio.estimator.slam.map.keyframe import MapKeyframe
from dronevio.estimator.slam.map.map_frame import frame_change, with_frame_offset
from dronevio.estimator.slam.map.odometry_factors import (
    OdometryFactors,
    OdometryNode,
    RelativePose,
    composed,
    odometry_factors,
    position_variance,
    propagated,
    reversed_pose,
    scaled,
)
from dronevio.estimator.slam.map.pose_graph import (
    ADJUSTED_VARIANCE,
    OptimizedGraph,
    PoseGraph,
    joined_graphs,
    moved,
    optimize,
    remeasured,
)
from dronevio.models.arrays import Array
from dronevio.models.rotation import inverse_pose, log_so3

MAX_PASSED_LOOPS = 4
"""Number of loops of a keyframe up to which those of culled keyframes after it are passed on to it."""
AGREE_M, AGREE_DEG = 0.03, 0.5
"""Largest difference of the poses by two keyframes by which a new track is located or joined. By an odometry with a
wrong velocity, as shortly after its start, they differ by more."""
SCALE_OVER_S, MIN_SCALED_M = 60.0, 5.0
"""Time of flight over which the scale of the odometry is measured [s], and shortest path for it [m]."""


@dataclass(frozen=True)
class Adjustment:
    """Result of the last bundle adjustment of a submap for the odometry."""

    newest: int
    """Number of the newest keyframe that was adjusted."""
    first: int
    """Number of the first keyframe of the track of the odometry."""
    scale: float
    """Ratio of the lengths of the map to those of the odometry in that track. The error of scale of an odometry changes
    over minutes, so that the ratio holds for the next keyframes, too."""


def path_scale(keyframes: Sequence[MapKeyframe], poses: Mapping[int, Array]) -> float:
    """Return the ratio of the length of the newest path by adjusted poses to that by the odometry.

    Args:
        keyframes: Keyframes in the order of time; those of the newest track count.
        poses: Adjusted poses (4, 4) of some of them by their numbers.
    """
    newest = keyframes[-1]
    recent = [
        k
        for k in keyframes
        if k.number in poses and k.track == newest.track and newest.t_ns - k.t_ns < SCALE_OVER_S * 1e9
    ]
    p = np.array([(poses[k.number][:3, 3], k.T_odom_imu[:3, 3]) for k in recent]).reshape(-1, 2, 3)
    adjusted_m, odometry_m = np.linalg.norm(np.diff(p, axis=0), axis=2).sum(axis=0)
    return float(adjusted_m / odometry_m) if odometry_m > MIN_SCALED_M else 1.0


@dataclass(frozen=True, eq=False)
class Submap:
    """A pose graph of one or several tracks of the odometry; immutable."""

    solution: OptimizedGraph
    """The graph with the poses of the last optimization. Loops that wait for the next one count as rejected."""
    tracks: frozenset[int]
    """Numbers of the tracks."""
    covariances: Mapping[int, Array]
    """Covariances (6, 6) of the keyframes' poses, by the best path through odometry and loops, where yaw and position
    of the first pose are known: δθ, then δp, both in the IMU frame."""
    history: PoseGraph
    """The graph with all keyframes and factors, also the culled ones, whose poses are those when they were culled."""
    first_poses: Mapping[int, Array]
    """Poses (4, 4) of the keyframes in the map frame when they joined it, also of the culled ones. Saved keyframes have
    none."""
    waiting: int = 0
    """Number of loops, the last ones of the graph, that wait for an optimization."""
    optimized_ns: int | None = None
    """Time of the newest keyframe at the last optimization [ns]; None before the first one."""
    adjustment: Adjustment | None = None
    """The last bundle adjustment; None before the first one. From then on, the map frame is no longer an odometry
    frame."""
    T_map_first: Array = field(default_factory=lambda: np.eye(4))
    """(4, 4) Pose in the map of the frame in which the first keyframe keeps its yaw and position; see `map_frame`."""
    is_saved: bool = False
    """Whether the map frame is that of a file, which stays where it is."""

    @classmethod
    def begin(cls, number: int, estimate: KeyframeEstimate, track: int) -> "Submap":
        """Return the submap of the first keyframe of a track."""
        graph = PoseGraph(number, estimate.covariance, {number: estimate.T_odom_imu})
        return cls(
            OptimizedGraph(graph, frozenset()), frozenset({track}), {number: estimate.covariance}, graph, graph.poses
        )

    @classmethod
    def of_graph(cls, graph: PoseGraph, track: int) -> "Submap":
        """Return the submap of a saved graph as one track, whose loops are all accepted."""
        solution, adjustment = OptimizedGraph(graph, frozenset()), Adjustment(max(graph.poses), graph.first, 1.0)
        covariances = covariances_of(graph)
        # The covariances of the file are those after an adjustment.
        return cls(solution, frozenset({track}), covariances, graph, {}, adjustment=adjustment, is_saved=True)

    @property
    def graph(self) -> PoseGraph:
        """The graph with all loops."""
        return self.solution.graph

    @property
    def tested_loops(self) -> int:
        """Number of loops that an optimization has accepted or rejected."""
        return len(self.graph.loops) - self.waiting

    @property
    def whole_graph(self) -> PoseGraph:
        """The graph with all keyframes and factors, at the newest poses."""
        return replace(self.history, poses={**self.history.poses, **self.graph.poses})

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
        node, factors = self._odometry_factors(anchor, number, estimate)
        factors = replace(factors, relative=scaled(factors.relative, self._scale_of(anchor.first)))
        T = self.graph.poses[anchor.number] @ factors.relative.T_first_second
        graph, history = (each.with_keyframe(T, factors) for each in (self.graph, self.history))
        covariance = propagated(self.covariances[anchor.number], factors.relative, factors.gravity)
        if factors.position is not None:
            covariance = min(covariance, with_position(covariance, factors.position, T), key=position_variance)
        solution = replace(self.solution, graph=graph)
        covariances, first = {**self.covariances, number: covariance}, {**self.first_poses, number: T}
        return node, replace(self, solution=solution, covariances=covariances, history=history, first_poses=first)

    def with_loops(self, loops: Sequence[RelativePose]) -> "Submap":
        """Return the submap with loops that wait for the next optimization."""
        count = len(self.graph.loops)
        waiting = range(count, count + len(loops))
        solution = OptimizedGraph(self.graph.with_loops(loops), self.solution.rejected | frozenset(waiting))
        history = self.history.with_loops(loops)
        return replace(self, solution=solution, history=history, waiting=self.waiting + len(loops))

    def optimized(self, t_ns: int) -> "Submap":
        """Return the submap after an optimization with the waiting loops, in the frame of `map_frame`.

        Args:
            t_ns: Time of the newest keyframe [ns].
        """
        solution = optimize(self.graph)
        before = frozenset(self.closed_loops)
        new = [loop for loop in solution.without_rejected.loops if loop not in before]
        covariances = covariances_with_loops(solution.graph, self.covariances, new)
        return replace(self, solution=solution, covariances=covariances, waiting=0, optimized_ns=t_ns)._in_place()

    def _in_place(self) -> "Submap":
        """Return the submap in the map frame that moves its keyframes as little as possible; see `map_frame`."""
        if self.is_saved:
            return self
        T = frame_change(self.graph.poses, self.first_poses)
        solution = replace(self.solution, graph=moved(self.graph, T))
        return replace(self, solution=solution, history=moved(self.history, T), T_map_first=T @ self.T_map_first)

    def adjusted(self, poses: Mapping[int, Array], adjustment: Adjustment, t_ns: int) -> "Submap":
        """Return the submap with keyframes where bundle adjustment has put them, optimized.

        Args:
            poses: Adjusted poses (4, 4) of keyframes of this submap, which may be culled, in the map frame when the
                adjustment began. The first keyframe has kept its yaw and position.
            adjustment: What they tell of the odometry.
            t_ns: Time of the newest keyframe [ns].
        """
        if not self.is_saved:  # the map frame may have moved meanwhile
            first = {number: T for number, T in poses.items() if number == self.graph.first}
            T_map_begun = frame_change(first, self.graph.poses)
            poses = {number: T_map_begun @ T for number, T in poses.items()}
        scale = adjustment.scale / self._scale_of(adjustment.first)
        known = -1 if self.adjustment is None else self.adjustment.newest
        graph, history = (remeasured(each, poses, scale, known) for each in (self.graph, self.whole_graph))
        solution = replace(self.solution, graph=graph)
        return replace(self, solution=solution, history=history, adjustment=adjustment).optimized(t_ns)

    def covariance_in_map(self, number: int) -> Array:
        """Return the covariance (6, 6) of a keyframe's pose in the map; see `with_frame_offset`."""
        return with_frame_offset(self.covariances[number], self.graph.poses[number], self.T_map_first)

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
        one, two, T_one_two = (other, self, inverse_pose(T_self_other)) if other_stays else (self, other, T_self_other)
        graph = joined_graphs(one.graph, two.graph, T_one_two)
        between = range(len(graph.loops), len(graph.loops) + len(loops))
        solution = optimize(graph.with_loops(loops))
        if solution.rejected.issuperset(between):
            return None
        unconnected = {**one.covariances, **dict.fromkeys(two.covariances, UNKNOWN)}
        covariances = covariances_with_loops(solution.graph, unconnected, solution.without_rejected.loops)
        history = joined_graphs(one.whole_graph, two.whole_graph, T_one_two).with_loops(loops)
        tracks = self.tracks | other.tracks
        whole = replace(one, solution=solution, tracks=tracks, covariances=covariances, history=history)
        return replace(whole, waiting=0, optimized_ns=t_ns)

    def without(self, number: int, previous: OdometryNode, following: KeyframeEstimate) -> "Submap":
        """Return the submap without a keyframe, which stays in the history.

        One odometry factor replaces the two at the keyframe, as if the window had never contained it. Its accepted
        loops pass on to the keyframe before it, up to `MAX_PASSED_LOOPS` there.

        Args:
            number: Number of the keyframe, which is the first one of no loop, and neither the first nor the newest one
                of its track.
            previous: The keyframe before it in the graph.
            following: The estimate of the keyframe after it.
        """
        graph, waiting = self.graph, self.graph.loops[self.tested_loops :]
        # Odometry: one relative pose in place of the two at the keyframe
        before = next(relative for relative in graph.odometry if relative.second == number)
        after = next(relative for relative in graph.odometry if relative.first == number)
        _, merged = self._odometry_factors(previous, after.second, following)
        is_adjusted = self.adjustment is not None and after.second <= self.adjustment.newest
        covariance = (ADJUSTED_VARIANCE if is_adjusted else 1.0) * merged.relative.covariance
        T = before.T_first_second @ after.T_first_second  # also where bundle adjustment has changed them
        relative = replace(merged.relative, T_first_second=T, covariance=covariance)
        odometry = tuple(relative if each is after else each for each in graph.odometry if each is not before)
        # Gravity and position of the keyframe after it, by the merged factors
        gravity = [each for each in graph.gravity if each.keyframe not in (number, after.second)]
        gravity += [] if merged.gravity is None else [merged.gravity]
        positions = [each for each in graph.positions if each.keyframe not in (number, after.second)]
        positions += [] if merged.position is None else [merged.position]
        # Loops: the accepted ones pass on to the keyframe before
        closed = self.closed_loops
        kept = [loop for loop in graph.loops[: self.tested_loops] if loop.second != number]
        room = MAX_PASSED_LOOPS - sum(loop.second == before.first for loop in kept)
        own = [loop for loop in closed if loop.second == number and loop.first != before.first]
        passed = [composed(loop, reversed_pose(before)) for loop in own[: max(room, 0)]]
        kept_waiting = [loop for loop in waiting if loop.second != number]
        loops = (*kept, *passed, *kept_waiting)
        accepted = {*closed, *passed}
        # Graph without the keyframe, and the history with its last pose
        poses = {k: T for k, T in graph.poses.items() if k != number}
        culled = replace(
            graph,
            poses=poses,
            odometry=odometry,
            gravity=tuple(gravity),
            positions=tuple(positions),
            loops=loops,
        )
        rejected = frozenset(i for i, loop in enumerate(loops) if loop not in accepted)
        history = replace(self.history, poses={**self.history.poses, number: graph.poses[number]})
        solution = OptimizedGraph(culled, rejected)
        covariances = {k: P for k, P in self.covariances.items() if k != number}
        return replace(self, solution=solution, covariances=covariances, history=history, waiting=len(kept_waiting))

    def _odometry_factors(
        self, anchor: OdometryNode, number: int, estimate: KeyframeEstimate
    ) -> tuple[OdometryNode, OdometryFactors]:
        """Return the next keyframe of the odometry and its factors, with a position in the map frame if it has one."""
        # Before an adjustment, the map frame differs from the first odometry frame in yaw and position alone.
        is_map_frame = anchor.first == self.graph.first and self.adjustment is None
        node, factors = odometry_factors(anchor, number, estimate, is_map_frame=is_map_frame)
        position = factors.position
        return node, factors if position is None else replace(factors, position=position.moved(self.T_map_first))

    def _scale_of(self, first: int) -> float:
        """Return the scale of the odometry in the track that begins with a keyframe, 1 if it is not known."""
        return self.adjustment.scale if self.adjustment is not None and self.adjustment.first == first else 1.0


def agreeing_loops(loops: Sequence[RelativePose], other: Submap, submap: Submap) -> list[RelativePose]:
    """Return the loops between two submaps that lead to the same pose as the last of them.

    Args:
        loops: Loops in the order of time; those between other submaps are left out.
        other: The submap of their first keyframes.
        submap: The submap of their second keyframes.
    """
    old, new = other.graph.poses, submap.graph.poses
    between = [loop for loop in loops if loop.first in old and loop.second in new]
    if not between:
        return []
    T_last = new[between[-1].second]  # the pose that is compared
    by_loop = [old[loop.first] @ loop.T_first_second @ inverse_pose(new[loop.second]) @ T_last for loop in between]
    return [loop for loop, T in zip(between, by_loop, strict=True) if poses_agree(T, by_loop[-1])]


def poses_agree(T: Array, other: Array) -> bool:
    """Return whether two poses (4, 4), each by a keyframe, are as close as by an odometry with the right velocity."""
    T_between = inverse_pose(T) @ other
    angle_deg = np.degrees(np.linalg.norm(log_so3(T_between[:3, :3])))
    return bool(np.linalg.norm(T_between[:3, 3]) <= AGREE_M and angle_deg <= AGREE_DEG)
