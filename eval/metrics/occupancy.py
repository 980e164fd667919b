"""Errors of occupancy grids against the true surface: false free space, accuracy and completeness.

The dangerous error is free space where there is a surface: a planner flies through it. A surface sample counts as
falsely free only if no cell within one cell of it warns of it, since planners keep at least that distance.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dronevio.eval.metrics.clouds import CloudScore, compare_clouds, nearest_distances
from dronevio.models.arrays import Array, Mask
from dronevio.models.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

_NEIGHBOURS = np.array(list(itertools.product((-1, 0, 1), repeat=3)))


@dataclass(frozen=True)
class StateShares:
    """Shares of some points by the state of the cell that contains them; their sum is 1."""

    unknown: float
    """Share of the points in unknown cells, and outside the grid."""
    free: float
    """Share of the points in free cells."""
    occupied: float
    """Share of the points in occupied cells."""


def warning_distances_m(grid: OccupancyGrid, points: Array) -> Array:
    """Return the distance (N,) from points to the nearest cell that is not free, infinite beyond one cell [m].

    The distance is that to the box of the cell, 0 within it. Space outside the grid is unknown, so not free.

    Args:
        grid: The grid.
        points: (N, 3) Points in the frame of the grid [m].
    """
    cells, nearest = grid.cells(points), np.full(len(points), np.inf)
    for neighbour in _NEIGHBOURS:
        centre = grid.centres(cells + neighbour)
        gap = np.maximum(np.abs(points - centre) - 0.5 * grid.cell_m, 0.0)
        warns = grid.at(centre) != FREE
        nearest[warns] = np.minimum(nearest[warns], np.linalg.norm(gap[warns], axis=1))
    return np.where(nearest <= grid.cell_m, nearest, np.inf)


def are_falsely_free(grid: OccupancyGrid, surface: Array) -> Mask:
    """Return which points (N, 3) of a true surface are more than one cell from every cell that is not free.

    Args:
        grid: The grid.
        surface: (N, 3) Points of the true surface in the frame of the grid [m].
    """
    wrong = grid.at(surface) == FREE  # any other cell warns of what it contains
    wrong[wrong] = np.isinf(warning_distances_m(grid, surface[wrong]))
    return np.asarray(wrong)


def state_shares(grid: OccupancyGrid, points: Array) -> StateShares:
    """Return the shares of points (N, 3) by the state of their cell; NaN without points.

    Args:
        grid: The grid.
        points: (N, 3) Points in the frame of the grid [m], for example in space that the camera saw through.
    """
    if not len(points):
        return StateShares(np.nan, np.nan, np.nan)
    counts = np.bincount(grid.at(points), minlength=3) / len(points)
    return StateShares(float(counts[UNKNOWN]), float(counts[FREE]), float(counts[OCCUPIED]))


def surface_scores(
    grid: OccupancyGrid, surface: Array, seen: Array, distances_m: Sequence[float]
) -> tuple[CloudScore, ...]:
    """Return accuracy and completeness of the occupied cells, whose centres stand for them.

    A centre lies up to 0.87 sides of a cell from a surface through the cell.

    Args:
        grid: The grid.
        surface: (N, 3) Dense points of the true surface in the frame of the grid, against which cells are judged [m].
        seen: (M, 3) Points of the true surface that were seen, which should be occupied [m].
        distances_m: Distances below which a point counts as right [m].

    Raises:
        EvaluationError: There are no points of the surface.
    """
    return compare_clouds(surface, grid.points(OCCUPIED), distances_m, scored_true=seen)


def left_behind(grid: OccupancyGrid, surface: Array, swept: Array, distance_m: float) -> float:
    """Return the share of the cells where things moved that are still occupied, without a surface nearby.

    Args:
        grid: The grid, after the things are gone.
        surface: (N, 3) Dense points of the static surface in the frame of the grid [m].
        swept: (M, 3) Points on the surfaces of the things when they were seen [m].
        distance_m: Distance from the static surface below which a cell is not judged [m].

    Returns:
        The share of the cells that contain such points, each cell counted once; NaN without any.
    """
    clear = swept[np.isinf(nearest_distances(swept, surface, distance_m))] if len(surface) else swept
    cells = np.unique(grid.cells(clear), axis=0)
    return state_shares(grid, grid.centres(cells)).occupied
