"""The dense map of a flight: depth images become a local map and submaps, which the correction by the map places."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from dronevio.estimator.mapping.config import DenseMapConfig
from dronevio.estimator.mapping.depth_source import DepthSource, depth_source
from dronevio.estimator.mapping.evidence import evidence
from dronevio.estimator.mapping.local_map import LocalMap
from dronevio.estimator.mapping.placing import bounds, fused, placed
from dronevio.estimator.mapping.submap import ActiveSubmap, Anchor, PackedSubmap
from dronevio.estimator.mapping.submap_store import StoredSubmap, SubmapStore
from dronevio.models.arrays import Array, Integers
from dronevio.models.depth import DepthImage
from dronevio.models.map_correction import MapCorrection
from dronevio.models.occupancy import DistanceField, OccupancyGrid, PlacedSubmap
from dronevio.models.rig import Rig
from dronevio.models.state import CameraFrame, Estimate, Health

_EARLY_NS = 1_000_000
"""How much earlier than it is due a frame enters the map, for time stamps that jitter [ns]."""


@dataclass(eq=False)
class _Track:
    """The maps in the newest odometry frame."""

    number: int
    """Number of the odometry frame."""
    local: LocalMap
    """The local map."""
    submap: ActiveSubmap
    """The submap that gathers evidence."""


class DenseMapper:
    """Builds a dense map from frames and their estimates.

    Each depth image is evidence about cells of the odometry frame, for the local map and for a submap. The local map
    is never bent. Submaps are placed in the map frame by the correction of the newest estimate. After a loss, there is
    a new local map, and earlier submaps are placed again when their track and the new one are joined.

    Example:
        >>> slam, mapper = VisualSlam(rig), DenseMapper(rig)
        >>> for measurement in measurements(recording):
        ...     if isinstance(measurement, ImuSamples):
        ...         slam.add_imu(measurement)
        ...     else:
        ...         mapper.add_frame(measurement, slam.add_frame(measurement))
        ...         grid = mapper.local_map
    """

    def __init__(self, rig: Rig, config: DenseMapConfig | None = None, source: DepthSource | None = None) -> None:
        """Begin with an empty map.

        Args:
            rig: The calibration of the cameras.
            config: Settings.
            source: Computes depth images; by default from the best stereo pair of the rig, or from the
                motion of its camera.

        Raises:
            ConfigError: There is no source, and the rig has no camera.
        """
        self._config = c = config or DenseMapConfig()
        self._source = source or depth_source(rig)
        self._store = SubmapStore(c.memory_mb)
        self._track: _Track | None = None
        self._newest: Estimate | None = None
        self._begun = 0
        self._due_ns: int | None = None  # time from which on a frame enters the map

    def add_frame(self, frame: CameraFrame, estimate: Estimate) -> DepthImage | None:
        """Add a frame with its estimate; return its depth image, None if the frame does not enter the map."""
        c = self._config
        self._newest = estimate
        if self._track is not None and estimate.track != self._track.number:  # another odometry frame
            self._store.add(self._track.submap.closed())
            self._track = None
        due_ns, period_ns = self._due_ns, round(1e9 / c.rate_hz)
        is_early = due_ns is not None and frame.t_ns < due_ns - _EARLY_NS
        if is_early or estimate.health is not Health.TRACKING or estimate.T_odom_imu is None:
            return None
        # The next one is due a period after this one was, so that the mean rate does not depend on that of the frames
        is_regular = due_ns is not None and frame.t_ns < due_ns + period_ns
        self._due_ns = period_ns + (due_ns if due_ns is not None and is_regular else frame.t_ns)
        depth = self._source.depth(frame, estimate)
        if depth is not None:
            self.add_depth(depth)
        return depth

    def add_depth(self, depth: DepthImage) -> None:
        """Add a depth image of the odometry frame of the newest estimate."""
        c, p = self._config, depth.T_odom_cam[:3, 3]
        if self._track is None:
            number = 0 if self._newest is None else self._newest.track
            self._track = _Track(number, LocalMap(c.cell_m), self._begin(depth, number))
        track = self._track
        track.local.centre_on(p)
        if track.submap.path_m > c.submap_m:
            self._store.add(track.submap.closed())
            track.submap = self._begin(depth, track.number)
        found = evidence(depth, c.cell_m, c.range_m)
        track.local.add(found)
        track.submap.add(found, p)

    def _begin(self, depth: DepthImage, track: int) -> ActiveSubmap:
        """Return the next submap, which begins with a depth image."""
        self._begun += 1
        return ActiveSubmap(Anchor(self._begun - 1, track, depth.t_ns), depth.T_odom_cam[:3, 3])

    @property
    def local_map(self) -> OccupancyGrid | None:
        """The local map around the drone, in the odometry frame; None before the first depth image and after a loss."""
        return None if self._track is None else self._track.local.grid()

    def local_distance(self, *, unknown_is_obstacle: bool) -> DistanceField | None:
        """Return the distances to obstacles in the local map; None without one."""
        track = self._track
        return None if track is None else track.local.distance_field(unknown_is_obstacle=unknown_is_obstacle)

    @property
    def submaps(self) -> tuple[PlacedSubmap, ...]:
        """The submaps in the order of time, with their poses by the newest correction."""
        cell_m = self._config.cell_m
        loaded = ((_loaded(submap), T) for submap, T in self._all_placed())
        return tuple(
            PlacedSubmap(s.anchor.number, s.anchor.track, s.anchor.t_ns, T, s.log_odds.grid(cell_m)) for s, T in loaded
        )

    @property
    def packed_bytes(self) -> int:
        """Size of all submaps in their packed form, in memory and in files [B]."""
        return sum(len(_loaded(submap).data) for submap, _ in self._all_placed())

    def fused(self, low_m: Array | None = None, high_m: Array | None = None) -> OccupancyGrid | None:
        """Return the map of all submaps that are joined with it, in the map frame; None without one.

        Args:
            low_m: (3,) Lower corner of a window [m]; None for the whole map.
            high_m: (3,) Its upper corner [m]; None for the whole map.
        """
        cell_m = self._config.cell_m
        joined = [(submap, T) for submap, T in self._all_placed() if T is not None and 0 not in submap.shape]
        if not joined:
            return None
        boxes = np.array([bounds(submap.low, submap.shape, T, cell_m) for submap, T in joined])
        low: Integers = boxes[:, 0].min(axis=0) if low_m is None else np.floor(low_m / cell_m).astype(np.int64)
        high: Integers = boxes[:, 1].max(axis=0) if high_m is None else np.ceil(high_m / cell_m).astype(np.int64)
        seen = np.all((boxes[:, 0] < high) & (boxes[:, 1] > low), axis=1)
        chosen = ((_loaded(submap), T) for (submap, T), is_seen in zip(joined, seen, strict=True) if is_seen)
        return fused(chosen, low, high, cell_m)

    def correct(self, correction: MapCorrection) -> None:
        """Place the submaps by another correction than that of the newest estimate, such as that of the final map."""
        if self._newest is not None:
            self._newest = replace(self._newest, map_correction=correction)

    def close(self) -> None:
        """Delete the files of the map, which otherwise end with this object."""
        self._store.close()

    def _all_placed(self) -> Iterator[tuple[PackedSubmap | StoredSubmap, Array | None]]:
        """Return all submaps in the order of time, with their poses in the map frame."""
        if self._newest is None:
            return
        active = () if self._track is None else (self._track.submap.closed(),)
        for submap in (*self._store.all, *active):
            yield submap, placed(submap.anchor, self._newest)


def _loaded(submap: PackedSubmap | StoredSubmap) -> PackedSubmap:
    """Return a submap with its cells."""
    return submap.load() if isinstance(submap, StoredSubmap) else submap
