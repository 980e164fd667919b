"""Corridors and trajectories between random boxes: how many queries are solved, and the processor time of a plan.

The polylines have three legs with .55 m clearance in a box of 10 × 10 × 3 m; cells of .1 m are passable with .35 m.
Each trajectory from rest is then planned again from its state at three times, in the rest of its corridor: to its end,
and to a stop at any place of two boxes. ``stretch`` is the duration of the new plan by what was left of the old one.

    python benchmarks/corridors.py --queries 100
"""

import argparse
import time
from collections.abc import Iterator

import numpy as np
from measuring import Row, print_as_made

from dronevio.autonomy.planning.corridor import Corridor, corridor_along, passable
from dronevio.autonomy.planning.trajectory import CorridorTrajectory, corridor_trajectory
from dronevio.estimator.mapping.distance import distance_field
from dronevio.models.arrays import Array, Mask
from dronevio.models.occupancy import FREE, OCCUPIED, OccupancyGrid
from dronevio.sim.paths.limits import Limits

OBSTACLES = (10, 30, 60)
CELL_M, RADIUS_M, MARGIN_M, REACH_M = 0.1, 0.35, 0.55, 2.0
TRIES = 200  # places that are tried for the next corner of a polyline
LIMITS = Limits(speed_m_s=2.5, accel_m_s2=3.0)
TIMES = (0.25, 0.5, 0.75)


def queries(rng: np.random.Generator, obstacles: int, count: int) -> Iterator[tuple[OccupancyGrid, Mask, Array]]:
    """Yield grids of random boxes, which of their cells are passable, and polylines (4, 3) through them [m]."""
    while count:
        states = np.full((100, 100, 30), FREE, np.uint8)
        for low in rng.integers(0, (95, 95, 20), (obstacles, 3)):
            states[tuple(slice(k, k + n) for k, n in zip(low, rng.integers(3, 15, 3), strict=True))] = OCCUPIED
        grid = OccupancyGrid(np.zeros(3), CELL_M, states)
        distance = distance_field(grid, unknown_is_obstacle=True)
        roomy = passable(grid, distance, MARGIN_M)
        cells, points = np.argwhere(roomy), np.zeros((0, 3))
        for end in grid.centres(cells[rng.integers(len(cells), size=TRIES)]):
            leg = np.linspace(points[-1] if len(points) else end, end, 500)
            if np.all(roomy[tuple(grid.cells(leg).T)]):
                points = np.vstack([points, end])
        if len(points) >= 4:
            count -= 1
            yield grid, passable(grid, distance, RADIUS_M), points[:4]


def rest_of(corridor: Corridor, trajectory: CorridorTrajectory, time_s: float) -> Corridor:
    """Return the boxes of a corridor from the one in which a trajectory is at a time [s]."""
    piece = min(int(np.searchsorted(trajectory.knots_s, time_s, side="right")) - 1, len(trajectory.boxes) - 1)
    first = trajectory.boxes[piece]
    return Corridor(corridor.low_m[first:], corridor.high_m[first:])


def row(obstacles: int, count: int) -> Row:
    """Return the row of a number of obstacles."""
    boxes_ms, plan_ms, again_ms, stop_ms, stretch, sizes, speeds = [], [], [], [], [], [], []
    solved, inside, again, stopped, tries = 0, 0, 0, 0, 0
    for grid, is_passable, polyline in queries(np.random.default_rng(0), obstacles, count):
        began = time.process_time()
        corridor = corridor_along(grid, is_passable, polyline, REACH_M)
        boxes_ms.append(1e3 * (time.process_time() - began))
        if corridor is None:
            continue
        began = time.process_time()
        rest = np.vstack([polyline[:1], np.zeros((3, 3))])
        trajectory = corridor_trajectory(corridor, rest, polyline[-1], LIMITS)
        plan_ms.append(1e3 * (time.process_time() - began))
        if trajectory is None:
            continue
        solved += 1
        path = trajectory.path(np.linspace(0.0, trajectory.duration_s, 200))
        inside += bool(np.all(is_passable[tuple(grid.cells(path).T)]))
        sizes.append(len(corridor.low_m))
        speeds.append(np.linalg.norm(np.diff(path, axis=0), axis=1).sum() / trajectory.duration_s)
        for share in TIMES:
            now = share * trajectory.duration_s
            left, state = rest_of(corridor, trajectory, now), trajectory.state(now)
            tries += 1
            began = time.process_time()
            new = corridor_trajectory(left, state, polyline[-1], LIMITS)
            again_ms.append(1e3 * (time.process_time() - began))
            began = time.process_time()
            stop = corridor_trajectory(Corridor(left.low_m[:2], left.high_m[:2]), state, None, LIMITS)
            stop_ms.append(1e3 * (time.process_time() - began))
            stopped += stop is not None
            if new is not None:
                again += 1
                stretch.append(new.duration_s / (trajectory.duration_s - now))
    spread = [f"{np.median(ms):.1f}, {np.percentile(ms, 99):.1f}" for ms in (boxes_ms, plan_ms, again_ms, stop_ms)]
    return {
        "obstacles": str(obstacles),
        "solved": f"{solved} of {count}",
        "inside": f"{inside} of {solved}",
        "boxes": f"{np.median(sizes):.0f}, {max(sizes)}",
        "speed [m/s]": f"{np.median(speeds):.2f}",
        "again": f"{again} of {tries}",
        "stretch": f"{np.median(stretch):.2f}",
        "stopped": f"{stopped} of {tries}",
        "ms: boxes": spread[0],
        "from rest": spread[1],
        "again [ms]": spread[2],
        "stop [ms]": spread[3],
    }


def main() -> None:
    """Print a row for each number of obstacles: times are the median and the 99th percentile of a call."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--queries", type=int, default=100, help="queries for each number")
    count = parser.parse_args().queries
    print_as_made(row(obstacles, count) for obstacles in OBSTACLES)


if __name__ == "__main__":
    main()
