"""``dronevio map``: the dense map of a recording."""

import resource
import shlex
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from dronevio.cli.imported_settings import ImportedSettings
from dronevio.cli.options import Output, OutputOptions, RecordingInput, RecordingOptions
from dronevio.cli.settings.changes import SettingsInput, SettingsOptions
from dronevio.cli.settings.option_tables import DENSE_MAP, ESTIMATOR, MAP, options_from
from dronevio.cli.terminal import (
    command_line,
    parse,
    print_defects,
    print_json,
    print_run_warnings,
    print_values,
    print_warning,
    progress_bars,
)
from dronevio.estimator.mapping.config import DenseMapConfig
from dronevio.models.ranges import Range, Settings

if TYPE_CHECKING:
    from dronevio.cli.progress import Bars
    from dronevio.dense_mapping import DenseMap, DepthListener
    from dronevio.estimator.config import VioConfig
    from dronevio.estimator.mapping.dense_mapper import DenseMapper
    from dronevio.estimator.slam.config import SlamConfig
    from dronevio.eval.report.dense_map import DenseMapFigures
    from dronevio.eval.rerun.dense_map import DenseMapLog
    from dronevio.models.depth import DepthImage
    from dronevio.models.recordings.open import StoredRecording
    from dronevio.models.state import Estimate

BAND_M = 0.3
"""Distance of the ends of the band of heights of the ROS map from the median height of the flight [m]."""


@dataclass(frozen=True)
class MapCommand(Settings):
    """Map what is free, occupied and unknown along a recording, and the surfaces that it shows.

    The estimator runs on the recording, and depth from a stereo pair, or from the motion of one camera, enters the map
    at the estimated poses. Loops correct the map, unless --no-slam is given. True poses are not used.

    The result is a folder with report.html, the surfaces as mesh.ply and points.ply, the occupied, free and unknown
    cells as occupancy.npz and, in a band of heights, as a map of ROS (map.pgm, map.yaml), the path as map.tum, and
    run.rrd, in which the map grows (for `dronevio view`).

    Examples:
      dronevio map MH_01_easy
      dronevio map flight.mcap --calibration camchain.yaml imu.yaml --out hall
      dronevio map MH_01_easy --cell-m 0.05 --range-m 3
      dronevio map MH_01_easy --band-m 0.2 1.8
      dronevio map MH_01_easy --cameras 0 --no-slam
      dronevio map GOPR0001.MP4 --calibration camera.yaml --imu MPU-6050
      dronevio map MH_01_easy --live
    """

    recording: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RECORDING")]
    """Folder of EuRoC, TUM-VI, DSO or KITTI, bag of ROS 1 or ROS 2, or GoPro video."""
    out: Path | None = None
    """Folder to make; by default it is maps/NAME, with a number appended if that exists."""
    slam: bool = True
    """Correct the map by loops, where a place is seen again."""
    band_m: Annotated[tuple[float, float] | None, Range(-10_000.0, 10_000.0)] = None
    """Lowest and highest z of the cells that the map of ROS combines, in the frame of the map [m]; by default 0.3 m
    below to 0.3 m above the median height of the flight."""
    live: bool = False
    """Show the map in a rerun viewer while it grows: in a window if there is a display, otherwise in a browser of this
    machine. The viewer ends with the command."""
    reading: RecordingInput = field(default_factory=RecordingOptions)
    """How the recording is read."""
    output: Output = field(default_factory=OutputOptions)
    """How the result is written and printed."""
    dense: Annotated[DenseMapConfig, tyro.conf.arg(name="")] = field(
        default_factory=DenseMapConfig, metadata=options_from(DENSE_MAP)
    )
    """Settings of the dense map."""
    estimator: "VioConfig" = field(
        default_factory=ImportedSettings("dronevio.estimator.config", "VioConfig"), metadata=options_from(ESTIMATOR)
    )
    """Settings of the estimator."""
    map: "SlamConfig" = field(
        default_factory=ImportedSettings("dronevio.estimator.slam.config", "SlamConfig"), metadata=options_from(MAP)
    )
    """Settings of visual SLAM."""
    changes: SettingsInput = field(default_factory=SettingsOptions)
    """Changes of settings."""


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    command = parse(MapCommand, arguments, "map")

    from dronevio.cli.output_files import require_free, reserved_folder
    from dronevio.cli.reservations import reserved, reserved_free_name
    from dronevio.models.errors import ConfigError

    if command.band_m is not None and not command.band_m[0] <= command.band_m[1]:
        raise ConfigError(f"--band-m {command.band_m[0]:g} {command.band_m[1]:g}; expected the lower end first")
    if command.out is not None:
        require_free(command.out, command.output.overwrite)  # before the recording is read
    recording = _opened(command)
    wanted = Path("maps") / (command.recording.resolve().name or "recording")
    with (
        reserved_free_name(wanted) if command.out is None else reserved(command.out) as target,
        reserved_folder(target, command.output.overwrite, mark="report.json") as folder,
        progress_bars(quiet=command.output.json) as bars,
    ):
        figures, summary = _mapped(command, arguments, recording, folder, target, bars)
    if command.output.json:
        print_json({"recording": str(command.recording), "map": str(target), **summary})
        return 0
    print_values(f"Map of {recording.name}", figures.rows())
    print(f"files:    {target}/{{{','.join(summary['files'])}}}")
    print(f"report:   {target}/report.html")
    print(f"open it:  {command_line('view', target)}")
    return 0


def _opened(command: MapCommand) -> "StoredRecording":
    """Open the recording, print its defects, and return the longest of its segments.

    Raises:
        InputError: It cannot be read.
        ConfigError: An option does not fit it, or it has no camera.
    """
    from dronevio.models.recordings.segments import segments_of

    segments = segments_of(command.reading.open(command.recording, repair=True))
    longest = max(segments, key=lambda segment: len(segment.frame_times_ns))
    if len(segments) > 1:
        left_out = len(segments) - 1
        print_warning(f"the clock steps {left_out} times; the map has the longest part, {longest.name}, alone")
    print_defects(longest.defects)
    return longest


def _mapped(
    command: MapCommand,
    arguments: Sequence[str],
    recording: "StoredRecording",
    folder: Path,
    target: Path,
    bars: "Bars",
) -> "tuple[DenseMapFigures, dict[str, Any]]":
    """Map a recording and write all results into a folder; return the figures and the summary for ``--json``."""
    from dronevio.dense_mapping import map_recording
    from dronevio.estimator.odometry import VisualInertialOdometry
    from dronevio.estimator.slam.visual_slam import VisualSlam
    from dronevio.eval.rerun.dense_map import dense_map_file

    rig = recording.rig
    estimator = (
        VisualSlam(rig, command.estimator, command.map)
        if command.slam
        else VisualInertialOdometry(rig, command.estimator)
    )
    with ExitStack() as stack:
        file = stack.enter_context(dense_map_file(folder / "run.rrd", recording))
        logs = [file, *stack.enter_context(_viewers(command, recording))]
        mapped = map_recording(
            recording,
            command.dense,
            estimator,
            listeners=[_listener(log) for log in logs],
            progress=bars.bar("mapping"),
            surface_progress=bars.bar("surfaces"),
        )
        for log in logs:
            log.finish(mapped.submaps, mapped.mesh, mapped.trajectory)
    print_defects(mapped.run.defects[len(recording.defects) :])
    print_run_warnings(mapped.run)
    return _written(command, arguments, recording, mapped, folder, target)


def _listener(log: "DenseMapLog") -> "DepthListener":
    """Return what passes depth images to a log."""

    def listener(depth: "DepthImage", estimate: "Estimate", mapper: "DenseMapper") -> None:
        log.depth(depth, estimate, lambda: mapper.submaps)

    return listener


@contextmanager
def _viewers(command: MapCommand, recording: "StoredRecording") -> Iterator["list[DenseMapLog]"]:
    """Show a live viewer until the context ends, if one is asked for; yield its logs."""
    if not command.live:
        yield []
        return
    from dronevio.cli.commands.view import viewer_process
    from dronevio.eval.rerun.dense_map import dense_map_viewer

    with viewer_process() as address, dense_map_viewer(address, recording) as log:
        yield [log]


def _written(
    command: MapCommand,
    arguments: Sequence[str],
    recording: "StoredRecording",
    mapped: "DenseMap",
    folder: Path,
    target: Path,
) -> "tuple[DenseMapFigures, dict[str, Any]]":
    """Write the files of a map; return its figures and the summary for ``--json``."""
    import numpy as np

    from dronevio import __version__
    from dronevio.eval.provenance import RunInfo
    from dronevio.eval.report.dense_map import DenseMapFigures, DenseMapResults, write_dense_map_report
    from dronevio.models.occupancy_maps import layer_of, write_occupancy, write_ros_map
    from dronevio.models.reconstructions.ply_surfaces import write_cloud, write_mesh
    from dronevio.models.recordings.tum import write_tum
    from dronevio.models.serialization import to_jsonable

    middle = float(np.median(mapped.trajectory.p_world_imu[:, 2])) if len(mapped.trajectory) else 0.0
    band_m = command.band_m or (middle - BAND_M, middle + BAND_M)
    write_mesh(folder / "mesh.ply", mapped.mesh)
    write_cloud(folder / "points.ply", mapped.cloud)
    write_occupancy(folder / "occupancy.npz", mapped.occupancy)
    write_ros_map(folder / "map.yaml", layer_of(mapped.occupancy, *band_m))
    write_tum(folder / "map.tum", mapped.trajectory)
    figures = DenseMapFigures.of(
        mapped.occupancy,
        mapped.submaps,
        mapped.cloud,
        mapped.mesh,
        frames=len(mapped.run.estimates),
        path_m=mapped.trajectory.length_m,
        estimator_cpu_ms=mapped.run.cpu_ms,
        depth_cpu_ms=mapped.depth_cpu_ms,
        peak_memory_gb=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2,
    )
    settings = {"dense": command.dense, "estimator": command.estimator, "slam": command.map if command.slam else None}
    info = RunInfo(
        title=f"Map: {recording.name}",
        command=shlex.join(["dronevio", "map", *arguments]),
        open_command=command_line("view", target),
        configuration={"dronevio": __version__, **{name: to_jsonable(value) for name, value in settings.items()}},
    )
    results = DenseMapResults(mapped.occupancy, mapped.mesh, mapped.trajectory, band_m, figures)
    write_dense_map_report(folder, info, results)
    files = sorted(path.name for path in folder.iterdir())
    return figures, {**asdict(figures), "band_m": list(band_m), "files": files}
