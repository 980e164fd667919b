"""Reloaded maps: flights that begin with the map of another flight in the same world, as a Markdown table.

The first recording is mapped, and its final map is saved in a temporary file. Each further recording is estimated with
that map, from its first frame on, and again from 10 s later on, where the vehicle is in the air. The final path of the
first flight is aligned with the ground truth by yaw and position, and this alignment relates the frame of the file to
the world: the errors of all flights in the map frame are those after it. Only the odometry is aligned by itself. A
recording can be reloaded in the map of its own beginning (`--mapped-s`)::

    .venv/bin/dronevio fly --scenario room-square --seed 0 --out recordings/mapped
    .venv/bin/dronevio fly --scenario room-square --seed 1 --world-seed 0 --light-seed 1 --out recordings/light
    .venv/bin/python benchmarks/reloaded_maps.py recordings/mapped recordings/light
    .venv/bin/python benchmarks/reloaded_maps.py recordings/V1_02 recordings/V1_02 --mapped-s 40 --starts-s 40
"""

import tempfile
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from measuring import ChangedRecording, opened, print_as_made, text, with_truth

from dronevio.api import estimate
from dronevio.estimator.slam.visual_slam import VisualSlam
from dronevio.eval.metrics.alignment import Alignment, align
from dronevio.eval.metrics.association import interpolate
from dronevio.eval.metrics.errors import Statistics, ate, translation_errors_m
from dronevio.eval.run import EstimatorRun
from dronevio.models.errors import ConfigError
from dronevio.models.protocols import Recording
from dronevio.models.recordings.open import open_recording
from dronevio.models.recordings.scenario_file import world_of
from dronevio.models.state import Trajectory
from dronevio.recording.excerpts import excerpt_of


@dataclass(frozen=True)
class ReloadedMapsCommand:
    """Measure how flights find their way in the map of another flight."""

    mapped: Annotated[Path, tyro.conf.Positional]
    """Recording of the flight that is mapped."""
    flights: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Recordings of flights in the same world."""
    cameras: int = 1
    """Number of cameras that the estimator uses."""
    starts_s: tuple[float, ...] = (0.0, 10.0)
    """Times after the first frame at which each flight begins [s]."""
    mapped_s: float | None = None
    """Time after the first frame at which the flight that is mapped ends [s]; None for all of it."""
    localize_only: bool = False
    """Leave the map as it is, instead of going on with mapping."""


def beginning(whole: Recording, duration_s: float) -> ChangedRecording:
    """Return the beginning of a recording, with its ground truth, up to a time after the first frame [s]."""
    frames_ns, imu, truth = whole.frame_times_ns, whole.imu, whole.ground_truth
    end_ns = int(frames_ns[0]) + round(1e9 * duration_s)
    return ChangedRecording(
        f"{whole.name} until {duration_s:g} s",
        whole.rig,
        imu[: int(np.searchsorted(imu.t_ns, end_ns))],
        frames_ns[frames_ns < end_ns],
        whole.frame,
        None if truth is None else truth[truth.t_ns < end_ns],
    )


@dataclass(frozen=True)
class Reloaded:
    """What a flight made of a loaded map."""

    joined_s: float | None
    """Time from the first pose of the odometry to the first one in the map frame [s]; None without one."""
    first_error_m: float | None
    """Position error of that pose [m]."""
    rmse_m: float | None
    """RMSE of the position in the map frame, as it was published [m]."""
    final_m: float | None
    """RMSE of the position of the final path in the map frame [m]."""
    loops: int
    """Number of closed loops whose later keyframe is one of this flight."""
    odometry_m: float
    """RMSE of the position of the odometry, aligned by itself by yaw and position [m]."""
    adjustment: str = ""
    """The outcome of the bundle adjustment of the final map."""


def outcome_of(run: EstimatorRun, truth: Trajectory, in_world: Alignment) -> Reloaded:
    """Return what a flight made of a loaded map.

    Args:
        run: The estimates, with the final map.
        truth: The ground truth.
        in_world: The alignment of the map frame with the world of the ground truth.
    """
    odometry, mapped = run.trajectory, run.map_trajectory
    true, rows = interpolate(truth, odometry.t_ns)
    odometry_m = ate(true.p_world_imu, odometry.p_world_imu[rows]).rmse
    if not len(mapped):
        return Reloaded(None, None, None, None, 0, odometry_m)
    true, rows = interpolate(truth, mapped.t_ns)
    errors_m = translation_errors_m(true.p_world_imu, in_world.positions(mapped.p_world_imu[rows]))
    joined_s = float(mapped.t_ns[0] - odometry.t_ns[0]) * 1e-9
    rmse_m = Statistics.of(errors_m).rmse
    final, final_m = run.final_trajectory, None
    if len(final):
        true, rows = interpolate(truth, final.t_ns)
        final_errors_m = translation_errors_m(true.p_world_imu, in_world.positions(final.p_world_imu[rows]))
        final_m = Statistics.of(final_errors_m).rmse
    adjustment, loops = "" if run.map is None else run.map.adjustment, _loops_since(run, run.t_ns[0])
    return Reloaded(joined_s, float(errors_m[0]), rmse_m, final_m, loops, odometry_m, adjustment)


def map_frame_in_world(run: EstimatorRun, truth: Trajectory) -> tuple[Alignment, float]:
    """Return the alignment of the map frame of a flight with the world by its final path, and its RMSE [m].

    Args:
        run: The estimates of the flight, with the final map.
        truth: The ground truth.
    """
    final = run.final_trajectory
    true, rows = interpolate(truth, final.t_ns)
    p_map = final.p_world_imu[rows]
    return align(true.p_world_imu, p_map), ate(true.p_world_imu, p_map).rmse


def _loops_since(run: EstimatorRun, begin_ns: int) -> int:
    """Return the number of closed loops whose later keyframe is at a time or after it."""
    return 0 if run.map is None else int(np.sum(run.map.t_ns[run.map.closed[:, 1]] >= begin_ns))


def row_of(name: str, start_s: float, found: Reloaded) -> dict[str, str]:
    """Return the row of a flight."""
    errors_m = found.first_error_m, found.rmse_m, found.final_m
    first_mm, rmse_mm, final_mm = (None if m is None else 1e3 * m for m in errors_m)
    return {
        "flight": f"`{name}`",
        "begins at [s]": f"{start_s:g}",
        "joined [s]": text(found.joined_s, ".2f"),
        "error at first [mm]": text(first_mm, ".1f"),
        "RMSE [mm]": text(rmse_mm, ".1f"),
        "final [mm]": text(final_mm, ".1f"),
        "loops": str(found.loops),
        "odometry [mm]": f"{1e3 * found.odometry_m:.1f}",
        "adjustment": found.adjustment or "–",
    }


def rows_in(file: Path, in_world: Alignment, command: ReloadedMapsCommand) -> Iterator[dict[str, str]]:
    """Yield the rows of all flights in the map of a file, whose frame is aligned with the world."""
    for flight, start_s in product(command.flights, command.starts_s):
        excerpt, truth = with_truth(excerpt_of(open_recording(flight, command.cameras), start_s))
        with closing(VisualSlam(excerpt.rig, map=file, localize_only=command.localize_only)) as slam:
            yield row_of(flight.name, start_s, outcome_of(estimate(excerpt, slam), truth, in_world))


def main(command: ReloadedMapsCommand) -> None:
    """Print the accuracy and the size of the map, and a row for each flight.

    Raises:
        ConfigError: A flight is in another world than the map.
        InputError: A recording cannot be read.
    """
    for flight in command.flights:
        if flight != command.mapped and world_of(flight) != world_of(command.mapped):
            raise ConfigError(f"{flight} is in another world than {command.mapped}; expected the same --world-seed")
    recording, truth = opened(command.mapped, command.cameras)
    if command.mapped_s is not None:
        recording, truth = with_truth(beginning(recording, command.mapped_s))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "first.map"
        with closing(VisualSlam(recording.rig)) as slam:
            run = estimate(recording, slam)
            slam.save_map(file)
        in_world, final_m = map_frame_in_world(run, truth)
        path_m, megabytes = truth.length_m, file.stat().st_size * 1e-6
        print(f"Final path of the first flight: RMSE {1e3 * final_m:.1f} mm over {path_m:.1f} m.")
        print(f"Map: {megabytes:.1f} MB, {megabytes / path_m:.2f} MB per metre.\n", flush=True)
        print_as_made(rows_in(file, in_world, command))


if __name__ == "__main__":
    main(tyro.cli(ReloadedMapsCommand, description=__doc__))
