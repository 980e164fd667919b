"""Errors and cost of the dense map in simulated worlds, as tables.

``worlds`` builds three maps of each flight: of stereo depth on the true poses, of stereo depth on the poses of visual
SLAM, and of the true depth on the true poses. The dangerous error is false free space: of the true surface that the
camera saw within 2 m of the path, the share that is more than one cell from every cell that is not free; in the fused
map at the end, and in the local map, pooled over its uses once a second. The fused map is aligned with the truth by the
path in position and yaw, the local map by the newest pose. *Near free* is the share of the true free space in the
middle of the view, at depths of 0.5 to 1.5 m, that the local map knows at those times. Maps on true poses have an
odometry frame that is turned and shifted, so that walls do not lie between cells. The size is that of the packed
submaps by the volume of known cells. Flights are recorded with a stereo rig and the true depth.

``poles`` flies towards poles of 2, 4 and 8 cm at several places. ``movers`` counts what people and carts leave behind.
``loop`` compares the map of a flight that comes back, whose odometry is given more drift, with the same map without the
correction of its keyframes. ``taken-back`` compares a map after a correction that was wrong for a second with one that
never was. ``cost`` measures the processor time of each stage. ``long`` maps two floors in ten minutes, from rays, not
from images::

    dronevio fly --scenario room-easy --rig euroc-stereo --truth-images depth --out /tmp/maps/room
    python benchmarks/dense_map.py worlds /tmp/maps/room /tmp/maps/corridor
    python benchmarks/dense_map.py poles
    python benchmarks/dense_map.py movers /tmp/maps/moving
    python benchmarks/dense_map.py loop /tmp/maps/corridor-lap
    python benchmarks/dense_map.py taken-back /tmp/maps/room
    python benchmarks/dense_map.py cost /tmp/maps/room
    python benchmarks/dense_map.py long
"""

import sys
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from dense_map_runs import MapRun, in_world, runs_of
from dense_map_scenes import DISTANCES_M, cost_rows, long_rows, loop_rows, mover_rows, pole_rows, taken_back
from dense_map_truth import SeenSpace, seen_space
from measuring import Row, opened, print_as_made, text

from dronevio.estimator.mapping import DenseMapConfig
from dronevio.eval.metrics.occupancy import are_falsely_free, state_shares, surface_scores
from dronevio.models.arrays import Array, Mask
from dronevio.models.occupancy import FREE, UNKNOWN, OccupancyGrid
from dronevio.models.rig_presets import rig_named
from dronevio.models.state import Trajectory
from dronevio.sim.scenarios import scenario_named

BOUNDS = {"true poses": 1e-4, "estimate": 1e-3}
"""Largest share of falsely free surface samples, by the poses of the map."""
MIN_SAMPLES = 10_000
"""Smallest number of surface samples of a world."""
_LOCAL_EVERY_S = 1.0
_NEAR_M, _NEAR_SLOPE = (0.5, 1.5), np.array([0.6, 0.35])
"""Depths [m], and largest x / z and y / z, of the free space in front of the camera that is checked."""


@dataclass(frozen=True)
class WorldsCommand:
    """Measure the errors of the map in simulated flights."""

    recordings: tyro.conf.Positional[tuple[Path, ...]]
    """Recordings of simulated flights with a stereo rig and true depth images."""
    dense: DenseMapConfig = field(default_factory=DenseMapConfig)
    """Settings of the map."""
    worst: int = 0
    """Number of places to print at which most falsely free samples lie, for each map."""


@dataclass(frozen=True)
class PolesCommand:
    """Measure from where poles of 2, 4 and 8 cm are occupied."""

    rig: str = "pinhole-stereo"
    """Name of a stereo rig."""
    places: int = 5
    """Number of places in front of which the poles stand, a flight each."""
    dense: DenseMapConfig = field(default_factory=DenseMapConfig)
    """Settings of the map."""


@dataclass(frozen=True)
class _RecordingCommand:
    recording: tyro.conf.Positional[Path]
    """Recording of a simulated flight with a stereo rig."""
    dense: DenseMapConfig = field(default_factory=DenseMapConfig)
    """Settings of the map."""


@dataclass(frozen=True)
class MoversCommand(_RecordingCommand):
    """Measure which cells of moving things stay occupied."""


@dataclass(frozen=True)
class LoopCommand(_RecordingCommand):
    """Compare the map that bends with one that does not."""

    drift: bool = True
    """Whether the odometry is given a drift of 1 % of the path and 0.05 degrees a metre."""


@dataclass(frozen=True)
class TakenBackCommand(_RecordingCommand):
    """Compare the map after a wrong correction with the one without it."""


@dataclass(frozen=True)
class CostCommand(_RecordingCommand):
    """Measure the processor time of the stages of an update."""


@dataclass(frozen=True)
class LongCommand:
    """Measure cost and size of the map over ten minutes and two floors."""

    dense: DenseMapConfig = field(default_factory=DenseMapConfig)
    """Settings of the map."""


@dataclass(eq=False)
class LocalChecks:
    """False free space, and the known free space in front of the camera, of the local maps of a flight while used."""

    seen: SeenSpace
    """What the camera saw."""
    truth: Trajectory
    """The true trajectory."""
    T_imu_cam: Array
    """(4, 4) Pose of the camera in the IMU frame."""
    last_ns: dict[str, int] = field(default_factory=dict)
    """Time of the newest check of each map [ns]."""
    counts: dict[str, Array] = field(default_factory=lambda: defaultdict(lambda: np.zeros(2)))
    """Numbers of falsely free samples and of all samples, by map."""
    near: dict[str, Array] = field(default_factory=lambda: defaultdict(lambda: np.zeros(2)))
    """Numbers of points of near free space that are known to be free, and of all, by map."""

    def __call__(self, name: str, run: MapRun) -> None:
        """Check the local map of a run if the newest check is long ago."""
        t_ns, grid, T_odom_imu = run.t_ns[-1], run.mapper.local_map, run.estimates[-1].T_odom_imu
        if grid is None or T_odom_imu is None or t_ns - self.last_ns.get(name, -(10**12)) < _LOCAL_EVERY_S * 1e9:
            return
        self.last_ns[name] = t_ns
        T = run.T_grid_world(self.truth)
        points = self.seen.surface[self.seen.surface_ns <= t_ns] @ T[:3, :3].T + T[:3, 3]
        inside = np.all((points > grid.low_m) & (points < grid.high_m), axis=1)
        wrong = are_falsely_free(grid, points[inside])
        self.counts[name] += wrong.sum(), len(wrong)
        free = self.seen.free @ T[:3, :3].T + T[:3, 3]
        near = free[_are_near(free, T_odom_imu @ self.T_imu_cam)]
        self.near[name] += (grid.at(near) == FREE).sum(), len(near)


def _are_near(points: Array, T_odom_cam: Array) -> Mask:
    """Return which points (N, 3) are in the middle of the view of a camera and near to it."""
    rays = (points - T_odom_cam[:3, 3]) @ T_odom_cam[:3, :3]
    low_m, high_m = _NEAR_M
    near = (rays[:, 2] > low_m) & (rays[:, 2] < high_m)
    return np.asarray(near & np.all(np.abs(rays[:, :2]) < rays[:, 2:] * _NEAR_SLOPE, axis=1))


def rows_of(folder: Path, command: WorldsCommand) -> Iterator[Row]:
    """Yield the rows of the maps of a flight."""
    recording, truth = opened(folder, 2)
    seen = seen_space(folder, truth, recording.rig.cameras[0], recording.frame_times_ns[::2], command.dense.range_m)
    checks = LocalChecks(seen, truth, recording.rig.cameras[0].T_imu_cam)
    for name, run in runs_of(folder, recording, command.dense, checks).items():
        grid = run.mapper.fused()
        if grid is None:
            yield {"flight": folder.name, "map": name}
            continue
        R, t = in_world(run, truth, grid)
        entered = seen.surface_ns >= run.t_ns[0]
        surface = seen.surface[entered] @ R.T + t
        wrong = are_falsely_free(grid, surface)
        if command.worst:
            print_worst(seen.surface[entered], wrong, command.worst)
        known_m3 = float((grid.states != UNKNOWN).sum()) * grid.cell_m**3
        row = row_of(folder.name, name, grid, wrong, checks.counts[name], surface, seen, (R, t))
        known, points = checks.near[name]
        row = {**row, "near free": percent(known / max(points, 1.0), 1)}
        yield {**row, "MB per 1000 m³": text(1e-3 * run.mapper.packed_bytes / known_m3, ".2f")}


def row_of(
    flight: str,
    name: str,
    grid: OccupancyGrid,
    wrong: Mask,
    local: Array,
    surface: Array,
    seen: SeenSpace,
    grid_world: tuple[Array, Array],
) -> Row:
    """Return the row of a map."""
    R, t = grid_world
    shares = state_shares(grid, seen.free @ R.T + t)
    scores = surface_scores(grid, seen.all_surface @ R.T + t, surface, DISTANCES_M)
    return {
        "flight": flight,
        "map": name,
        "samples": str(len(wrong)),
        "false free": percent(float(wrong.mean())),
        "at most": percent(BOUNDS[name]) if name in BOUNDS else "–",
        "local map": percent(local[0] / max(local[1], 1.0)),
        "accuracy": " ".join(text(100.0 * score.accuracy, ".0f") for score in scores),
        "completeness": " ".join(text(100.0 * score.completeness, ".0f") for score in scores),
        "free known": percent(shares.free, 1),
        "free occupied": percent(shares.occupied, 1),
    }


def percent(share: float, digits: int = 3) -> str:
    """Return a share as text."""
    return f"{100.0 * share:.{digits}f} %"


def print_worst(points: Array, wrong: Mask, count: int) -> None:
    """Print the cubes of half a metre with most falsely free samples."""
    cubes, numbers = np.unique(np.floor(points[wrong] / 0.5), axis=0, return_counts=True)
    for row in np.argsort(-numbers)[:count]:
        print(f"{numbers[row]} falsely free around {0.5 * cubes[row] + 0.25} m", file=sys.stderr)


def show(
    command: WorldsCommand | PolesCommand | MoversCommand | LoopCommand | TakenBackCommand | CostCommand | LongCommand,
) -> None:
    """Print the table of a command."""
    if isinstance(command, WorldsCommand):
        print_as_made(row for folder in command.recordings for row in rows_of(folder, command))
    elif isinstance(command, PolesCommand):
        print_as_made(pole_rows(rig_named(command.rig), command.dense, command.places))
    elif isinstance(command, MoversCommand):
        print_as_made(mover_rows(command.recording, command.dense))
    elif isinstance(command, LoopCommand):
        print_as_made(loop_rows(command.recording, command.dense, command.drift))
    elif isinstance(command, CostCommand):
        print_as_made(cost_rows(command.recording, command.dense))
    elif isinstance(command, TakenBackCommand):
        print(taken_back(command.recording, command.dense))
    else:
        floors = [scenario_named("corridor-laps", seed) for seed in range(2)]
        print_as_made(long_rows(floors, rig_named("euroc-stereo"), command.dense))


Command = (
    Annotated[WorldsCommand, tyro.conf.subcommand("worlds")]
    | Annotated[PolesCommand, tyro.conf.subcommand("poles")]
    | Annotated[MoversCommand, tyro.conf.subcommand("movers")]
    | Annotated[LoopCommand, tyro.conf.subcommand("loop")]
    | Annotated[TakenBackCommand, tyro.conf.subcommand("taken-back")]
    | Annotated[CostCommand, tyro.conf.subcommand("cost")]
    | Annotated[LongCommand, tyro.conf.subcommand("long")]
)


if __name__ == "__main__":
    show(tyro.cli(Command, description=__doc__))
