"""Occupancy grids: what is free, occupied and unknown in a box, and how far obstacles are."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array, Floats, Integers
from dronevio.models.errors import ConfigError

States = npt.NDArray[np.uint8]
"""States of cells: `UNKNOWN`, `FREE` or `OCCUPIED`."""

UNKNOWN, FREE, OCCUPIED = 0, 1, 2
"""States of a cell: never measured or contradictory, known to be free, known to contain a surface."""

Frame = Literal["odom", "map"]
"""Frame of a grid: that of the odometry, continuous with drift, or that of the map, which loops correct."""


@dataclass(frozen=True, eq=False)
class OccupancyGrid:
    """States of the cells of a box that is aligned with the axes of its frame, z up."""

    low_m: Array
    """(3,) Lower corner of the first cell [m]."""
    cell_m: float
    """Side of a cell [m]."""
    states: States
    """(X, Y, Z) States of the cells."""
    frame: Frame = "odom"
    """Frame of the box."""

    def __post_init__(self) -> None:
        """Check the shapes.

        Raises:
            ConfigError: A shape is wrong, or the side of a cell is not positive.
        """
        if self.low_m.shape != (3,) or self.states.ndim != 3 or not self.cell_m > 0.0:
            raise ConfigError(
                f"occupancy grid with a corner of shape {self.low_m.shape}, states of shape {self.states.shape} and"
                f" cell_m = {self.cell_m}; expected (3,), (X, Y, Z) and more than 0"
            )

    @property
    def high_m(self) -> Array:
        """(3,) Upper corner of the last cell [m]."""
        return np.asarray(self.low_m + self.cell_m * np.array(self.states.shape))

    def cells(self, points: Array) -> Integers:
        """Return the indices (…, 3) of the cells of points (…, 3), which may lie outside the grid."""
        return np.floor((points - self.low_m) / self.cell_m).astype(np.int64)

    def centres(self, cells: Integers) -> Array:
        """Return the centres (…, 3) of cells (…, 3) by their indices [m]."""
        return np.asarray(self.low_m + self.cell_m * (cells + 0.5))

    def at(self, points: Array) -> States:
        """Return the states (…,) at points (…, 3) [m]; unknown outside the grid."""
        cells = self.cells(points)
        inside = np.all((cells >= 0) & (cells < self.states.shape), axis=-1)
        i, j, k = np.moveaxis(np.where(inside[..., None], cells, 0), -1, 0)
        return np.where(inside, self.states[i, j, k], UNKNOWN).astype(np.uint8)

    def points(self, state: int = OCCUPIED) -> Array:
        """Return the centres (N, 3) of the cells in a state [m]."""
        return self.centres(np.argwhere(self.states == state))


@dataclass(frozen=True, eq=False)
class DistanceField:
    """Distances from the centres of the cells of a grid to the nearest obstacle."""

    low_m: Array
    """(3,) Lower corner of the first cell [m]."""
    cell_m: float
    """Side of a cell [m]."""
    distance_m: Floats
    """(X, Y, Z) Distance from the centre of each cell to that of the nearest obstacle, 0 in an obstacle [m]."""
    frame: Frame = "odom"
    """Frame of the box."""


@dataclass(frozen=True, eq=False)
class PlacedSubmap:
    """A part of the map around a keyframe: a grid in the odometry frame, and that frame's pose in the map."""

    number: int
    """Number of the submap, in the order of time."""
    track: int
    """Number of the odometry frame, which changes after a loss."""
    anchor_ns: int
    """Time stamp of the keyframe with which the submap moves [ns]."""
    T_map_odom: Array | None
    """(4, 4) Pose of the submap's odometry frame in the map frame, by its keyframe; None while its track is not joined
    with the map."""
    grid: OccupancyGrid
    """What is free and occupied, in the odometry frame."""
