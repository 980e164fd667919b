"""The map as the newest correction places its submaps: their poses in the map frame, and their cells as one grid.

Nothing of an earlier correction remains: a wrong one that is taken back leaves the map as it was.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from dronevio.estimator.mapping.log_odds import LEAST, MOST, LogOdds
from dronevio.estimator.mapping.submap import LOG_ODDS_STEP, Anchor, PackedSubmap, Steps
from dronevio.models.arrays import Array, Integers
from dronevio.models.occupancy import OccupancyGrid
from dronevio.models.rotation import inverse_pose
from dronevio.models.state import Estimate

_LEAST, _MOST = round(LEAST / LOG_ODDS_STEP), round(MOST / LOG_ODDS_STEP)


def placed(anchor: Anchor, newest: Estimate) -> Array | None:
    """Return the pose (4, 4) of a submap's odometry frame in the map frame by the newest estimate.

    It is the correction at the anchor, or the newest one while no keyframe of the track is in the map. An odometry
    without a map has its own frame as that of the map, from the last loss on. None if the track is not joined.
    """
    correction = newest.map_correction
    T = None if correction is None else correction.of_track(anchor.track, anchor.t_ns)
    if T is not None or anchor.track != newest.track:
        return T
    return np.eye(4) if correction is None and newest.T_map_odom is None else newest.T_map_odom


def bounds(low: Integers, shape: tuple[int, int, int], T_map_odom: Array, cell_m: float) -> tuple[Integers, Integers]:
    """Return the first cell (3,) and the end (3,) of the box of the map's lattice around a submap that is placed."""
    if 0 in shape:
        return np.zeros(3, np.int64), np.zeros(3, np.int64)
    ends = np.stack([low, low + shape]).astype(np.float64)
    corners = np.stack(np.meshgrid(*ends.T, indexing="ij"), axis=-1).reshape(-1, 3)
    corners = corners @ T_map_odom[:3, :3].T + T_map_odom[:3, 3] / cell_m
    return np.floor(corners.min(axis=0)).astype(np.int64), np.ceil(corners.max(axis=0)).astype(np.int64)


def fused(submaps: Iterable[tuple[PackedSubmap, Array]], low: Integers, high: Integers, cell_m: float) -> OccupancyGrid:
    """Return the cells of a box of the map's lattice by all submaps.

    The log-odds of a cell add up in the order of time, between the same limits as those of a submap. Occupied outweighs
    free: what one submap has seen as certainly occupied is free only after three that have seen it as certainly free.

    Args:
        submaps: Submaps with their poses (4, 4) in the map frame, in the order of time.
        low: (3,) First cell.
        high: (3,) End of the cells.
        cell_m: Side of the cells [m].
    """
    total = np.zeros(np.maximum(high - low, 0), np.int8)
    for submap, T_map_odom in submaps:
        a, b = bounds(submap.low, submap.shape, T_map_odom, cell_m)
        a, b = np.maximum(a, low), np.minimum(b, high)
        if np.any(b <= a):
            continue
        part = total[tuple(slice(i, j) for i, j in zip(a - low, b - low, strict=True))]
        part += resampled(submap, T_map_odom, a, b, cell_m)  # int8 has room for two limits
        np.clip(part, _LEAST, _MOST, out=part)
    grid = LogOdds(low, total.astype(np.float32) * np.float32(LOG_ODDS_STEP)).grid(cell_m)
    return replace(grid, frame="map")


def resampled(submap: PackedSubmap, T_map_odom: Array, low: Integers, high: Integers, cell_m: float) -> Steps:
    """Return the log-odds of a submap in a box of the map's lattice, in steps.

    A cell has those of the submap's cell at its centre, and at least those of each occupied cell whose centre it
    contains, so that no thin obstacle falls between the centres.

    Args:
        submap: The submap.
        T_map_odom: (4, 4) Its pose in the map frame.
        low: (3,) First cell of the box.
        high: (3,) End of its cells.
        cell_m: Side of the cells [m].
    """
    steps, T_odom_map = submap.steps, inverse_pose(T_map_odom)
    # Index in the submap of the cell at the centre of cell i of the box: R (i + low + 1/2) + p − low_submap − 1/2
    offset = T_odom_map[:3, :3] @ (low + 0.5) + T_odom_map[:3, 3] / cell_m - submap.low - 0.5
    found = _looked_up(steps, T_odom_map[:3, :3], offset, tuple((high - low).tolist()))
    occupied = np.argwhere(steps > 0)
    R, p = T_map_odom[:3, :3], T_map_odom[:3, 3] / cell_m
    cells = np.floor((occupied + submap.low + 0.5) @ R.T + p).astype(np.int64) - low
    inside = np.all((cells >= 0) & (cells < found.shape), axis=1)
    values = steps[tuple(occupied[inside].T)]
    np.maximum.at(found, tuple(cells[inside].T), values)
    return found


def _looked_up(steps: Steps, R: Array, offset: Array, shape: tuple[int, ...]) -> Steps:
    """Return the cells of a grid that are nearest to R (i, j, k) + offset, for all cells (i, j, k) of a box.

    Cells outside the grid are 0. `scipy.ndimage.affine_transform` does the same several times slower.
    """
    padded = np.pad(steps, 1)
    steps_of = [np.arange(size, dtype=np.float32).reshape(-1, *(1,) * (2 - axis)) for axis, size in enumerate(shape)]
    index = np.zeros(shape, np.int32)
    for row, first, size in zip(R.astype(np.float32), offset, padded.shape, strict=True):
        # Rounded, beginning with the padding
        nearest = row[0] * steps_of[0] + row[1] * steps_of[1] + (row[2] * steps_of[2] + np.float32(first + 1.5))
        np.clip(nearest, 0.0, np.float32(size - 1), out=nearest)
        index *= size
        index += nearest.astype(np.int32)
    return np.take(padded, index)
