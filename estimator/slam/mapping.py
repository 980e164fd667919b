"""The mapper: keyframes of the odometry become a map, and recognized places correct the odometry.

A keyframe waits with its features until it leaves the odometry's window. It then joins the map with its final pose,
recognized places become loops of the pose graph, and the graph is optimized. The correction of the odometry is the pose
of the odometry frame in the map frame at the newest keyframe of the map, the anchor.

After a loss, the odometry begins another track. It is a submap of its own, with its own pose graph, until a place of
another submap is recognized; the two are then joined. The submap with the first track is the map. Keyframes of
another submap are also compared with the map as soon as they are added, so that the pose in the map is known before the
first of them leaves the window.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Protocol

import numpy as np
import numpy.typing as npt

from dronevio.estimator.backend.departure import Departure
from dronevio.estimator.slam.correction import MapCorrection
from dronevio.estimator.slam.keyframe import KeyframeFeatures, MapKeyframe
from dronevio.estimator.slam.localization import (
    KeyframeImages,
    LandmarkPatches,
    LocalizationConfig,
    Localizer,
    landmark_patches,
)
from dronevio.estimator.slam.odometry_factors import (
    OdometryNode,
    RelativePose,
    first_node,
    odometry_factors,
)
from dronevio.estimator.slam.pose_graph import (
    OptimizedGraph,
    PoseGraph,
    joined_graphs,
    marginal_covariance,
    optimize,
)
from dronevio.estimator.slam.verification import PlaceMatch
from dronevio.estimator.types import Integers
from dronevio.models.ranges import Range, Settings
from dronevio.models.rotation import inverse_pose
from dronevio.models.state import NavState

Array = npt.NDArray[np.float64]

FIRST_NS = -(2**62)
"""Time before all others, at which the first track begins [ns]."""
MIN_MAP_KEYFRAMES = 5
"""Number of keyframes below which a map is given up when the odometry is lost: the next track begins another one."""
MIN_SEPARATION = 4
"""Number of keyframes between two in which one is localized, so that these show different landmarks."""


class Recognizer(Protocol):
    """Recognizes places of earlier keyframes."""

    def add(self, keyframe: MapKeyframe, /) -> tuple[PlaceMatch, ...]:
        """Add a keyframe, and return the confirmed matches of it and of keyframes before it with earlier ones."""

    def locate(self, keyframe: MapKeyframe, /) -> PlaceMatch | None:
        """Return the confirmed match of a keyframe that is not added yet; None without one."""

    def start_track(self) -> None:
        """Declare that the following keyframes have another odometry frame."""


@dataclass(frozen=True)
class MappingConfig(Settings):
    """Settings of the mapper."""

    localization: LocalizationConfig = field(default_factory=LocalizationConfig)
    """Settings of the localization of keyframes in the map."""
    optimization_interval_s: Annotated[float, Range(low=0.0)] = 1.0
    """Shortest time of flight between two optimizations of the pose graph [s]."""
    localization_interval_s: Annotated[float, Range(low=0.0)] = 0.5
    """Shortest time of flight between two keyframes that are localized in the map [s]."""
    min_age_s: Annotated[float, Range(0.0, 3600.0)] = 10.0
    """Smallest age of a keyframe in which another one is localized [s]."""
    max_distance_m: Annotated[float, Range(0.01, 100.0)] = 1.5
    """Largest distance of two keyframes that are expected to show the same place [m]."""
    max_angle_deg: Annotated[float, Range(1.0, 180.0)] = 30.0
    """Largest angle between their orientations [°]."""
    references: Annotated[int, Range(1, 20)] = 2
    """Number of earlier keyframes in which one is localized."""


@dataclass(frozen=True, eq=False)
class WaitingKeyframe:
    """A keyframe of the odometry's window that waits to join the map."""

    t_ns: int
    """Time of the keyframe by the IMU's clock [ns]."""
    features: KeyframeFeatures
    """The corners of its images."""
    images: KeyframeImages | None = None
    """Its images, which are used once more when it joins the map."""
    state: NavState | None = None
    """Its causal estimate, by which it is compared with the map at once; None if it is not."""
    landmark_ids: Integers = field(default_factory=lambda: np.zeros(0, np.int64))
    """(L,) Identities of the triangulated landmarks that it observes, in increasing order."""
    landmarks_odom: Array = field(default_factory=lambda: np.zeros((0, 3)))
    """(L, 3) Their positions in the odometry frame, as they are known now [m]."""


@dataclass(frozen=True, eq=False)
class Correction:
    """What the map tells the odometry."""

    T_map_odom: Array | None
    """(4, 4) Pose of the odometry frame in the map frame at the anchor; None where the submap is not joined."""
    anchor_t_ns: int
    """Time of the anchor, the newest keyframe of the map [ns]."""
    anchor_covariance: Array
    """(6, 6) Covariance of the anchor's pose in the map: δθ, then δp, both in the IMU frame."""
    odometry_covariance: Array
    """(6, 6) Covariance of the anchor's pose by the odometry alone."""
    loops: tuple[RelativePose, ...] = ()
    """Loops that were closed since the last correction."""
    rejected: int = 0
    """Number of loops that were rejected since the last correction."""
    track: int = 0
    """Number of the odometry frame; a correction of an earlier one is no longer valid."""
    is_joined: bool = False
    """Whether the track of the odometry has been joined with the map by this correction."""


@dataclass(frozen=True)
class MapSummary:
    """Size of a map."""

    keyframes: int
    """Number of keyframes."""
    loops: int
    """Number of loops that are closed."""
    rejected_loops: int
    """Number of loops that contradict the others, or wait for the next optimization."""
    submaps: int = 0
    """Number of tracks of the odometry that are not joined with the map."""


@dataclass(frozen=True, eq=False)
class _Submap:
    """A pose graph of one or several tracks of the odometry."""

    solution: OptimizedGraph
    tracks: frozenset[int]  # numbers of the tracks
    judged: int = 0  # number of loops that have been judged by an optimization
    optimized_ns: int | None = None  # time of the last optimization

    @property
    def graph(self) -> PoseGraph:
        return self.solution.graph


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
        self._localized_ns: int | None = None
        self._waiting: dict[int, WaitingKeyframe] = {}
        self._keyframes: dict[int, MapKeyframe] = {}
        self._next_number = 0
        self._submaps: tuple[_Submap, ...] = ()
        self._home = 0  # track of which the submap is the map
        self._track = 0
        self._starts_ns: list[int | None] = [None]  # times at which the tracks begin; None for the first
        self._anchor: OdometryNode | None = None
        self._located: Array | None = None  # pose of the odometry frame by a place, before the track is joined

    @property
    def graph(self) -> PoseGraph | None:
        """The pose graph of the map with all loops; None before the first keyframe."""
        home = self._submap_of(self._home)
        return None if home is None else home.graph

    @property
    def keyframes(self) -> tuple[MapKeyframe, ...]:
        """The keyframes of the map in the order in which they were added."""
        graph = self.graph
        return () if graph is None else tuple(k for number, k in self._keyframes.items() if number in graph.poses)

    @property
    def summary(self) -> MapSummary:
        """Size of the map."""
        home, tracks = self._submap_of(self._home), {keyframe.track for keyframe in self._keyframes.values()}
        if home is None:
            return MapSummary(0, 0, 0)
        loops, rejected = len(home.graph.loops), len(home.solution.rejected)
        return MapSummary(len(home.graph.poses), loops - rejected, rejected, len(tracks - home.tracks))

    def final_correction(self) -> MapCorrection | None:
        """Return the correction of the whole flight by all loops; None before the first keyframe."""
        graph = self.graph
        if graph is None:
            return None
        poses = optimize(graph).graph.poses
        keyframes = self.keyframes
        t_ns = np.array([keyframe.t_ns for keyframe in keyframes], dtype=np.int64)
        Ts = np.stack([poses[keyframe.number] @ inverse_pose(keyframe.T_odom_imu) for keyframe in keyframes])
        track = np.array([keyframe.track for keyframe in keyframes], dtype=np.int64)
        starts_ns = np.array([FIRST_NS if start is None else start for start in self._starts_ns], dtype=np.int64)
        return MapCorrection(t_ns, Ts, track, starts_ns)

    def start_track(self, t_ns: int) -> None:
        """Declare that the odometry is lost: later keyframes are in another odometry frame.

        Args:
            t_ns: Time of the loss [ns].
        """
        home = self._submap_of(self._home)
        self._track += 1
        self._starts_ns.append(t_ns)
        self._recognizer.start_track()
        self._waiting, self._anchor, self._located, self._localized_ns = {}, None, None, None
        if home is None or len(home.graph.poses) < MIN_MAP_KEYFRAMES:
            self._home = self._track  # there is nothing yet that could be recognized

    def add(self, keyframe: WaitingKeyframe, window_times_ns: tuple[int, ...]) -> Correction | None:
        """Add a new keyframe of the odometry.

        Args:
            keyframe: The keyframe.
            window_times_ns: Times of the keyframes that are in the window [ns]; others no longer wait.

        Returns:
            The correction of the odometry, if the track is not joined with the map and the keyframe shows a place of
            the map; otherwise None.
        """
        self._waiting = {t: known for t, known in self._waiting.items() if t in window_times_ns}
        self._waiting[keyframe.t_ns] = keyframe
        return None if self._is_at_home or self._located is not None else self._locate(keyframe)

    def depart(self, departure: Departure) -> Correction | None:
        """Let a keyframe join its submap.

        Returns:
            The correction of the odometry; None if the keyframe has no image.
        """
        waiting = self._waiting.pop(departure.t_ns, None)
        if waiting is None:
            return None
        number, T = self._next_number, departure.T_odom_imu
        self._next_number += 1
        landmarks_imu = (departure.landmarks_odom - T[:3, 3]) @ T[:3, :3]
        keyframe = MapKeyframe(
            number, departure.t_ns, T, waiting.features, departure.landmark_ids, landmarks_imu, self._track
        )
        self._keyframes[number] = keyframe
        self._anchor, submap = self._extended(number, departure)
        was_at_home = self._is_at_home
        loops = [_loop(match) for match in self._recognizer.add(keyframe)]
        inner = [loop for loop in loops if loop.first in submap.graph.poses]
        if waiting.images is not None:
            inner += self._localized(submap.graph, keyframe, waiting.images)
            self._patches[number] = landmark_patches(keyframe, waiting.images, self._config.localization)
        submap = replace(submap, solution=replace(submap.solution, graph=submap.graph.with_loops(inner)))
        joined = self._joined(submap, [loop for loop in loops if loop.first not in submap.graph.poses])
        submap, closed, rejected = self._optimized(joined, departure.t_ns, is_due=joined is not submap)
        self._submaps = (*(each for each in self._submaps if not each.tracks & submap.tracks), submap)
        solution = submap.solution
        is_corrected = len(solution.graph.loops) > len(solution.rejected)
        covariance = marginal_covariance(solution.without_rejected, number) if is_corrected else self._anchor.covariance
        T_map_odom = solution.graph.poses[number] @ inverse_pose(T) if self._is_at_home else self._located
        return Correction(
            T_map_odom,
            departure.t_ns,
            covariance,
            departure.covariance,
            closed,
            rejected,
            self._track,
            is_joined=self._is_at_home and not was_at_home and self._located is None and self._track != self._home,
        )

    def _submap_of(self, track: int) -> _Submap | None:
        """Return the submap of a track; None before its first keyframe."""
        return next((submap for submap in self._submaps if track in submap.tracks), None)

    @property
    def _is_at_home(self) -> bool:
        """Whether the newest track is part of the map."""
        home = self._submap_of(self._home)
        return self._track == self._home if home is None else self._track in home.tracks

    def _locate(self, waiting: WaitingKeyframe) -> Correction | None:
        """Return the correction of a track that is not joined, if its newest keyframe shows a place of the map."""
        home = self._submap_of(self._home)
        if home is None or waiting.state is None:
            return None
        T = waiting.state.T_world_imu
        landmarks_imu = (waiting.landmarks_odom - T[:3, 3]) @ T[:3, :3]
        keyframe = MapKeyframe(
            self._next_number, waiting.t_ns, T, waiting.features, waiting.landmark_ids, landmarks_imu, self._track
        )
        match = self._recognizer.locate(keyframe)
        if match is None or match.match not in home.graph.poses:
            return None
        loop = _loop(match)
        patches = self._patches.get(match.match)
        if waiting.images is not None and patches is not None:
            refined = self._localizer.localize(
                keyframe, waiting.images, self._keyframes[match.match], patches, match.T_match_query
            )
            loop = refined or loop
        self._located = home.graph.poses[match.match] @ loop.T_first_second @ inverse_pose(T)
        covariance = loop.covariance
        P = covariance if waiting.state.covariance is None else waiting.state.covariance[:6, :6]
        return Correction(self._located, waiting.t_ns, covariance, P, track=self._track, is_joined=True)

    def _extended(self, number: int, departure: Departure) -> tuple[OdometryNode, _Submap]:
        """Return the newest keyframe and its submap with its pose, as the odometry continues from the last one."""
        submap = self._submap_of(self._track)
        if self._anchor is None or submap is None:
            node = first_node(number, departure)
            graph = PoseGraph(number, departure.covariance, {number: departure.T_odom_imu})
            return node, _Submap(OptimizedGraph(graph, frozenset()), frozenset({self._track}))
        graph = submap.graph
        node, relative, gravity = odometry_factors(self._anchor, number, departure)
        poses = {**graph.poses, number: graph.poses[relative.first] @ relative.T_first_second}
        directions = graph.gravity if gravity is None else (*graph.gravity, gravity)
        graph = replace(graph, poses=poses, odometry=(*graph.odometry, relative), gravity=directions)
        return node, replace(submap, solution=replace(submap.solution, graph=graph))

    def _joined(self, submap: _Submap, loops: Sequence[RelativePose]) -> _Submap:
        """Return a submap, joined with the others that its loops lead to.

        Graduated non-convexity judges the loops. Where it rejects all of those between two submaps, they stay apart.
        """
        for other in self._submaps:
            between = [loop for loop in loops if loop.first in other.graph.poses]
            if not between or other.tracks & submap.tracks:
                continue
            newest = between[-1]
            T_submap_match = submap.graph.poses[newest.second] @ inverse_pose(newest.T_first_second)
            T_submap_other = T_submap_match @ inverse_pose(other.graph.poses[newest.first])
            # The map stays where it is; of two other submaps, the earlier one does.
            if self._home in submap.tracks:
                graph = joined_graphs(submap.graph, other.graph, T_submap_other)
            else:
                graph = joined_graphs(other.graph, submap.graph, inverse_pose(T_submap_other))
            graph = graph.with_loops(between)
            solution = optimize(graph)
            if all(i in solution.rejected for i in range(len(graph.loops) - len(between), len(graph.loops))):
                continue
            tracks = submap.tracks | other.tracks
            submap = _Submap(OptimizedGraph(solution.graph, frozenset()), tracks)
        return submap

    def _localized(self, graph: PoseGraph, keyframe: MapKeyframe, images: KeyframeImages) -> list[RelativePose]:
        """Return the poses of a keyframe in the frames of earlier ones that are expected to show the same place."""
        c = self._config
        is_due = self._localized_ns is None or keyframe.t_ns - self._localized_ns >= c.localization_interval_s * 1e9
        if not is_due:
            return []
        found = []
        T_map_imu = graph.poses[keyframe.number]
        for number in self._references(graph, keyframe):
            predicted = inverse_pose(graph.poses[number]) @ T_map_imu
            match = self._keyframes[number]
            result = self._localizer.localize(keyframe, images, match, self._patches[number], predicted)
            if result is not None:
                found.append(result)
        if found:
            self._localized_ns = keyframe.t_ns
        return found

    def _references(self, graph: PoseGraph, keyframe: MapKeyframe) -> list[int]:
        """Return the numbers of the earlier keyframes whose views are most like that of a new one."""
        c = self._config
        old = [
            k.number
            for k in self._keyframes.values()
            if k.number in graph.poses
            and k.number in self._patches
            and (k.track != keyframe.track or keyframe.t_ns - k.t_ns >= c.min_age_s * 1e9)
        ]
        if not old:
            return []
        Ts, T = np.stack([graph.poses[k] for k in old]), graph.poses[keyframe.number]
        distance_m = np.linalg.norm(Ts[:, :3, 3] - T[:3, 3], axis=1)
        cosine = (np.einsum("nij,ij->n", Ts[:, :3, :3], T[:3, :3]) - 1.0) / 2.0
        angle_rad = np.arccos(np.clip(cosine, -1.0, 1.0))
        distance, angle = distance_m / c.max_distance_m, angle_rad / np.radians(c.max_angle_deg)
        is_near = np.maximum(distance, angle) < 1.0
        near = np.flatnonzero(is_near)
        chosen: list[int] = []
        for index in near[np.argsort((distance + angle)[near])].tolist():
            if len(chosen) < c.references and all(abs(old[index] - other) > MIN_SEPARATION for other in chosen):
                chosen.append(old[index])
        return chosen

    def _optimized(self, submap: _Submap, t_ns: int, *, is_due: bool) -> tuple[_Submap, tuple[RelativePose, ...], int]:
        """Return an optimized submap, if there are new loops and the last time is long enough ago.

        Args:
            submap: The submap.
            t_ns: Time of the newest keyframe [ns].
            is_due: Whether it is optimized although the last time is not long enough ago.

        Returns:
            The submap, the loops that were closed, and the number of rejected ones.
        """
        graph, interval_ns = submap.graph, self._config.optimization_interval_s * 1e9
        is_due |= submap.optimized_ns is None or t_ns - submap.optimized_ns >= interval_ns
        if len(graph.loops) == submap.judged or not is_due:
            waiting = range(submap.judged, len(graph.loops))
            rejected = frozenset({*submap.solution.rejected, *waiting})
            return replace(submap, solution=OptimizedGraph(graph, rejected)), (), 0
        solution = optimize(graph)
        new = [i for i in range(submap.judged, len(graph.loops)) if i not in solution.rejected]
        closed = tuple(graph.loops[i] for i in new)
        rejections = len(graph.loops) - submap.judged - len(new)
        return _Submap(solution, submap.tracks, len(graph.loops), t_ns), closed, rejections


def _loop(match: PlaceMatch) -> RelativePose:
    """Return a verified match as a factor of the pose graph."""
    S = np.eye(6)
    S[3:, 3:] = match.T_match_query[:3, :3].T  # from the IMU frame of the old keyframe to that of the new one
    return RelativePose(match.match, match.query, match.T_match_query, S @ match.covariance @ S.T)
