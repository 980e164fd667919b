"""A privileged expert for the task Navigate: it knows the solids of each world, and flies around them on short paths.

A learner never has what the expert knows; it is the teacher of `dagger.py`.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import dijkstra

from dronevio.autonomy.true_map import clear_samples
from dronevio.envs import ActionLimits
from dronevio.models.rotation import yaw_rad_from_matrix
from dronevio.sim.world import flight_area

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]

CELL_M = 0.2
LOWEST_M, HIGHEST_M = 0.4, 3.4  # heights of paths
MARGIN_M = 0.45  # least distance of the lines that are flown from solids
WIDE_M, DETOUR = 0.9, 12.0  # clearance that is worth a detour, and the greatest relative cost of a cell with less
STEPS = 60  # cells of a path that the expert looks ahead
SPEED_M_S, TURN_PER_S = 1.5, 2.0


class FreeSpace:
    """Cells of the free space of a world, and the graph of their neighbours with costs that avoid narrow passages."""

    def __init__(self, name: str, seed: int) -> None:
        """Build the graph of the world with a name and a seed."""
        first, free = clear_samples(flight_area(name, seed).space, CELL_M, 0.5, 0.05)
        low, high = (int((height - first[2]) / CELL_M) for height in (LOWEST_M, HIGHEST_M))
        self._first, free = first + [0.0, 0.0, low * CELL_M], free[:, :, low : high + 1]
        distance = distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1, 1:-1]
        self._clearance_m = (CELL_M * distance).astype(np.float32)
        self._graph = _graph(free, 1.0 + DETOUR * np.clip(1.0 - self._clearance_m / WIDE_M, 0.0, None) ** 2)

    def next_cells(self, goal_m: Array) -> Indices:
        """Return for each cell the next one on the shortest path to a goal (3,); negative where there is none."""
        start = np.ravel_multi_index(self._cell(goal_m), self._clearance_m.shape)
        _, following = dijkstra(self._graph, directed=False, indices=start, return_predecessors=True)
        return np.asarray(following, np.intp)

    def path(self, following: Indices, position_m: Array) -> Array:
        """Return the next cells (P, 3) on the path from a position (3,) [m]."""
        cell, cells = int(np.ravel_multi_index(self._cell(position_m), self._clearance_m.shape)), []
        while len(cells) < STEPS and (cell := int(following[cell])) >= 0:
            cells.append(cell)
        places = np.unravel_index(np.array(cells, np.intp), self._clearance_m.shape)
        return self._first + CELL_M * np.stack(places, axis=-1)

    def clearance_m(self, points: Array) -> Array:
        """Return the distances (…) of points (…, 3) from solids, to the cell [m]."""
        return self._clearance_m[self._cell(points)].astype(np.float64)

    def _cell(self, points: Array) -> tuple[Indices, ...]:
        """Return the indices (…) of the cells of points (…, 3) along each axis."""
        cells = np.rint((points - self._first) / CELL_M).astype(np.intp)
        return tuple(np.moveaxis(np.clip(cells, 0, np.array(self._clearance_m.shape) - 1), -1, 0))


def _graph(free: npt.NDArray[np.bool_], cost: Array) -> csr_array:
    """Return the graph of free cells (X, Y, Z) and their 26 neighbours, whose edges cost length times mean cost."""
    numbers = np.arange(free.size).reshape(free.shape)
    parts = []
    for step in np.argwhere(np.ones((3, 3, 3))) - 1:
        if tuple(step) <= (0, 0, 0):  # each pair of neighbours once
            continue
        here = tuple(slice(max(0, -s), n - max(0, s)) for s, n in zip(step, free.shape, strict=True))
        there = tuple(slice(max(0, s), n - max(0, -s)) for s, n in zip(step, free.shape, strict=True))
        both = free[here] & free[there]
        weight = 0.5 * CELL_M * np.linalg.norm(step) * (cost[here] + cost[there])
        parts.append((weight[both], numbers[here][both], numbers[there][both]))
    weights, rows, columns = (np.concatenate(part) for part in zip(*parts, strict=True))
    return coo_array((weights, (rows, columns)), shape=(free.size, free.size)).tocsr()


class Expert:
    """Actions of the mode ``velocity`` for n vehicles, each in a world of its own."""

    def __init__(self, name: str, seeds: Sequence[int], count: int, limits: ActionLimits) -> None:
        """Build the free spaces of all worlds.

        Args:
            name: Name of the worlds.
            seeds: Their seeds.
            count: Number of vehicles.
            limits: Velocities of actions of ±1.
        """
        self._spaces = {seed: FreeSpace(name, seed) for seed in seeds}
        self._limits, self._goal_m = limits, np.zeros((count, 3))
        self._space: list[FreeSpace] = [self._spaces[seeds[0]]] * count
        self._following: list[Indices] = [np.zeros(0, np.intp)] * count

    def begin(self, rows: Indices, seeds: npt.NDArray[np.int64], goals_m: Array) -> None:
        """Begin episodes (k,) of vehicles in the worlds of some seeds, with goals (k, 3) [m]."""
        self._goal_m[rows] = goals_m
        for row, seed, goal in zip(rows, seeds.tolist(), goals_m, strict=True):
            self._space[row] = self._spaces[seed]
            self._following[row] = self._space[row].next_cells(goal)

    def action(self, position_m: Array, rotation: Array) -> npt.NDArray[np.float32]:
        """Return the actions (n, 4) at positions (n, 3) [m] and rotations (n, 3, 3), vehicle to world."""
        ahead = np.array([self._ahead(row, place) for row, place in enumerate(position_m)]) - position_m
        yaw = yaw_rad_from_matrix(rotation)
        bearing = np.remainder(np.arctan2(ahead[:, 1], ahead[:, 0]) - yaw + np.pi, 2.0 * np.pi) - np.pi
        bearing[np.hypot(ahead[:, 0], ahead[:, 1]) < CELL_M] = 0.0
        # slow near the goal, and before the camera looks ahead
        to_goal = np.linalg.norm(self._goal_m - position_m, axis=1)
        speed = np.minimum(SPEED_M_S, 1.2 * to_goal + 0.1) * np.clip(1.4 * np.cos(bearing) - 0.4, 0.1, 1.0)
        velocity = ahead * (speed / np.maximum(np.linalg.norm(ahead, axis=1), 1e-6))[:, None]
        cos, sin = np.cos(yaw), np.sin(yaw)
        moved = np.stack(
            [cos * velocity[:, 0] + sin * velocity[:, 1], cos * velocity[:, 1] - sin * velocity[:, 0], velocity[:, 2]]
        )
        turn = TURN_PER_S * bearing / self._limits.yaw_rate_rad_s
        action = np.column_stack([moved.T / self._limits.velocity_m_s, turn])
        return np.clip(action, -1.0, 1.0).astype(np.float32)

    def _ahead(self, row: int, position_m: Array) -> Array:
        """Return the farthest point (3,) of the path of a vehicle to which a straight line is clear [m]."""
        space = self._space[row]
        path = space.path(self._following[row], position_m)
        if len(path) < STEPS:
            path = np.concatenate([path, self._goal_m[row][None]])
        share = np.linspace(0.0, 1.0, 25)[1:]
        lines = position_m + share[:, None] * (path - position_m)[:, None]
        travelled = share * np.linalg.norm(path - position_m, axis=1)[:, None]
        # a vehicle that is closer than the margin may leave along a line that does not come closer
        least = min(MARGIN_M, 0.9 * float(space.clearance_m(position_m)))
        is_clear = (space.clearance_m(lines) >= np.where(travelled < 0.4, least, MARGIN_M)).all(axis=1)
        clear = np.flatnonzero(is_clear)
        return np.asarray(path[clear[-1] if clear.size else min(1, len(path) - 1)])
