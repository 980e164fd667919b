"""Viewpoints for coverage: places from which a camera would see much unknown space, and what they cost.

Sources: Yamauchi, "A frontier-based approach for autonomous exploration", 1997, for the nearest frontier;
González-Baños and Latombe, "Navigation strategies for exploring indoor environments", 2002, for the gain of a view.
"""

from dataclasses import dataclass
from math import radians

import numpy as np
from scipy import ndimage

from dronevio.autonomy.pilot.map_columns import Area, Columns
from dronevio.autonomy.planning.body import Body
from dronevio.models.arrays import Array, Integers, Mask
from dronevio.models.occupancy import FREE, UNKNOWN, OccupancyGrid

_RAYS = 72
_STEP_RAD = 2.0 * np.pi / _RAYS
_HALF_VIEW_RAD = radians(40.0)
_EVERY = 4  # of the cells along both axes, a candidate
_SPEED_M_S, _TURN_RAD_S, _PAUSE_S = 1.2, 1.2, 0.5  # of the cost of a way
_LEAST_GAIN_M3 = 0.3
_MOST = 500  # candidates
_LEAST_CELLS, _BESIDE_M = 4, 0.4  # of a frontier; beyond the radius of the body, from where it is seen


@dataclass(frozen=True, eq=False)
class Viewpoints:
    """Candidates (N) with what is seen from them and what they cost."""

    positions_m: Array
    """(N, 3) Positions in the frame of the map [m]."""
    yaw_rad: Array
    """(N,) Headings with the largest gain [rad]."""
    gain_m3: Array
    """(N,) Unknown volume that is expected to be seen with these headings [m³]."""
    way_m: Array
    """(N,) Length of the way [m]."""
    cost_s: Array
    """(N,) Expected time until the view is taken [s]."""


def viewpoints(
    known: OccupancyGrid, start: Array, yaw_rad: float, body: Body, heights_m: Array, area: Area
) -> Viewpoints:
    """Return the places at the height of a start that are worth a view, by the known map.

    Args:
        known: The map.
        start: (3,) Position [m].
        yaw_rad: Heading [rad].
        body: The body.
        heights_m: (2,) Band of heights whose volume is of interest [m].
        area: What is to be seen.
    """
    columns = Columns.of(known, start, body, heights_m, area)
    way = columns.ways(start)
    cells = _spread(np.isfinite(way), _EVERY)
    gains = columns.gains(cells, _RAYS)
    # The best heading sees most, in the middle of the field of view rather than at its edge.
    window = np.arange(-int(_HALF_VIEW_RAD / _STEP_RAD), int(_HALF_VIEW_RAD / _STEP_RAD) + 1)
    seen = np.stack([np.roll(gains, -shift, axis=1) for shift in window])
    best = np.argmax(np.tensordot(np.cos(window * _STEP_RAD), seen, axes=1), axis=1)
    gain = seen.sum(axis=0)[np.arange(len(cells)), best]
    worth = gain >= _LEAST_GAIN_M3
    return _of(columns, cells[worth], best[worth] * _STEP_RAD, gain[worth], way, start, yaw_rad)


def frontier_views(
    known: OccupancyGrid, start: Array, yaw_rad: float, body: Body, heights_m: Array, area: Area
) -> Viewpoints:
    """Return the places beside frontiers at the height of a start; their gain is the volume of the frontier.

    A frontier is a group of at least four free cells at that height that share a face with unknown space.

    Args:
        known: The map.
        start: (3,) Position [m].
        yaw_rad: Heading [rad].
        body: The body.
        heights_m: (2,) Band of heights of the map that is used [m].
        area: What is to be seen.
    """
    columns = Columns.of(known, start, body, heights_m, area)
    # Frontiers, and the nearest one of each cell.
    states, cell_m = columns.states, columns.grid.cell_m
    groups, count = ndimage.label(ndimage.binary_dilation(states == UNKNOWN) & (states == FREE), np.ones((3, 3)))
    sizes = np.bincount(groups.reshape(-1), minlength=count + 1)
    is_frontier = (groups > 0) & (sizes[groups] >= _LEAST_CELLS)
    if not is_frontier.any():
        nothing = np.zeros(0)
        return Viewpoints(np.zeros((0, 3)), nothing, nothing, nothing, nothing)
    apart_m, nearest = ndimage.distance_transform_edt(~is_frontier, sampling=cell_m, return_indices=True)
    way = columns.ways(start)
    cells = _spread(np.isfinite(way) & (apart_m <= body.radius_m + _BESIDE_M), 2)
    toward = nearest[:, cells[:, 0], cells[:, 1]].T
    yaw = np.arctan2(toward[:, 1] - cells[:, 1], toward[:, 0] - cells[:, 0])
    volume_m3 = sizes[groups[tuple(toward.T)]] * cell_m**3
    return _of(columns, cells, yaw, volume_m3, way, start, yaw_rad)


def _of(
    columns: Columns,
    cells: Integers,
    yaw: Array,
    gain_m3: Array,
    way: Array,
    start: Array,
    yaw_rad: float,
) -> Viewpoints:
    """Return views from cells (N, 2) of a band with headings (N,), beside the ways (X, Y) to all cells."""
    positions = columns.grid.centres(np.column_stack([cells, np.full(len(cells), columns.level)]))
    positions[:, 2] = start[2]
    way_m = way[tuple(cells.T)]
    turned = np.abs(np.mod(yaw - yaw_rad + np.pi, 2.0 * np.pi) - np.pi)
    return Viewpoints(positions, yaw, gain_m3, way_m, way_m / _SPEED_M_S + turned / _TURN_RAD_S + _PAUSE_S)


def _spread(mask: Mask, every: int) -> Integers:
    """Return cells (N, 2) of a mask at equal intervals, wider ones if there are too many."""
    while True:
        cells = every * np.argwhere(mask[::every, ::every])
        if len(cells) <= _MOST:
            return cells
        every += 1
