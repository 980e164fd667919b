"""Viewpoints for coverage: places from which a camera would see much unknown space, and what they cost.

At a height, the map is reduced to columns: where something blocks the sight, and how much is unknown in the band of
heights of interest. Rays from a candidate pass until something occupied blocks them; unknown space beyond unknown space
counts less, since something may be hidden in it.

Sources: Yamauchi, "A frontier-based approach for autonomous exploration", 1997, for the nearest frontier;
González-Baños and Latombe, "Navigation strategies for exploring indoor environments", 2002, for the gain of a view.
"""

from dataclasses import dataclass, replace
from math import radians

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse.csgraph import dijkstra

from dronevio.autonomy.planning.body import Body
from dronevio.autonomy.planning.known_space import LocalSpace
from dronevio.models.arrays import Array, Integers, Mask
from dronevio.models.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

_RAYS = 72
_STEP_RAD = 2.0 * np.pi / _RAYS
_REACH_M = 4.0  # to which a view is counted, as the depth is used
_HALF_VIEW_RAD = radians(40.0)
_HIDDEN_M = 1.5  # way through unknown space after which what lies beyond counts 1/e
_EVERY = 4  # of the cells along both axes, a candidate
_SPEED_M_S, _TURN_RAD_S, _PAUSE_S = 1.2, 1.2, 0.5  # of the cost of a way
_LEAST_GAIN_M3 = 0.3
_MOST = 500  # candidates
_OFF_M = 1.0  # between a start and the nearest cell where the body has room
_BORDER_M = 1.0  # of unknown space around what is known
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


@dataclass(frozen=True, eq=False)
class Area:
    """Upright box that is to be seen, with the pose of the map in its frame."""

    corners_m: Array
    """(2, 3) Lower and upper corner [m]."""
    T_area_map: Array
    """(4, 4) Pose of the map frame in the frame of the box."""

    def walled(self, grid: OccupancyGrid) -> OccupancyGrid:
        """Return a grid of the map in which columns outside the box are occupied."""
        columns = np.indices(grid.states.shape[:2]).transpose(1, 2, 0)
        centres = grid.centres(np.concatenate([columns, np.zeros((*columns.shape[:2], 1), np.int64)], axis=-1))
        xy = centres @ self.T_area_map[:2, :3].T + self.T_area_map[:2, 3]
        is_outside = np.any((xy < self.corners_m[0, :2]) | (xy > self.corners_m[1, :2]), axis=-1)
        return replace(grid, states=np.where(is_outside[..., None], np.uint8(OCCUPIED), grid.states))


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
    grid = area.walled(_bordered(known, heights_m))
    columns = _Columns.of(grid, start, body)
    way = columns.ways(start)
    cells = _spread(np.isfinite(way), _EVERY)
    gains = columns.gains(cells)
    # The best heading sees most, in the middle of the field of view rather than at its edge.
    window = np.arange(-int(_HALF_VIEW_RAD / _STEP_RAD), int(_HALF_VIEW_RAD / _STEP_RAD) + 1)
    seen = np.stack([np.roll(gains, -shift, axis=1) for shift in window])
    best = np.argmax(np.tensordot(np.cos(window * _STEP_RAD), seen, axes=1), axis=1)
    gain = seen.sum(axis=0)[np.arange(len(cells)), best]
    worth = gain >= _LEAST_GAIN_M3
    return _of(grid, columns, cells[worth], best[worth] * _STEP_RAD, gain[worth], way, start, yaw_rad)


def _of(
    grid: OccupancyGrid,
    columns: "_Columns",
    cells: Integers,
    yaw: Array,
    gain_m3: Array,
    way: Array,
    start: Array,
    yaw_rad: float,
) -> Viewpoints:
    """Return views from cells (N, 2) of a band with headings (N,), beside the ways (X, Y) to all cells."""
    positions = grid.centres(np.column_stack([cells, np.full(len(cells), columns.level)]))
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


def _none() -> Viewpoints:
    """Return no viewpoints."""
    nothing = np.zeros(0)
    return Viewpoints(np.zeros((0, 3)), nothing, nothing, nothing, nothing)


def _bordered(known: OccupancyGrid, heights_m: Array) -> OccupancyGrid:
    """Return the band of a map with a border of unknown space."""
    cell_m = known.cell_m
    low = np.floor((known.low_m - [_BORDER_M, _BORDER_M, 0.0]) / cell_m).astype(np.int64)
    high = np.ceil((known.high_m + [_BORDER_M, _BORDER_M, 0.0]) / cell_m).astype(np.int64)
    low[2], high[2] = (round(z / cell_m) for z in heights_m)
    states = np.full(high - low, UNKNOWN, np.uint8)
    first = np.round(known.low_m / cell_m).astype(np.int64)
    a, b = np.maximum(first, low), np.minimum(first + known.states.shape, high)
    if np.all(b > a):
        inside = tuple(slice(i, j) for i, j in zip(a - low, b - low, strict=True))
        states[inside] = known.states[tuple(slice(i, j) for i, j in zip(a - first, b - first, strict=True))]
    return OccupancyGrid(np.asarray(cell_m * low, np.float64), cell_m, states, known.frame)


@dataclass(frozen=True, eq=False)
class _Columns:
    """A band of a map reduced to columns (X, Y)."""

    level: int
    """Level of the flight."""
    cell_m: float
    """Side of a cell [m]."""
    low_m: Array
    """(3,) Lower corner of the band [m]."""
    is_clear: Mask
    """(X, Y) Whether the body has room at the level."""
    blocks_sight: Mask
    """(X, Y) Whether something occupied blocks the sight at the level."""
    unknown: Array
    """(X, Y) Unknown height [m]."""

    @classmethod
    def of(cls, grid: OccupancyGrid, start: Array, body: Body) -> "_Columns":
        """Reduce a band of a map, for a flight at the height of a start (3,)."""
        level = int(np.clip(grid.cells(start)[2], 0, grid.states.shape[2] - 1))
        space = LocalSpace.of(grid, body, start)
        is_clear = space.is_clear(body.radius_m)[..., level]
        blocks = grid.states[..., level] == OCCUPIED
        unknown = grid.cell_m * np.count_nonzero(space.grid.states == UNKNOWN, axis=2)
        return cls(level, grid.cell_m, grid.low_m, is_clear, blocks, unknown.astype(np.float64))

    def ways(self, start: Array) -> Array:
        """Return the lengths (X, Y) of the ways from a start (3,) through clear cells, inf where none leads [m]."""
        shape = self.is_clear.shape
        way = np.full(shape, np.inf)
        cells = np.argwhere(self.is_clear)
        if not len(cells):
            return way
        apart = np.linalg.norm(cells - np.floor((start[:2] - self.low_m[:2]) / self.cell_m), axis=1)
        first = int(np.argmin(apart))
        if apart[first] * self.cell_m > _OFF_M:
            return way
        number = np.full(shape, -1)
        number[tuple(cells.T)] = np.arange(len(cells))
        tails, heads, lengths = [], [], []
        for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1)):
            rows, other_rows = number[: shape[0] - dx], number[dx:]
            here, there = (
                (rows[:, 1:], other_rows[:, :-1]) if dy < 0 else (rows[:, : shape[1] - dy], other_rows[:, dy:])
            )
            joined = (here >= 0) & (there >= 0)
            tails.append(here[joined])
            heads.append(there[joined])
            lengths.append(np.full(np.count_nonzero(joined), self.cell_m * np.hypot(dx, dy)))
        graph = sparse.coo_array(
            (np.concatenate(lengths), (np.concatenate(tails), np.concatenate(heads))), shape=(len(cells), len(cells))
        )
        way[tuple(cells.T)] = dijkstra(graph.tocsr(), directed=False, indices=first)
        return way

    def gains(self, cells: Integers) -> Array:
        """Return the unknown volumes (N, R) that are expected to be seen along rays from cells (N, 2) [m³]."""
        blocks, unknown, step_m = *self._halved(), 2.0 * self.cell_m
        # Cells along the rays: (N, R, K).
        angle = np.arange(_RAYS) * _STEP_RAD
        range_m = np.arange(1, int(_REACH_M / step_m) + 1) * step_m
        along = np.stack([np.cos(angle)[:, None] * range_m, np.sin(angle)[:, None] * range_m], axis=-1)
        at = cells[:, None, None] // 2 + np.rint(along / step_m).astype(np.int64)
        inside = np.all((at >= 0) & (at < blocks.shape), axis=-1)
        flat = np.where(inside, at[..., 0] * blocks.shape[1] + at[..., 1], 0)
        # What is unknown before the first occupied cell.
        is_seen = ~np.logical_or.accumulate(blocks.reshape(-1)[flat] | ~inside, axis=-1)
        unknown_m = np.where(is_seen, unknown.reshape(-1)[flat], 0.0)
        hidden_m = np.cumsum(unknown_m > 0.5 * self.cell_m, axis=-1) * step_m
        area_m2 = range_m * step_m * _STEP_RAD
        return np.asarray(np.sum(unknown_m * np.exp(-hidden_m / _HIDDEN_M) * area_m2, axis=-1))

    def _halved(self) -> tuple[Mask, Array]:
        """Return what blocks the sight, and the mean unknown height, in cells of twice the side."""
        odd = np.array(self.is_clear.shape) % 2
        pairs = [np.pad(each, [(0, odd[0]), (0, odd[1])], mode="edge") for each in (self.blocks_sight, self.unknown)]
        blocks, unknown = (each.reshape(each.shape[0] // 2, 2, each.shape[1] // 2, 2) for each in pairs)
        return np.asarray(blocks.any(axis=(1, 3))), np.asarray(unknown.mean(axis=(1, 3)))


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
    grid = area.walled(_bordered(known, heights_m))
    columns = _Columns.of(grid, start, body)
    # Frontiers, and the nearest one of each cell.
    states = grid.states[..., columns.level]
    groups, count = ndimage.label(ndimage.binary_dilation(states == UNKNOWN) & (states == FREE), np.ones((3, 3)))
    sizes = np.bincount(groups.reshape(-1), minlength=count + 1)
    is_frontier = (groups > 0) & (sizes[groups] >= _LEAST_CELLS)
    if not is_frontier.any():
        return _none()
    apart_m, nearest = ndimage.distance_transform_edt(~is_frontier, sampling=grid.cell_m, return_indices=True)
    way = columns.ways(start)
    cells = _spread(np.isfinite(way) & (apart_m <= body.radius_m + _BESIDE_M), 2)
    toward = nearest[:, cells[:, 0], cells[:, 1]].T
    yaw = np.arctan2(toward[:, 1] - cells[:, 1], toward[:, 0] - cells[:, 0])
    volume_m3 = sizes[groups[tuple(toward.T)]] * grid.cell_m**3
    return _of(grid, columns, cells, yaw, volume_m3, way, start, yaw_rad)
