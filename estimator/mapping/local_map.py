"""The local map: a box of cells that moves with the drone, in the odometry frame.

It is never bent: what lies behind is forgotten before drift or a loop closure could make it inconsistent.
"""

import numpy as np

from dronevio.estimator.mapping.distance import distance_field
from dronevio.estimator.mapping.evidence import Evidence
from dronevio.estimator.mapping.log_odds import LogOdds
from dronevio.models.arrays import Array
from dronevio.models.occupancy import DistanceField, OccupancyGrid

LOCAL_SIZE_M = (8.0, 8.0, 4.0)
"""Extent of the local map [m]."""
_MARGIN_M = 0.5
"""Distance of the drone from the middle at which the box moves, so that it is seldom copied [m]."""


class LocalMap:
    """Log-odds of the cells around the drone; cells that leave the box are forgotten.

    Example:
        >>> local = LocalMap(cell_m=0.1)
        >>> local.centre_on(T_odom_imu[:3, 3])
        >>> local.add(evidence(depth, cell_m=0.1, range_m=4.0))
        >>> local.distance_field(unknown_is_obstacle=True)
    """

    def __init__(self, cell_m: float, size_m: tuple[float, float, float] = LOCAL_SIZE_M) -> None:
        """Begin with unknown cells around the origin.

        Args:
            cell_m: Side of the cells [m].
            size_m: Extent of the box [m].
        """
        self.cell_m = cell_m
        shape = np.maximum(np.round(np.array(size_m) / cell_m).astype(np.int64), 1)
        self._log_odds = LogOdds(-(shape // 2), np.zeros(shape, np.float32))

    def centre_on(self, position: Array) -> None:
        """Move the box by whole cells if a position (3,) [m] is more than half a metre from its middle."""
        low = np.floor(position / self.cell_m).astype(np.int64) - np.array(self._log_odds.values.shape) // 2
        if np.any(np.abs(low - self._log_odds.low) * self.cell_m > _MARGIN_M):
            self._log_odds = self._log_odds.moved(low)

    def add(self, evidence: Evidence) -> None:
        """Add the evidence of a depth image on the lattice of the same cells."""
        self._log_odds.add(evidence)

    def grid(self) -> OccupancyGrid:
        """Return the states of the cells."""
        return self._log_odds.grid(self.cell_m)

    def distance_field(self, *, unknown_is_obstacle: bool) -> DistanceField:
        """Return the distances to the nearest obstacle in the box, exact within it."""
        return distance_field(self.grid(), unknown_is_obstacle=unknown_is_obstacle)
