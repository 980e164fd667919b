"""Global routes on perfect maps: share solved, clearance, length beside the shortest, and processor time.

The map of a world has cells of 10 cm: occupied are those that a solid may touch, all others are free. Starts and goals
are drawn uniformly and are *solvable* if the true space, sampled every 10 cm at other places than the centres of the
cells, connects them in steps along the axes with ``--solvable-m`` of clearance. The optimum is bounded from below by
the straight line, and by the shortest path between samples of the true space every 20 cm with the clearance that the
plan keeps at least, with steps to 98 neighbours, divided by their largest excess over straight lines. Such a path may
pass gaps of half the width that the plan was asked for; the same between samples with the clearance of the plan is an
estimate of the optimum.

    python benchmarks/planning.py --worlds room,forest --queries 1000
"""

import argparse
import time
from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np
from measuring import Row, print_rows
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from dronevio.autonomy.planning.route import NoRoute, Route, route
from dronevio.autonomy.true_map import clear_samples, true_map
from dronevio.estimator.mapping.distance import distance_field
from dronevio.models.arrays import Array
from dronevio.sim.paths.space import Space
from dronevio.sim.world import WORLDS, solid_space

CELL_M = 0.1
CLEARANCE_M = 0.35
TRUE_M = CLEARANCE_M - 3.0**0.5 * CELL_M
"""Clearance that a route keeps in truth [m]: centres of cells are at most half a diagonal from a point of the route and
from the surface."""
COARSE_M = 0.2
GOALS = 20
"""Goals of each start, which share one search for the optimum."""
STEPS = np.array([s for s in product(range(-2, 3), repeat=3) if np.gcd.reduce(s) == 1])
EXCESS = 1.05
"""Largest length of a path of the 98 steps over that of the straight line: 1.0494 by the convex hull of their
directions."""


@dataclass(frozen=True, eq=False)
class Roads:
    """Shortest paths between samples of the true space."""

    nodes: Array
    graph: coo_array

    @classmethod
    def of(cls, space: Space, clearance_m: float) -> "Roads":
        """Return the paths between samples with a clearance."""
        low, usable = clear_samples(space, COARSE_M, 0.5, clearance_m)
        index = np.full(usable.shape, -1)
        index[usable] = np.arange(np.count_nonzero(usable))
        cells, shape = np.argwhere(usable), np.array(usable.shape)
        tails, heads, lengths = [], [], []
        for step in STEPS[len(STEPS) // 2 :]:
            to = cells + step
            tail = np.flatnonzero(np.all((to >= 0) & (to < shape), axis=1))
            head = index[tuple(to[tail].T)]
            tails.append(tail[head >= 0])
            heads.append(head[head >= 0])
            lengths.append(np.full(np.count_nonzero(head >= 0), COARSE_M * np.linalg.norm(step)))
        number = len(cells)
        graph = coo_array(
            (np.concatenate(lengths), (np.concatenate(tails), np.concatenate(heads))), shape=(number, number)
        )
        return cls(low + COARSE_M * cells, graph.tocsr())

    def bounds(self, start: Array, goals: Array) -> Array:
        """Return the lengths (K,) of paths from a start to goals (K, 3), less what steps exceed straight lines [m]."""
        tree = cKDTree(self.nodes)
        apart, node = tree.query(np.concatenate([start[None], goals]))
        paths = dijkstra(self.graph, directed=False, indices=int(node[0]))[node[1:]] / EXCESS - apart[0] - apart[1:]
        return np.asarray(np.maximum(np.where(np.isfinite(paths), paths, 0.0), np.linalg.norm(goals - start, axis=1)))


def queries(space: Space, number: int, solvable_m: float) -> list[tuple[Array, Array]]:
    """Return starts (3,) with their goals (K, 3), which the true space connects with a clearance."""
    low, is_clear = clear_samples(space, CELL_M, 0.25, solvable_m)
    parts, _ = ndimage.label(is_clear)
    rng, cells = np.random.default_rng(0), np.argwhere(parts)
    part = parts[tuple(cells.T)]
    found = []
    for _ in range(0, number, GOALS):
        chosen = int(rng.integers(len(cells)))
        goals = rng.choice(np.flatnonzero(part == part[chosen]), min(GOALS, number))
        found.append((low + CELL_M * cells[chosen], low + CELL_M * cells[goals]))
    return found


def least_clearance(space: Space, found: Route) -> float:
    """Return the smallest true clearance of a route, every 2 cm [m]."""
    legs = [np.linspace(a, b, 2 + int(np.linalg.norm(b - a) / 0.02)) for a, b in pairwise(found.waypoints)]
    return float(space.clearance(np.concatenate(legs)).min())


def measured(name: str, number: int, solvable_m: float) -> Row:
    """Return the row of a world."""
    space = solid_space(name, 0)
    grid = true_map(space, CELL_M)
    distance = distance_field(grid, unknown_is_obstacle=True)
    roads = [Roads.of(space, clearance_m) for clearance_m in (TRUE_M, CLEARANCE_M)]
    ratios, times, clearances, expansions, causes = [], [], [], [], []
    for start, goals in queries(space, number, solvable_m):
        for goal, least_m in zip(goals, np.transpose([each.bounds(start, goals) for each in roads]), strict=True):
            begin = time.process_time()
            found = route(grid, distance, start, goal, clearance_m=CLEARANCE_M)
            times.append(1e3 * (time.process_time() - begin))
            if isinstance(found, NoRoute) or found.short_of_goal_m > 1.0:
                causes.append(found.reason if isinstance(found, NoRoute) else "far from the goal")
                continue
            expansions.append(found.expansions)
            clearances.append(least_clearance(space, found))
            if least_m[0] > 1.0:
                ratios.append((found.length_m + found.short_of_goal_m) / least_m)
    for cause in causes[:3]:
        print(f"{name}: {cause}")
    to_bound, to_optimum = np.transpose(ratios)
    return {
        "world": name,
        "cells": f"{grid.states.size / 1e6:.2f} M",
        "solved": f"{100.0 * len(clearances) / len(times):.1f} % of {len(times)}",
        "least clearance": f"{min(clearances):.3f} m",
        "length / bound": f"{np.median(to_bound):.3f}, {np.percentile(to_bound, 99):.3f}",
        "length / optimum": f"{np.median(to_optimum):.3f}, {np.percentile(to_optimum, 99):.3f}",
        "expansions": f"{np.median(expansions):.0f}, {max(expansions)}",
        "CPU-ms": f"{np.median(times):.1f}, {np.percentile(times, 99):.0f}",
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", default=",".join(WORLDS), help="names, separated by commas")
    parser.add_argument("--queries", type=int, default=1000)
    parser.add_argument("--solvable-m", type=float, default=CLEARANCE_M, help="true clearance of solvable queries [m]")
    args = parser.parse_args()
    rows = [measured(name, args.queries, args.solvable_m) for name in args.worlds.split(",")]
    print_rows("Routes on perfect maps (median, 99th percentile)", rows)


if __name__ == "__main__":
    main()
