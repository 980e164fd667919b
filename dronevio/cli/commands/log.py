"""``dronevio log``: estimates of any program and their recording in one rerun file."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from dronevio.cli.options import Output, OutputOptions, RecordingInput, RecordingOptions
from dronevio.cli.terminal import (
    command_line,
    parse,
    print_defects,
    print_json,
    print_table,
    print_warning,
    progress_bars,
)
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.ranges import Range, Settings

if TYPE_CHECKING:
    from dronevio.eval.rerun.compare import NamedEstimate


@dataclass(frozen=True)
class LogCommand(Settings):
    """Write estimated trajectories and their recording to a rerun file, which `dronevio view` opens.

    The file shows the estimated and true paths, the errors over time, the scores, the images of all cameras, the IMU
    samples, and the surroundings of a simulated flight. Estimates of any program are accepted: TUM files or EuRoC CSV
    files with poses of the IMU whose time stamps are those of the recording. Each is aligned with the ground truth;
    without ground truth, with the first estimate.

    Examples:
      dronevio log V1_01_easy estimate.tum
      dronevio log V1_01_easy vins.tum openvins.tum --names VINS-Fusion,OpenVINS -o v101.rrd
      dronevio log flight.mcap estimate.tum --truth mocap.tum --alignment se3
      dronevio log recordings/room-v0-0 runs/room-v0-0/estimate.tum --cameras 0 --json
    """

    recording: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RECORDING")]
    """Recording: the folder of a data set, or a bag of ROS 1 or ROS 2."""
    estimates: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="ESTIMATE")]
    """Estimated trajectories: TUM files, EuRoC CSV files or bags."""
    out: Annotated[Path, tyro.conf.arg(aliases=("-o",))] = Path("comparison.rrd")
    """File to write."""
    names: str = ""
    """Names of the estimates, joined by commas; the names of their files by default."""
    truth: Path | None = None
    """Ground truth that replaces the one of the recording: TUM file, EuRoC CSV file, recording."""
    alignment: Literal["yaw", "se3", "sim3", "first", "none"] = "yaw"
    """Alignment of the estimates before they are shown and evaluated: yaw and position (yaw), rotation and position
    (se3), also the scale (sim3), equal first poses (first), or none."""
    crf: Annotated[int, Range(0, 63)] = 42
    """Constant rate factor of the video, from 0 (best quality, largest file) to 63."""
    reading: RecordingInput = field(default_factory=RecordingOptions)
    """How the recording is read."""
    output: Output = field(default_factory=OutputOptions)
    """How the result is written and printed."""


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    command = parse(LogCommand, arguments, "log")
    names = names_of(command.estimates, command.names)
    _check(command)

    import numpy as np

    from dronevio.cli.output_files import atomic_file
    from dronevio.eval.rerun.compare import align_estimates
    from dronevio.eval.rerun.files import write_estimates
    from dronevio.eval.rerun.surroundings import NO_SURROUNDINGS
    from dronevio.eval.rerun.video import VideoSettings
    from dronevio.models.recordings.open import read_trajectory
    from dronevio.models.recordings.scenery_file import read_scenery
    from dronevio.models.recordings.segments import most_common, segments_of
    from dronevio.recording.surroundings import surroundings_in

    recording = command.reading.open(command.recording, repair=True)
    trajectories = [read_trajectory(path) for path in command.estimates]
    segments = segments_of(recording)
    if len(segments) > 1:
        poses_ns = np.concatenate([each.t_ns for each in trajectories])
        recording = segments[most_common([each.frame_times_ns for each in segments], poses_ns)]
        print_warning(f"the clock steps; the file shows {recording.name}, which has the most of the poses")
    print_defects(recording.defects)
    truth = recording.ground_truth if command.truth is None else read_trajectory(command.truth)
    estimates = align_estimates(names, trajectories, truth, recording.frame_times_ns, command.alignment)
    in_same_frame = truth is not None and command.truth is None  # that of the simulated world
    surroundings = surroundings_in(read_scenery(command.recording)) if in_same_frame else NO_SURROUNDINGS
    with progress_bars(quiet=command.output.json) as bars, atomic_file(command.out) as unfinished:
        video = VideoSettings(crf=command.crf)
        write_estimates(
            unfinished,
            recording,
            truth,
            estimates,
            surroundings=surroundings,
            progress=bars.bar("logging"),
            video=video,
        )
    _print_result(command, estimates)
    return 0


def names_of(estimates: Sequence[Path], given: str = "") -> list[str]:
    """Return the names of estimates: the given ones, or those of the files, with their folders if necessary.

    Args:
        estimates: Files of the estimates.
        given: Names joined by commas; empty for the names of the files.

    Raises:
        ConfigError: There is no estimate, the number of names differs, or two names are equal.
    """
    if not estimates:
        raise ConfigError("no estimate; expected one file or more")
    if given:
        names = [name.strip() for name in given.split(",")]
        if len(names) != len(estimates) or len(set(names)) < len(names) or not all(names):
            raise ConfigError(f"--names {given!r} for {len(estimates)} estimates; expected a different name for each")
        return names
    for names in (
        [path.stem for path in estimates],
        [f"{path.absolute().parent.name}/{path.stem}" for path in estimates],
    ):
        if len(set(names)) == len(names):
            return names
    raise ConfigError("estimates whose files have equal names; expected --names")


def _check(command: LogCommand) -> None:
    """Check the output file and the options before any work is done.

    Raises:
        InputError: The output file exists or cannot be made.
        ConfigError: An option has an invalid value.
    """
    from dronevio.cli.output_files import require_free
    from dronevio.models.recordings.files import check_output_path

    check_output_path(command.out)
    if command.out.suffix != ".rrd":
        raise InputError(command.out, f"a name that ends with {command.out.suffix!r}", "one that ends with .rrd")
    require_free(command.out, command.output.overwrite)


def _print_result(command: LogCommand, estimates: "Sequence[NamedEstimate]") -> None:
    """Print the file that was written, and the errors of each estimate."""
    from dronevio.cli.output_files import size_mb

    rows = [
        {
            "name": estimate.name,
            "estimate": str(path),
            "poses": len(estimate.trajectory),
            "ate_m": None if estimate.scored is None else estimate.scored.scores.ate_m.rmse,
            "ate_deg": None if estimate.scored is None else estimate.scored.scores.ate_deg.rmse,
        }
        for path, estimate in zip(command.estimates, estimates, strict=True)
    ]
    size = size_mb(command.out)
    if command.output.json:
        print_json({"recording": str(command.recording), "out": str(command.out), "size_mb": size, "estimates": rows})
        return
    print_table(
        f"Estimates of {command.recording}",
        ("", "poses", "ATE", "ATE, orientation"),
        [
            (
                str(row["name"]),
                f"{row['poses']}",
                "–" if row["ate_m"] is None else f"{row['ate_m']:.3f} m",
                "–" if row["ate_deg"] is None else f"{row['ate_deg']:.2f} °",
            )
            for row in rows
        ],
    )
    print(f"wrote {command.out} ({size:.1f} MB)")
    print(f"open it:  {command_line('view', command.out)}")
