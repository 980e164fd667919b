"""The dense map of a flight: depth images become a local map and submaps."""

import numpy as np

from dronevio.estimator.mapping.config import DenseMapConfig
from dronevio.estimator.mapping.depth_source import depth_source
from dronevio.estimator.mapping.evidence import evidence
from dronevio.estimator.mapping.log_odds import LogOdds
from dronevio.models.depth import DepthImage
from dronevio.models.occupancy import UNKNOWN, OccupancyGrid, PlacedSubmap
from dronevio.models.rig import Rig
from dronevio.models.state import CameraFrame, Estimate, Health

LOCAL_SIZE_M = (8.0, 8.0, 4.0)
"""Extent of the local map [m]."""


class DenseMapper:
    """Builds a dense map from frames and their estimates.

    Example:
        >>> slam, mapper = VisualSlam(rig), DenseMapper(rig)
        >>> for measurement in measurements(recording):
        ...     if isinstance(measurement, ImuSamples):
        ...         slam.add_imu(measurement)
        ...     else:
        ...         mapper.add_frame(measurement, slam.add_frame(measurement))
        ...         grid = mapper.local_map
    """

    def __init__(self, rig: Rig, config: DenseMapConfig | None = None) -> None:
        """Begin with an empty map."""
        self._config = config or DenseMapConfig()
        self._source = depth_source(rig)
        self._size = np.round(np.array(LOCAL_SIZE_M) / self._config.cell_m).astype(np.int64)
        self._local: LogOdds | None = None
        self._submap: LogOdds | None = None
        self._anchor_ns = 0
        self._last_ns: int | None = None

    def add_frame(self, frame: CameraFrame, estimate: Estimate) -> DepthImage | None:
        """Add a frame with its estimate; return its depth image, None if the frame does not enter the map."""
        c = self._config
        due = self._last_ns is None or (frame.t_ns - self._last_ns) * 1e-9 > 1.0 / c.rate_hz - 1e-3
        if not due or estimate.health is not Health.TRACKING or estimate.T_odom_imu is None:
            return None
        depth = self._source.depth(frame, estimate)
        if depth is None:
            return None
        self._last_ns = frame.t_ns
        middle = np.floor(estimate.T_odom_imu[:3, 3] / c.cell_m).astype(np.int64)
        low = middle - self._size // 2
        if self._local is None:
            self._local = LogOdds(low, np.zeros(self._size, np.float32))
            self._submap = LogOdds(middle - 2 * self._size, np.zeros(4 * self._size, np.float32))
            self._anchor_ns = frame.t_ns
        elif np.any(np.abs(low - self._local.low) * c.cell_m > 0.5):
            self._local = self._local.moved(low)
        found = evidence(depth, c.cell_m, c.range_m)
        self._local.add(found)
        if self._submap is not None:
            self._submap.add(found)
        return depth

    @property
    def local_map(self) -> OccupancyGrid | None:
        """The local map around the drone, in the odometry frame; None before the first depth image."""
        return None if self._local is None else self._local.grid(self._config.cell_m)

    @property
    def submaps(self) -> tuple[PlacedSubmap, ...]:
        """The submaps, with their poses by the newest correction."""
        if self._submap is None:
            return ()
        return (PlacedSubmap(0, 0, self._anchor_ns, np.eye(4), self._submap.grid(self._config.cell_m)),)

    def fused(self) -> OccupancyGrid | None:
        """Return the map of all submaps that are joined with the map, in the map frame; None without one."""
        submaps = self.submaps
        if not submaps:
            return None
        grid = submaps[0].grid
        known = np.argwhere(grid.states != UNKNOWN)
        if not len(known):
            return None
        a, b = known.min(axis=0), known.max(axis=0) + 1
        states = grid.states[a[0] : b[0], a[1] : b[1], a[2] : b[2]]
        return OccupancyGrid(grid.low_m + a * grid.cell_m, grid.cell_m, states, "map")
