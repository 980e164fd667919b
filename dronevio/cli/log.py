"""``dronevio log``: one's own or other people's results over a recording, to look at."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from dronevio.cli.terminal import parse, print_json, print_table, progress_bars
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.recordings.bag.options import BagTopics

if TYPE_CHECKING:
    from dronevio.eval.rerun.compare import NamedEstimate


@dataclass(frozen=True)
class LogCommand:
    """Lay estimated trajectories over a recording, as a file to walk around in: `dronevio view` opens it.

    It shows the paths beside the true one, the errors over time and the scores of all estimates together, every frame
    of every camera, and the IMU. The estimates may come from any program: TUM files or EuRoC CSVs, poses of the IMU,
    stamped like the recording. Each is laid on the truth; where there is none, on the first of them.

    Examples:
      dronevio log V1_01_easy estimate.tum
      dronevio log V1_01_easy vins.tum openvins.tum --names VINS-Fusion,OpenVINS -o v101.rrd
      dronevio log flight.mcap estimate.tum --truth mocap.tum --alignment se3
      dronevio log recordings/room-0 runs/*/estimate.tum --cameras 1 --json
    """

    recording: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RECORDING")]
    """EuRoC folder, or ROS 2 bag."""
    estimates: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="ESTIMATE")]
    """Estimated motions: TUM files, EuRoC CSVs or bags."""
    out: Annotated[Path, tyro.conf.arg(aliases=("-o",))] = Path("comparison.rrd")
    """File to write."""
    names: str = ""
    """What the estimates are called, with commas between them; like their files by default."""
    truth: Path | None = None
    """The true motion, if not the recording's own: TUM file, EuRoC CSV or folder, or bag."""
    alignment: Literal["yaw", "se3", "sim3", "first", "none"] = "yaw"
    """What is taken out before estimates are shown and scored: yaw and position, the whole pose (se3), also the scale
    (sim3), the first pose, or nothing."""
    cameras: int | None = None
    """Show only the first so many cameras."""
    crf: int = 42
    """Quality of the video, from 0 (best, largest) to 63."""
    calibration: tuple[Path, ...] = ()
    """Kalibr's camchain.yaml, imu.yaml or both, in place of what a bag says."""
    topics: BagTopics = field(default_factory=BagTopics)
    """Topics of a bag, where they cannot be found by type."""
    overwrite: bool = False
    """Replace an earlier file, once the new one is complete."""
    json: bool = False
    """Print one JSON document instead of a table."""


def main(arguments: Sequence[str]) -> int:
    """Run the command."""
    command = parse(LogCommand, arguments, "log")
    names = names_of(command.estimates, command.names)
    _check_place(command)

    from dronevio.eval.rerun.compare import laid_together
    from dronevio.eval.rerun.log import write_estimates
    from dronevio.eval.rerun.video import VideoSettings
    from dronevio.models.recordings.open import open_recording, read_trajectory

    recording = open_recording(command.recording, command.cameras, command.calibration, command.topics)
    truth = recording.ground_truth if command.truth is None else read_trajectory(command.truth)
    trajectories = [read_trajectory(path) for path in command.estimates]
    estimates = laid_together(names, trajectories, truth, recording.frame_times_ns, command.alignment)
    with progress_bars(quiet=command.json) as bars, whole_file(command.out) as unfinished:
        video = VideoSettings(crf=command.crf)
        write_estimates(unfinished, recording, truth, estimates, progress=bars.bar("logging"), video=video)
    _report(command, estimates)
    return 0


def names_of(estimates: Sequence[Path], wanted: str = "") -> list[str]:
    """Return what estimates are called: as wanted, else like their files, else like their folders as well.

    Raises:
        ConfigError: There are not as many names as estimates, two are alike, or there is nothing to name.
    """
    if not estimates:
        raise ConfigError("no estimate; expected one file at least")
    if wanted:
        names = [name.strip() for name in wanted.split(",")]
        if len(names) != len(estimates) or len(set(names)) < len(names) or not all(names):
            raise ConfigError(f"--names {wanted!r} for {len(estimates)} estimates; expected a name of its own for each")
        return names
    for names in (
        [path.stem for path in estimates],
        [f"{path.absolute().parent.name}/{path.stem}" for path in estimates],
    ):
        if len(set(names)) == len(names):
            return names
    raise ConfigError("estimates whose files are called the same; expected --names")


@contextmanager
def whole_file(target: Path) -> Iterator[Path]:
    """Give a name beside ``target``, with ``.incomplete`` in it, to write to, which becomes ``target`` in the end.

    When the program is killed meanwhile, what was written lies there.
    """
    unfinished = target.with_name(f"{target.stem}.incomplete{target.suffix}")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        yield unfinished
        unfinished.replace(target)
    finally:
        unfinished.unlink(missing_ok=True)


def _check_place(command: LogCommand) -> None:
    """Raise InputError if something is in the way: rather now than when the work is done."""
    from dronevio.models.recordings.files import check_place

    check_place(command.out)
    if command.out.suffix != ".rrd":
        raise InputError(command.out, f"a name that ends with {command.out.suffix!r}", "one that ends with .rrd")
    if command.out.exists() and not command.overwrite:
        raise InputError(command.out, "it exists already", "a new name, or --overwrite")
    if not 0 <= command.crf <= 63:
        raise ConfigError(f"--crf {command.crf}; expected 0 to 63")
    if command.cameras is not None and command.cameras < 1:
        raise ConfigError(f"--cameras {command.cameras}; expected 1 or more")


def _report(command: LogCommand, estimates: "Sequence[NamedEstimate]") -> None:
    """Say what was written, and how good each estimate is."""
    size_mb = command.out.stat().st_size * 1e-6
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
    if command.json:
        print_json(
            {"recording": str(command.recording), "out": str(command.out), "size_mb": size_mb, "estimates": rows}
        )
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
    print(f"wrote {command.out} ({size_mb:.1f} MB)")
    print(f"look:  dronevio view {command.out}")
