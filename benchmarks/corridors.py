"""Corridors and trajectories in the worlds: how many queries are solved, and the processor time of a plan.

The polylines join random places of a world at most 8 m apart with .5 m clearance; cells of .1 m are passable with .35 m
to what collides. Each trajectory from rest is then planned again from its state at three times, in the rest of its
corridor: to its end, and to a stop at any place. ``stretch`` is the duration of the new plan by what was left of the old.

    python benchmarks/corridors.py --queries 100
"""

import argparse
import time
from collections.abc import Iterator

import numpy as np
from measuring import Row, print_as_made

from dronevio.autonomy.corridor import Corridor, corridor_along
from dronevio.autonomy.trajectory import CorridorTrajectory, corridor_trajectory
from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.occupancy import FREE, UNKNOWN, OccupancyGrid
from dronevio.sim.paths.limits import Limits
from dronevio.sim.paths.route import collision_free_polyline
from dronevio.sim.paths.space import Space
from dronevio.sim.world import solid_space

WORLDS = ("room", "forest")
CELL_M, RADIUS_M, MARGIN_M, REACH_M = 0.1, 0.35, 0.5, 2.0
NEAREST_M, FARTHEST_M, HEIGHT_M = 3.0, 8.0, 2.5
LIMITS = Limits(speed_m_s=2.5, accel_m_s2=3.0)
TIMES = (0.25, 0.5, 0.75)


def polylines(space: Space, rng: np.random.Generator, count: int) -> Iterator[Array]:
    """Yield polylines (N, 3) between random places of a space."""
    high = np.minimum(space.high, np.append(space.high[:2], space.low[2] + HEIGHT_M))
    while count:
        ends = rng.uniform(space.low, high, (2, 3))
        length = np.linalg.norm(ends[1] - ends[0])
        if not NEAREST_M < length < FARTHEST_M or space.clearance(ends).min() < MARGIN_M:
            continue
        try:
            yield collision_free_polyline(space, ends, MARGIN_M, ["start", "goal"])
        except ConfigError:
            continue
        count -= 1


def grid_around(space: Space, polyline: Array) -> OccupancyGrid:
    """Return the grid of passable cells, which are FREE, around a polyline."""
    low = polyline.min(axis=0) - REACH_M
    shape = np.ceil((polyline.max(axis=0) + REACH_M - low) / CELL_M).astype(int)
    grid = OccupancyGrid(low, CELL_M, np.zeros(shape, np.uint8))
    centres = grid.centres(np.argwhere(np.ones(shape, dtype=bool)))
    states = np.where(space.clearance(centres) >= RADIUS_M, FREE, UNKNOWN).astype(np.uint8)
    return OccupancyGrid(low, CELL_M, states.reshape(shape))


def rest_of(corridor: Corridor, trajectory: CorridorTrajectory, time_s: float) -> Corridor:
    """Return the boxes of a corridor from the one in which a trajectory is at a time [s]."""
    piece = min(int(np.searchsorted(trajectory.knots_s, time_s, side="right")) - 1, len(trajectory.boxes) - 1)
    first = trajectory.boxes[piece]
    return Corridor(corridor.low_m[first:], corridor.high_m[first:])


def row(world: str, queries: int) -> Row:
    """Return the row of a world."""
    space, rng = solid_space(world, 0), np.random.default_rng(0)
    boxes_ms, plan_ms, again_ms, stop_ms, stretch, clearance, speeds = [], [], [], [], [], [], []
    solved, again, stopped, tries = 0, 0, 0, 0
    for polyline in polylines(space, rng, queries):
        grid = grid_around(space, polyline)
        began = time.process_time()
        corridor = corridor_along(grid, grid.states == FREE, polyline, REACH_M)
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
        clearance.append(space.clearance(path).min())
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
        "world": world,
        "solved": f"{solved} of {queries}",
        "least clearance [m]": f"{min(clearance):.2f}",
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
    """Print a row for each world: times are the median and the 99th percentile of a call."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--queries", type=int, default=100, help="queries in each world")
    queries = parser.parse_args().queries
    print_as_made(row(world, queries) for world in WORLDS)


if __name__ == "__main__":
    main()
