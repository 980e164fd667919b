"""The mapper: keyframes of the odometry become a map, and recognized places correct the odometry.

A keyframe waits with its features until it leaves the odometry's window. It then joins the map with its final pose,
recognized places become loops of the pose graph, and the graph is optimized. The correction of the odometry is the pose
of the odometry frame in the map frame at the newest keyframe of the map, the anchor.
"""

from dataclasses import dataclass, field, replace
from typing import Annotated, Protocol

import numpy as np
import numpy.typing as npt

from dronevio.estimator.backend.departure import Departure
from dronevio.estimator.slam.keyframe import KeyframeFeatures, MapKeyframe
from dronevio.estimator.slam.localization import (
    KeyframeImages,
    LandmarkPatches,
    LocalizationConfig,
    Localizer,
    landmark_patches,
)
from dronevio.estimator.slam.map_arrays import slam_map
from dronevio.estimator.slam.odometry_factors import (
    OdometryNode,
    RelativePose,
    first_node,
    odometry_factors,
    propagated,
)
from dronevio.estimator.slam.pose_graph import OptimizedGraph, PoseGraph, marginal_covariance, optimize
from dronevio.estimator.slam.verification import PlaceMatch
from dronevio.models.ranges import Range, Settings
from dronevio.models.rotation import inverse_pose
from dronevio.models.slam_map import SlamMap

Array = npt.NDArray[np.float64]

MIN_SEPARATION = 4
"""Number of keyframes between two in which one is localized, so that these show different landmarks."""


class Recognizer(Protocol):
    """Recognizes places of earlier keyframes."""

    def add(self, keyframe: MapKeyframe, /) -> tuple[PlaceMatch, ...]:
        """Add a keyframe, and return the confirmed matches of it and of keyframes before it with earlier ones."""


@dataclass(frozen=True)
class MappingConfig(Settings):
    """Settings of the mapper."""

    localization: LocalizationConfig = field(default_factory=LocalizationConfig)
    """Settings of the localization of keyframes in the map."""
    optimization_interval_s: Annotated[float, Range(low=0.0)] = 1.0
    """Shortest time of flight between two optimizations of the pose graph [s]."""
    interval_loops: Annotated[int, Range(1, 1_000_000)] = 300
    """Number of loops beyond which that time grows in proportion to it, as the cost of an optimization does."""
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


@dataclass(frozen=True, eq=False)
class Correction:
    """What the map tells the odometry."""

    T_map_odom: Array
    """(4, 4) Pose of the odometry frame in the map frame at the anchor."""
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
    loop_times_ns: tuple[tuple[int, int], ...] = ()
    """Times of the earlier and the later keyframe of each closed loop [ns]."""


@dataclass(frozen=True)
class MapSummary:
    """Size of a map."""

    keyframes: int
    """Number of keyframes."""
    loops: int
    """Number of loops that are closed."""
    rejected_loops: int
    """Number of loops that contradict the others, or wait for the next optimization."""


class Mapper:
    """Builds a map from the keyframes of one continuous odometry."""

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
        self._keyframes: list[MapKeyframe] = []
        self._solution: OptimizedGraph | None = None
        self._anchor: OdometryNode | None = None
        self._covariance: Array | None = None  # of the newest keyframe's pose in the map
        self._judged = 0  # number of loops that have been judged by an optimization
        self._optimized_ns: int | None = None

    @property
    def graph(self) -> PoseGraph | None:
        """The pose graph with all loops; None before the first keyframe."""
        return None if self._solution is None else self._solution.graph

    @property
    def keyframes(self) -> tuple[MapKeyframe, ...]:
        """The keyframes of the map in the order of time."""
        return tuple(self._keyframes)

    @property
    def summary(self) -> MapSummary:
        """Size of the map."""
        solution = self._solution
        loops, rejected = (0, 0) if solution is None else (len(solution.graph.loops), len(solution.rejected))
        return MapSummary(len(self._keyframes), loops - rejected, rejected)

    def final_solution(self) -> OptimizedGraph | None:
        """Return the pose graph of the whole flight, optimized with all loops; None before the first keyframe."""
        return None if self._solution is None else optimize(self._solution.graph)

    def map_of(self, solution: OptimizedGraph) -> SlamMap:
        """Return the map as arrays, with the poses of a solution."""
        return slam_map(solution, self._keyframes)

    def add(self, keyframe: WaitingKeyframe, window_times_ns: tuple[int, ...]) -> None:
        """Add a new keyframe of the odometry.

        Args:
            keyframe: The keyframe.
            window_times_ns: Times of the keyframes that are in the window [ns]; others no longer wait.
        """
        self._waiting = {t: known for t, known in self._waiting.items() if t in window_times_ns}
        self._waiting[keyframe.t_ns] = keyframe

    def depart(self, departure: Departure) -> Correction | None:
        """Let a keyframe join the map.

        Returns:
            The correction of the odometry; None if the keyframe has no image.
        """
        waiting = self._waiting.pop(departure.t_ns, None)
        if waiting is None:
            return None
        number = len(self._keyframes)
        T = departure.T_odom_imu
        landmarks_imu = (departure.landmarks_odom - T[:3, 3]) @ T[:3, :3]
        keyframe = MapKeyframe(number, departure.t_ns, T, waiting.features, departure.landmark_ids, landmarks_imu)
        self._keyframes.append(keyframe)
        before = self._solution
        self._anchor, graph = self._extended(number, departure)
        loops = [_loop(match) for match in self._recognizer.add(keyframe)]
        if waiting.images is not None:
            loops += self._localized(graph, keyframe, waiting.images)
            self._patches[number] = landmark_patches(keyframe, waiting.images, self._config.localization)
        graph = graph.with_loops(loops)
        self._solution, closed, rejected = self._optimized(graph, departure.t_ns)
        solution = self._solution
        self._covariance = covariance = self._marginal(before, solution)
        T_map_odom = solution.graph.poses[number] @ inverse_pose(T)
        times = tuple((self._keyframes[loop.first].t_ns, self._keyframes[loop.second].t_ns) for loop in closed)
        return Correction(T_map_odom, departure.t_ns, covariance, departure.covariance, closed, rejected, times)

    def _extended(self, number: int, departure: Departure) -> tuple[OdometryNode, PoseGraph]:
        """Return the newest keyframe and the graph with its pose, as the odometry continues from the last one."""
        if self._anchor is None or self._solution is None:
            node = first_node(number, departure)
            return node, PoseGraph(number, departure.covariance, {number: departure.T_odom_imu})
        graph = self._solution.graph
        node, relative, gravity = odometry_factors(self._anchor, number, departure)
        poses = {**graph.poses, number: graph.poses[relative.first] @ relative.T_first_second}
        directions = graph.gravity if gravity is None else (*graph.gravity, gravity)
        return node, replace(graph, poses=poses, odometry=(*graph.odometry, relative), gravity=directions)

    def _marginal(self, before: OptimizedGraph | None, after: OptimizedGraph) -> Array:
        """Return the marginal covariance (6, 6) of the newest keyframe.

        That of the graph is computed where its loops have changed. Otherwise the keyframe only continues the graph.
        """
        newest = len(self._keyframes) - 1
        if before is None or self._covariance is None:
            return after.graph.first_covariance
        if before.closed != after.closed:
            return marginal_covariance(after.without_rejected, newest)
        gravity = after.graph.gravity[-1] if len(after.graph.gravity) > len(before.graph.gravity) else None
        return propagated(self._covariance, after.graph.odometry[-1], gravity)

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
        old = [k.number for k in self._keyframes if keyframe.t_ns - k.t_ns >= c.min_age_s * 1e9]
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

    def _optimized(self, graph: PoseGraph, t_ns: int) -> tuple[OptimizedGraph, tuple[RelativePose, ...], int]:
        """Return the optimized graph, if there are new loops and the last time is long enough ago.

        Returns:
            The graph, the loops that were closed, and the number of rejected ones.
        """
        before = self._solution
        rejected = before.rejected if before else frozenset[int]()
        c = self._config
        interval_s = c.optimization_interval_s * max(self._judged / c.interval_loops, 1.0)
        is_due = self._optimized_ns is None or t_ns - self._optimized_ns >= interval_s * 1e9
        if len(graph.loops) == self._judged or not is_due:
            waiting = range(self._judged, len(graph.loops))
            return OptimizedGraph(graph, frozenset({*rejected, *waiting})), (), 0
        solution = optimize(graph)
        self._optimized_ns, since, self._judged = t_ns, self._judged, len(graph.loops)
        new = [i for i in range(since, len(graph.loops)) if i not in solution.rejected]
        closed = tuple(graph.loops[i] for i in new)
        return solution, closed, len(graph.loops) - since - len(new)


def _loop(match: PlaceMatch) -> RelativePose:
    """Return a verified match as a factor of the pose graph."""
    return RelativePose.measured(match.match, match.query, match.T_match_query, match.covariance)
