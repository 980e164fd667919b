"""The mapper: keyframes of the odometry become a map, and recognized places correct the odometry.

A keyframe joins the map with its final pose when it leaves the odometry's window. Recognized places become loops of the
pose graph, and the graph is optimized. The correction of the odometry is the pose of the odometry frame in the map
frame at the newest keyframe of the map, the anchor.

After a loss, the odometry begins another track. It is a submap of its own until a place of another submap is
recognized; the two are then joined. The submap with the first track is the map. Keyframes of another submap are also
compared with the map while they are in the window, so that the pose in the map is known before the first of them
leaves it.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Protocol

import numpy as np

from dronevio.estimator.backend.keyframe_estimate import KeyframeEstimate
from dronevio.estimator.slam.correction import Correction
from dronevio.estimator.slam.files.saved_map import LAST_KNOWN_NS, KnownMap
from dronevio.estimator.slam.map.covisibility import CovisibilityConfig, nearest_views
from dronevio.estimator.slam.map.keyframe import MapKeyframe
from dronevio.estimator.slam.map.map_arrays import MapSummary, slam_map
from dronevio.estimator.slam.map.odometry_factors import OdometryNode, RelativePose, first_node, propagated
from dronevio.estimator.slam.map.pose_graph import OptimizedGraph, PoseGraph, optimize
from dronevio.estimator.slam.map.submap import Adjustment, Submap, agreeing_loops, path_scale, poses_agree
from dronevio.estimator.slam.places.localization import (
    KeyframeImages,
    KeyframeView,
    LandmarkPatches,
    LocalizationConfig,
    Localizer,
    landmark_patches,
    tile_side_px,
)
from dronevio.estimator.slam.places.verification import PlaceMatch
from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.ranges import Range, Settings
from dronevio.models.rotation import inverse_pose
from dronevio.models.slam_map import SlamMap

MAX_BETWEEN = 20
"""Number of the newest loops of a track with another submap by which the two may be joined."""
MAX_CONNECTED = 1000
"""Number of the newest loops whose keyframes are known to be connected with an earlier visit."""
CONNECTED_WITHIN_S = 1.0
"""Time between a redundant keyframe and a loop that connects it with the earlier visit [s]."""
LOCALIZATION_INTERVAL_S = 0.5
"""Shortest time of flight between two keyframes that are localized in the map [s]."""
MIN_MAP_KEYFRAMES = 5
"""Number of keyframes below which a map is discarded when the odometry is lost: the next track begins another one."""


class Recognizer(Protocol):
    """Recognizes places of earlier keyframes."""

    def add(self, keyframe: MapKeyframe, /) -> tuple[PlaceMatch, ...]:
        """Add a keyframe, and return the confirmed matches of it and of keyframes before it with earlier ones."""

    def locate(self, keyframe: MapKeyframe, /) -> PlaceMatch | None:
        """Return the confirmed match of a keyframe that is not added yet; None without one."""

    def remove(self, number: int, /) -> None:
        """Remove a keyframe, which is no longer recognized."""

    def start_track(self) -> None:
        """Declare that the following keyframes have another odometry frame."""


@dataclass(frozen=True)
class MappingConfig(Settings):
    """Settings of the mapper."""

    localization: LocalizationConfig = field(default_factory=LocalizationConfig)
    """Settings of the localization of keyframes in the map."""
    covisibility: CovisibilityConfig = field(default_factory=CovisibilityConfig)
    """Settings of the choice of the keyframes in which another one is localized."""
    optimization_interval_s: Annotated[float, Range(low=0.0)] = 1.0
    """Shortest time of flight between two optimizations of the pose graph [s]."""
    interval_loops: Annotated[int, Range(1, 1_000_000)] = 300
    """Number of loops beyond which that time grows in proportion to it, as the cost of an optimization does."""
    min_age_s: Annotated[float, Range(0.0, 3600.0)] = 10.0
    """Smallest age of a keyframe in which another one of the same track is localized [s]. At this age it is culled if
    it is redundant."""
    redundant: CovisibilityConfig = field(default_factory=lambda: CovisibilityConfig(0.5, 15.0, 1))
    """Similarity of the view of an earlier keyframe from which on a keyframe is redundant."""


@dataclass
class _NewestTrack:
    """What the mapper keeps of the newest track of the odometry, until the next one begins."""

    young: deque[int] = field(default_factory=deque)
    """Keyframes that are too young to be culled."""
    localized_ns: int | None = None
    """Time of the newest keyframe that was localized in earlier ones [ns]."""
    loops_between: tuple[RelativePose, ...] = ()
    """Loops with submaps that it is not joined with."""
    T_map_odom: Array | None = None
    """(4, 4) Pose of its odometry frame in the map by the place of one keyframe."""
    located: Correction | None = None
    """Correction by two keyframes that agree, before the track is joined with the map."""


class Mapper:
    """Builds a map from the keyframes of an odometry, which may begin again after a loss."""

    def __init__(self, recognizer: Recognizer, config: MappingConfig | None = None) -> None:
        """Begin with an empty map.

        Args:
            recognizer: Recognizes places.
            config: Settings.
        """
        self._recognizer, self._config = recognizer, config or MappingConfig()
        self._localizer = Localizer(self._config.localization)
        self._patches: dict[int, LandmarkPatches] = {}
        self._keyframes: list[MapKeyframe] = []  # of all submaps; the index is the number
        self._nodes: dict[int, OdometryNode] = {}  # keyframes that are not culled
        self._submaps: tuple[Submap, ...] = ()
        self._closed: set[RelativePose] = set()  # loops that corrections have contained
        self._connected_ns: tuple[int, ...] = ()  # times of the later keyframes of the newest of these loops
        self._map_track = 0  # track whose submap is the map
        self._starts_ns: list[int] = []  # times at which the tracks after the first one begin
        self._newest = _NewestTrack()

    def load(self, known: KnownMap) -> None:
        """Continue a saved map: the flight that follows is another track, which is joined as after a loss.

        Args:
            known: The map, whose keyframes the recognizer knows already.

        Raises:
            ConfigError: There are keyframes, or the map was saved with patches of another size.
        """
        side = tile_side_px(self._config.localization)
        found = next((patches.tiles.shape[1] for patches in known.patches.values() if len(patches.tiles)), side)
        if self._keyframes or found != side:
            raise ConfigError(f"map with patches of {found} px; expected {side} px, and no keyframe before it")
        self._keyframes, self._patches = list(known.keyframes), dict(known.patches)
        self._submaps = (Submap.of_graph(known.graph, 0),)
        self._closed = set(known.graph.loops)
        self.start_track(LAST_KNOWN_NS + 1)

    @property
    def patches(self) -> Mapping[int, LandmarkPatches]:
        """Small images around the landmarks of keyframes, by their numbers."""
        return self._patches

    @property
    def is_joined(self) -> bool:
        """Whether the map has keyframes beside those that were loaded."""
        return any(keyframe.t_ns > LAST_KNOWN_NS for keyframe in self.keyframes)

    @property
    def graph(self) -> PoseGraph | None:
        """The pose graph of the map with all keyframes and loops; None before the first keyframe."""
        map_submap = self._map_submap
        return None if map_submap is None else map_submap.whole_graph

    @property
    def keyframes(self) -> tuple[MapKeyframe, ...]:
        """The keyframes of the map in the order of time; culled ones are without features."""
        map_submap = self._map_submap
        return () if map_submap is None else tuple(k for k in self._keyframes if k.track in map_submap.tracks)

    @property
    def poses(self) -> Mapping[int, Array]:
        """Poses (4, 4) in the map frame of the keyframes that are not culled, by their numbers."""
        map_submap = self._map_submap
        return {} if map_submap is None else map_submap.graph.poses

    @property
    def adjusted_until(self) -> int:
        """Number of the newest keyframe that bundle adjustment during the flight has moved; -1 before the first one."""
        map_submap = self._map_submap
        return -1 if map_submap is None or map_submap.adjustment is None else map_submap.adjustment.newest

    @property
    def summary(self) -> MapSummary:
        """Size of the map."""
        map_submap, tracks = self._map_submap, {keyframe.track for keyframe in self._keyframes}
        if map_submap is None:
            return MapSummary(0, 0, 0, len(tracks))
        graph, rejected = map_submap.graph, len(map_submap.solution.rejected)
        return MapSummary(len(graph.poses), len(graph.loops) - rejected, rejected, len(tracks - map_submap.tracks))

    def final_solution(self) -> OptimizedGraph | None:
        """Return the pose graph of the map, optimized with all loops; None before the first keyframe."""
        graph = self.graph
        return None if graph is None else optimize(graph)

    @property
    def accepted_graph(self) -> PoseGraph | None:
        """The pose graph of the map with all keyframes, without loops that are rejected or wait; None before the first
        keyframe.
        """
        map_submap = self._map_submap
        if map_submap is None:
            return None
        graph = map_submap.whole_graph
        closed = self._closed - (set(map_submap.graph.loops) - set(map_submap.closed_loops))
        return replace(graph, loops=tuple(each for each in graph.loops if each in closed))

    def adjust(self, poses: Mapping[int, Array]) -> None:
        """Put keyframes of the map where bundle adjustment has put them.

        Args:
            poses: Adjusted poses (4, 4) in the map frame. If the map has been given up meanwhile, they have no effect.
        """
        map_submap = self._map_submap
        if map_submap is not None and poses.keys() <= map_submap.whole_graph.poses.keys():
            newest = self._keyframes[-1]
            adjustment = Adjustment(max(poses), self._nodes[newest.number].first, path_scale(self._keyframes, poses))
            adjusted = map_submap.adjusted(poses, adjustment, newest.t_ns)
            self._submaps = (*(each for each in self._submaps if each is not map_submap), adjusted)

    def map_of(self, solution: OptimizedGraph) -> SlamMap:
        """Return the map as arrays, with the poses of a solution."""
        return slam_map(solution, self.keyframes, self._starts_ns)

    def start_track(self, t_ns: int) -> None:
        """Declare that the odometry is lost: later keyframes are in another odometry frame.

        Args:
            t_ns: Time at which the new track begins [ns].
        """
        self._starts_ns.append(t_ns)
        self._recognizer.start_track()
        self._newest = _NewestTrack()
        map_submap = self._map_submap
        if map_submap is None or len(map_submap.graph.poses) < MIN_MAP_KEYFRAMES:
            self._map_track = self._track  # there is nothing yet that could be recognized

    def locate(self, estimate: KeyframeEstimate, view: KeyframeView) -> Correction | None:
        """Return the correction of a track that is not joined, by a keyframe that is still in the window.

        Args:
            estimate: The estimate of the keyframe so far.
            view: What its cameras show.

        Returns:
            The correction; None if the keyframe shows no place of the map, if it leads to another pose than the one
            before, as while an odometry has a wrong velocity, or if the track has a pose in the map already.
        """
        map_submap = self._map_submap
        if map_submap is None or self._track in map_submap.tracks or self._newest.located is not None:
            return None
        # Place recognition
        keyframe = self._keyframe(estimate, view)
        match = self._recognizer.locate(keyframe)
        if match is None or match.match not in map_submap.graph.poses:
            return None
        # Relative pose, by patches around landmarks where the keyframe of the place has them
        place, patches = _loop(match), self._patches.get(match.match)
        if view.images is not None and patches is not None:
            old, predicted = self._keyframes[match.match], match.T_match_query
            place = self._localizer.localize(keyframe, view.images, old, patches, predicted) or place
        # Pose of the odometry frame in the map, which that of the keyframe before has to confirm
        T_map_imu = map_submap.graph.poses[match.match] @ place.T_first_second
        previous, T_map_odom = self._newest.T_map_odom, T_map_imu @ inverse_pose(estimate.T_odom_imu)
        self._newest.T_map_odom = T_map_odom
        if previous is None or not poses_agree(previous @ estimate.T_odom_imu, T_map_imu):
            return None
        covariance = propagated(map_submap.covariance_in_map(match.match), place, None)
        self._newest.located = Correction(T_map_odom, estimate, covariance, self._track)
        return replace(self._newest.located, is_joined=True)

    def add(self, estimate: KeyframeEstimate, view: KeyframeView) -> Correction:
        """Let a keyframe join its submap, and return the correction of the odometry.

        Args:
            estimate: The final estimate of the keyframe.
            view: What its cameras show.
        """
        keyframe, had_map_pose = self._keyframe(estimate, view), self._is_in_map or self._newest.located is not None
        self._keyframes.append(keyframe)
        # Odometry: the submap grows by the keyframe, and loses those that have become redundant.
        submap = self._without_redundant(self._extended(keyframe.number, estimate), estimate.t_ns)
        # Loops: recognized places, and earlier keyframes that are expected to show the same
        recognized = [_loop(match) for match in self._recognizer.add(keyframe)]
        loops = [loop for loop in recognized if {loop.first, loop.second} <= submap.graph.poses.keys()]
        loops_between = [loop for loop in recognized if loop not in loops]
        if view.images is not None:
            loops += self._localized(submap.graph, keyframe, view.images)
            self._patches[keyframe.number] = landmark_patches(keyframe, view.images, self._config.localization)
        submap = self._joined(submap.with_loops(loops), loops_between, estimate.t_ns)
        # Pose graph optimization, which accepts or rejects the loops
        if self._is_due(submap, estimate.t_ns):
            submap = submap.optimized(estimate.t_ns)
        closed = self._newly_closed(submap)
        self._submaps = (*(each for each in self._submaps if not each.tracks & submap.tracks), submap)
        # Correction: the pose of the odometry frame in the map at this keyframe
        covariance = submap.covariance_in_map(keyframe.number)
        if self._is_in_map:
            T_map_odom = submap.graph.poses[keyframe.number] @ inverse_pose(estimate.T_odom_imu)
            correction = Correction(T_map_odom, estimate, covariance, self._track)
        else:
            correction = self._newest.located or Correction(None, estimate, covariance, self._track)
        return replace(
            correction,
            is_joined=correction.T_map_odom is not None and not had_map_pose,
            loops=closed,
            loop_times_ns=self._times_ns(closed),
            tested_loops=submap.tested_loops,
        )

    def _newly_closed(self, submap: Submap) -> tuple[RelativePose, ...]:
        """Return the accepted loops of a submap that no correction has contained, and remember them."""
        closed = tuple(loop for loop in submap.closed_loops if loop not in self._closed)
        connected_ns = (*self._connected_ns, *(self._keyframes[loop.second].t_ns for loop in closed))
        self._closed.update(closed)
        self._connected_ns = connected_ns[-MAX_CONNECTED:]
        return closed

    def _times_ns(self, loops: Sequence[RelativePose]) -> tuple[tuple[int, int], ...]:
        """Return the times of both keyframes of loops [ns], without those of a loaded map."""
        times_ns = ((self._keyframes[loop.first].t_ns, self._keyframes[loop.second].t_ns) for loop in loops)
        return tuple((then, now) for then, now in times_ns if then > LAST_KNOWN_NS)

    @property
    def _track(self) -> int:
        """Number of the newest track."""
        return len(self._starts_ns)

    @property
    def _map_submap(self) -> Submap | None:
        """The submap that is the map; None before its first keyframe."""
        return self._submap_of(self._map_track)

    @property
    def _is_in_map(self) -> bool:
        """Whether the newest track is part of the map."""
        map_submap = self._map_submap
        return self._track == self._map_track if map_submap is None else self._track in map_submap.tracks

    def _submap_of(self, track: int) -> Submap | None:
        """Return the submap of a track; None before its first keyframe."""
        return next((submap for submap in self._submaps if track in submap.tracks), None)

    def _keyframe(self, estimate: KeyframeEstimate, view: KeyframeView) -> MapKeyframe:
        """Return the next keyframe of the newest track."""
        T = estimate.T_odom_imu
        landmarks_imu = (estimate.landmarks_odom - T[:3, 3]) @ T[:3, :3]
        number, ids = len(self._keyframes), estimate.landmark_ids
        return MapKeyframe(number, estimate.t_ns, T, view.features, ids, landmarks_imu, self._track)

    def _extended(self, number: int, estimate: KeyframeEstimate) -> Submap:
        """Return the submap of the newest track with a new keyframe, the anchor from now on."""
        submap = self._submap_of(self._track)
        if submap is None:
            node, submap = first_node(number, estimate), Submap.begin(number, estimate, self._track)
        else:
            node, submap = submap.extended(self._nodes[number - 1], number, estimate)
        self._nodes[number] = node
        self._newest.young.append(number)
        return submap

    def _without_redundant(self, submap: Submap, t_ns: int) -> Submap:
        """Return a submap without the redundant ones of the keyframes that have become old enough."""
        young, min_age_ns = self._newest.young, self._config.min_age_s * 1e9
        while len(young) > 1 and t_ns - self._keyframes[young[0]].t_ns >= min_age_ns:
            number = young.popleft()
            if not self._is_redundant(submap, self._keyframes[number]):
                continue
            previous = next(each.first for each in reversed(submap.graph.odometry) if each.second == number)
            submap = submap.without(number, self._nodes[previous], self._nodes[young[0]].estimate)
            self._closed.update(submap.closed_loops)  # those that were passed on are not new
            self._recognizer.remove(number)
            self._keyframes[number] = self._keyframes[number].without_features
            self._patches.pop(number, None)
            del self._nodes[number]
        return submap

    def _is_redundant(self, submap: Submap, keyframe: MapKeyframe) -> bool:
        """Return whether an earlier keyframe shows what a keyframe shows, and loops connect their visits."""
        graph, c = submap.graph, self._config
        if keyframe.number in (graph.first, *graph.joined, *(loop.first for loop in graph.loops)):
            return False
        if not any(abs(t_ns - keyframe.t_ns) <= CONNECTED_WITHIN_S * 1e9 for t_ns in self._connected_ns):
            return False
        earlier = [k.number for k in self._references(graph, keyframe) if len(k.features) or k.number in self._nodes]
        if not earlier:
            return False
        Ts = np.stack([graph.poses[number] for number in earlier])
        return bool(nearest_views(Ts, graph.poses[keyframe.number], c.redundant))

    def _references(self, graph: PoseGraph, keyframe: MapKeyframe) -> list[MapKeyframe]:
        """Return the keyframes of a graph that are old enough for a keyframe to be localized in them."""
        age_ns = self._config.min_age_s * 1e9
        known = (self._keyframes[number] for number in graph.poses)
        return [k for k in known if k.track != keyframe.track or keyframe.t_ns - k.t_ns >= age_ns]

    def _joined(self, submap: Submap, loops: Sequence[RelativePose], t_ns: int) -> Submap:
        """Return a submap, joined with the others that its loops lead to.

        Two keyframes have to lead to the same pose, see `agreeing_loops`. The map stays where it is; of two other
        submaps, the earlier one does.
        """
        newest = self._newest
        newest.loops_between = (*newest.loops_between, *loops)[-MAX_BETWEEN:]
        for other in self._submaps:
            is_reached = any(loop.first in other.graph.poses for loop in loops)
            if not is_reached or other.tracks & submap.tracks:
                continue
            between = agreeing_loops(newest.loops_between, other, submap)
            if len({loop.second for loop in between}) > 1:
                submap = submap.joined(other, between, t_ns, other_stays=self._map_track not in submap.tracks) or submap
        return submap

    def _is_due(self, submap: Submap, t_ns: int) -> bool:
        """Return whether a submap has loops to optimize, and the last optimization is long enough ago."""
        c = self._config
        interval_s = c.optimization_interval_s * max(submap.tested_loops / c.interval_loops, 1.0)
        is_late = submap.optimized_ns is None or t_ns - submap.optimized_ns >= interval_s * 1e9
        return submap.waiting > 0 and is_late

    def _localized(self, graph: PoseGraph, keyframe: MapKeyframe, images: KeyframeImages) -> list[RelativePose]:
        """Return the poses of a keyframe in the frames of earlier ones that are expected to show the same place."""
        last_ns = self._newest.localized_ns
        if last_ns is not None and keyframe.t_ns - last_ns < LOCALIZATION_INTERVAL_S * 1e9:
            return []
        old = [k for k in self._references(graph, keyframe) if k.number in self._patches]
        if not old:
            return []
        T_map_imu, loops = graph.poses[keyframe.number], []
        for row in nearest_views(np.stack([graph.poses[k.number] for k in old]), T_map_imu, self._config.covisibility):
            match = old[row]
            predicted = inverse_pose(graph.poses[match.number]) @ T_map_imu
            patches = self._patches[match.number]
            result = self._localizer.localize(keyframe, images, match, patches, predicted)
            if result is not None:
                loops.append(result)
        if loops:
            self._newest.localized_ns = keyframe.t_ns
        return loops


def _loop(match: PlaceMatch) -> RelativePose:
    """Return a verified match as a factor of the pose graph."""
    return RelativePose.measured(match.match, match.query, match.T_match_query, match.covariance, match.observations)
