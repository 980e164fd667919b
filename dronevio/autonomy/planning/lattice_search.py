"""Shortest paths between the cells of a lattice: A* that expands all cells of nearly equal cost at once.

A cell has 26 neighbours. Cells wait in buckets by their cost, that of the path to them and a lower bound of the rest,
and the cells of the first bucket are expanded together until their costs no longer change. With buckets of one cost
this is A*; wider ones expand some cells again, but in a few hundred operations on arrays instead of one by one.

Sources: Hart, Nilsson and Raphael, "A formal basis for the heuristic determination of minimum cost paths", 1968; Meyer
and Sanders, "Δ-stepping: a parallelizable shortest path algorithm", 2003.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np

from dronevio.models.arrays import Array, Floats, Integers, Mask

_STEPS = np.array([step for step in product((-1, 0, 1), repeat=3) if step != (0, 0, 0)])
_LENGTHS = np.linalg.norm(_STEPS, axis=1)
_BUCKET_CELLS = 0.5  # width of a bucket: 0.25 to 2 take about the same time
_TOLERANCE = 1e-9  # by which a path is shorter than another: more than rounding, less than two sums of steps differ


@dataclass(frozen=True, eq=False)
class LatticePath:
    """Result of a search."""

    cells: Integers | None
    """(M, 3) Indices of the cells of the path, both ends included; None if the goal was not reached."""
    expansions: int
    """Number of cells whose neighbours were looked at."""


def shortest_path(
    is_clear: Mask,
    start: Integers,
    goal: Integers,
    max_expansions: int,
    *,
    through_faces: bool = False,
    cell_costs: Floats | None = None,
) -> LatticePath:
    """Return the path of least cost, by default of least length, of steps to the 26 neighbours through clear cells.

    Args:
        is_clear: (X, Y, Z) Whether a path may pass a cell.
        start: (3,) Index of the first cell, which is clear.
        goal: (3,) Index of the last cell, which is clear.
        max_expansions: The search ends without a path when it has expanded more cells.
        through_faces: Whether steps lead to the 6 neighbours that share a face alone.
        cell_costs: (X, Y, Z) Cost of a unit of length in each cell, at least 1; a step has the mean of its two cells.
    """
    padded = np.zeros(np.array(is_clear.shape) + 2, np.bool_)
    padded[1:-1, 1:-1, 1:-1] = is_clear
    flat, shape = padded.reshape(-1), np.array(padded.shape)
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    steps, lengths = (_STEPS[_LENGTHS == 1.0], np.ones(6)) if through_faces else (_STEPS, _LENGTHS)
    offsets = steps @ strides
    first, last = int((start + 1) @ strides), int((goal + 1) @ strides)
    half = np.full(flat.shape, 0.5, np.float32)
    if cell_costs is not None:
        half.reshape(padded.shape)[1:-1, 1:-1, 1:-1] *= cell_costs
    cost = np.full(flat.shape, np.inf)
    cost[first] = 0.0
    buckets: dict[int, list[Integers]] = {0: [np.array([first])]}
    lowest = _remaining(start[None] - goal)[0]
    expansions = 0
    while buckets:
        bucket = min(buckets)
        if np.isfinite(cost[last]) and (cost[last] - lowest) / _BUCKET_CELLS < bucket:
            break
        cells = np.unique(np.concatenate(buckets.pop(bucket)))
        expansions += len(cells)
        if expansions > max_expansions:
            return LatticePath(None, expansions)
        heads = cells[:, None] + offsets
        costs = (cost[cells][:, None] + lengths * (half[cells][:, None] + half[heads])).reshape(-1)
        heads = heads.reshape(-1)
        better = flat[heads] & (costs < cost[heads] - _TOLERANCE)
        heads, costs = heads[better], costs[better]
        np.minimum.at(cost, heads, costs)
        heads = np.unique(heads)
        from_goal = np.stack(np.unravel_index(heads, padded.shape), axis=-1) - 1 - goal
        number = np.maximum(((cost[heads] + _remaining(from_goal) - lowest) / _BUCKET_CELLS).astype(np.int64), bucket)
        for each in np.unique(number).tolist():
            buckets.setdefault(each, []).append(heads[number == each])
    if not np.isfinite(cost[last]):
        return LatticePath(None, expansions)
    return LatticePath(_traced(cost, half, first, last, offsets, lengths, strides), expansions)


def _remaining(from_goal: Integers) -> Array:
    """Return the lengths (N,) of shortest paths without obstacles along differences of indices (N, 3) [cells]."""
    near, middle, far = np.sort(np.abs(from_goal), axis=-1).T
    return np.asarray(far + (np.sqrt(2.0) - 1.0) * middle + (np.sqrt(3.0) - np.sqrt(2.0)) * near)


def _traced(
    cost: Array, half: Floats, first: int, last: int, offsets: Integers, lengths: Array, strides: Integers
) -> Integers:
    """Return the path (M, 3) from the first to the last cell down the costs (N,) of the cells."""
    path = [last]
    while path[-1] != first:
        before = path[-1] + offsets
        path.append(int(before[np.argmin(cost[before] + lengths * (half[before] + half[path[-1]]))]))
    i, rest = np.divmod(np.array(path[::-1]), strides[0])
    return np.stack([i, *np.divmod(rest, strides[1])], axis=-1) - 1
