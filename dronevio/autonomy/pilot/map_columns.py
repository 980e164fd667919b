"""A band of a map reduced to columns: where a body has room, ways between columns, and what is seen from them."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

from dronevio.autonomy.planning.body import Body
from dronevio.autonomy.planning.known_space import LocalSpace
from dronevio.models.arrays import Array, Integers, Mask
from dronevio.models.occupancy import OCCUPIED, UNKNOWN, OccupancyGrid, States

_REACH_M = 4.0  # to which a view is counted, as the depth is used
_HIDDEN_M = 1.5  # way through unknown space after which what lies beyond counts 1/e
_OFF_M = 1.0  # between a start and the nearest cell where the body has room
_BORDER_M = 1.0  # of unknown space around what is known


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


@dataclass(frozen=True, eq=False)
class Columns:
    """A band of a map reduced to columns (X, Y)."""

    grid: OccupancyGrid
    """The band, with a border of unknown space, and occupied outside the area."""
    level: int
    """Level of the flight."""
    is_clear: Mask
    """(X, Y) Whether the body has room at the level."""
    blocks_sight: Mask
    """(X, Y) Whether something occupied blocks the sight at the level."""
    unknown: Array
    """(X, Y) Unknown height [m]."""

    @property
    def states(self) -> States:
        """(X, Y) States at the level of the flight."""
        return self.grid.states[..., self.level]

    @classmethod
    def of(cls, known: OccupancyGrid, start: Array, body: Body, heights_m: Array, area: Area) -> Self:
        """Reduce a map.

        Args:
            known: The map.
            start: (3,) Position, whose height is that of the flight [m].
            body: The body.
            heights_m: (2,) Band of heights [m].
            area: What is of interest.
        """
        grid = area.walled(_bordered(known, heights_m))
        level = int(np.clip(grid.cells(start)[2], 0, grid.states.shape[2] - 1))
        space = LocalSpace.of(grid, body, start)
        is_clear = space.is_clear(body.radius_m)[..., level]
        blocks = grid.states[..., level] == OCCUPIED
        unknown = grid.cell_m * np.count_nonzero(space.grid.states == UNKNOWN, axis=2)
        return cls(grid, level, is_clear, blocks, unknown.astype(np.float64))

    def ways(self, start: Array) -> Array:
        """Return the lengths (X, Y) of the ways from a start (3,) through clear cells, inf where none leads [m]."""
        shape = self.is_clear.shape
        way = np.full(shape, np.inf)
        cells = np.argwhere(self.is_clear)
        if not len(cells):
            return way
        apart = np.linalg.norm(cells - np.floor((start[:2] - self.grid.low_m[:2]) / self.grid.cell_m), axis=1)
        first = int(np.argmin(apart))
        if apart[first] * self.grid.cell_m > _OFF_M:
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
            lengths.append(np.full(np.count_nonzero(joined), self.grid.cell_m * np.hypot(dx, dy)))
        graph = sparse.coo_array(
            (np.concatenate(lengths), (np.concatenate(tails), np.concatenate(heads))), shape=(len(cells), len(cells))
        )
        way[tuple(cells.T)] = dijkstra(graph.tocsr(), directed=False, indices=first)
        return way

    def gains(self, cells: Integers, rays: int) -> Array:
        """Return the unknown volumes (N, R) that are expected to be seen from cells (N, 2) [m³].

        They are those of sectors around rays at equal angles from +x to the left, up to the first occupied cell.
        Unknown space beyond unknown space counts less, since something may be hidden in it.
        """
        blocks, unknown, step_m = *self._halved(), 2.0 * self.grid.cell_m
        # Cells along the rays: (N, R, K).
        angle = np.arange(rays) * 2.0 * np.pi / rays
        range_m = np.arange(1, int(_REACH_M / step_m) + 1) * step_m
        along = np.stack([np.cos(angle)[:, None] * range_m, np.sin(angle)[:, None] * range_m], axis=-1)
        at = cells[:, None, None] // 2 + np.rint(along / step_m).astype(np.int64)
        inside = np.all((at >= 0) & (at < blocks.shape), axis=-1)
        flat = np.where(inside, at[..., 0] * blocks.shape[1] + at[..., 1], 0)
        # What is unknown before the first occupied cell.
        is_seen = ~np.logical_or.accumulate(blocks.reshape(-1)[flat] | ~inside, axis=-1)
        unknown_m = np.where(is_seen, unknown.reshape(-1)[flat], 0.0)
        hidden_m = np.cumsum(unknown_m > 0.5 * self.grid.cell_m, axis=-1) * step_m
        area_m2 = range_m * step_m * (2.0 * np.pi / rays)
        return np.asarray(np.sum(unknown_m * np.exp(-hidden_m / _HIDDEN_M) * area_m2, axis=-1))

    def _halved(self) -> tuple[Mask, Array]:
        """Return what blocks the sight, and the mean unknown height, in cells of twice the side."""
        odd = np.array(self.is_clear.shape) % 2
        pairs = [np.pad(each, [(0, odd[0]), (0, odd[1])], mode="edge") for each in (self.blocks_sight, self.unknown)]
        blocks, unknown = (each.reshape(each.shape[0] // 2, 2, each.shape[1] // 2, 2) for each in pairs)
        return np.asarray(blocks.any(axis=(1, 3))), np.asarray(unknown.mean(axis=(1, 3)))


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
