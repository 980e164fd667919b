"""``dronevio convert``: recordings and calibrations in the formats of other programs."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from dronevio.cli.options import Output, OutputOptions, RecordingInput, RecordingOptions
from dronevio.cli.progress import Bars
from dronevio.cli.terminal import parse, print_json, print_values, progress_bars

if TYPE_CHECKING:
    from dronevio.models.recordings.open import StoredRecording

Format = Literal[
    "euroc", "mcap", "bag", "bag-sqlite", "tum", "kalibr", "openvins", "vins", "orbslam3", "basalt", "kimera"
]
_RECORDINGS: tuple[Format, ...] = ("euroc", "mcap", "bag", "bag-sqlite")
_BY_SUFFIX: dict[str, Format] = {".mcap": "mcap", ".tum": "tum"}


@dataclass(frozen=True)
class ConvertCommand:
    """Convert a recording, or write its calibration for another program.

    Recordings: euroc (a folder), mcap (one file), bag (a ROS 2 folder with MCAP inside) and bag-sqlite (with SQLite,
    for ROS 2 Humble and older). The conversion is lossless: images, IMU samples, calibration, ground truth and, with
    --stamps recorded, the time stamps of simulated flights are bit-identical when they are read back. Ground truth
    alone: tum. A bag for ROS 1: rosbags-convert --src ROOM --dst ROOM.bag, where ROOM is the folder of --to bag.

    Calibration and settings for other programs, from the true parameters: kalibr, openvins and vins (VINS-Fusion),
    which run on a bag, and orbslam3, basalt and kimera, which run on an EuRoC folder.

    Examples:
      dronevio convert recordings/room-v0-0 room-0.mcap
      dronevio convert recordings/room-v0-0 room-0 --to bag --images raw
      dronevio convert recordings/room-v0-0 for-basalt/room-0 --to euroc --imu-sampling increment
      dronevio convert flight.mcap recordings/flight --to euroc --calibration camchain.yaml imu.yaml
      dronevio convert recordings/room-v0-0 config/room-0 --to openvins
      dronevio convert recordings/room-v0-0 truth.tum
      dronevio convert MH_01_easy.bag recordings/MH_01_easy --to euroc --calibration camchain.yaml imu.yaml
    """

    source: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SOURCE")]
    """Folder of EuRoC, TUM-VI, DSO or KITTI, or bag of ROS 1 or ROS 2."""
    dest: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DEST")]
    """File or folder to make."""
    to: Format | None = None
    """Format of the result; not necessary if DEST ends with .mcap or .tum."""
    images: Literal["png", "raw"] = "png"
    """Encoding of the images in a bag: PNG, on topics whose names end with compressed, or raw pixels, which take twice
    the space and which nodes read that do not subscribe to compressed images."""
    imu_sampling: Literal["recorded", "increment"] = "recorded"
    """IMU samples in bags and EuRoC folders: as recorded, or increment, the means over the intervals between them.
    Means are for programs that hold a sample over the interval before its time stamp, such as Basalt."""
    stamps: Literal["epoch", "recorded"] = "epoch"
    """Time stamps in bags and EuRoC folders: epoch lets the stamps of a simulated flight, which count from its start,
    begin at 1.6e9 s (13 September 2020), since zero means unset in ROS; other stamps are kept."""
    reading: RecordingInput = field(default_factory=RecordingOptions)
    """How the recording is read."""
    output: Output = field(default_factory=OutputOptions)
    """How the result is written and printed."""


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    command = parse(ConvertCommand, arguments, "convert")

    from dronevio.cli.output_files import require_free, size_mb
    from dronevio.models.errors import ConfigError, InputError
    from dronevio.models.recordings.files import writing

    target = command.to or _BY_SUFFIX.get(command.dest.suffix)
    if target is None:
        raise ConfigError(f"{command.dest}: unknown format; expected --to, or a name that ends with .mcap or .tum")
    if (command.dest.suffix == ".mcap") != (target == "mcap"):
        raise ConfigError(f"{command.dest} as {target}; expected a name that ends with .mcap for mcap only")
    require_free(command.dest, command.output.overwrite)  # before the source is read
    recording = command.reading.open(command.source)
    if target != "tum" and not len(recording.imu):
        raise InputError(command.source, "no IMU", "a recording with an IMU, or its truth alone (--to tum)")
    with progress_bars(quiet=command.output.json) as bars, writing(command.dest):
        _convert(recording, target, command, bars)
    truth, size, is_recording = recording.ground_truth, size_mb(command.dest), target in _RECORDINGS
    summary = {
        "source": str(command.source),
        "dest": str(command.dest),
        "to": target,
        "complete": recording.complete,
        "cameras": 0 if target == "tum" else len(recording.rig.cameras),
        "frames": len(recording.frame_times_ns) if is_recording else 0,
        "imu_samples": len(recording.imu) if is_recording else 0,
        "poses": len(truth) if truth is not None and (is_recording or target == "tum") else 0,
        "size_mb": size,
    }
    if command.output.json:
        print_json(summary)
        return 0
    counts = {"cameras": "cameras", "frames": "frames", "IMU samples": "imu_samples", "true poses": "poses"}
    print_values(
        f"{recording.name} as {target}",
        (
            *((label, f"{summary[key]}", "") for label, key in counts.items() if summary[key]),
            ("size", f"{size:.1f}" if size >= 0.1 else f"{size * 1e3:.1f}", "MB" if size >= 0.1 else "kB"),
        ),
    )
    if not recording.complete:
        print(f"{command.source} is incomplete: its recording was interrupted; what exists was converted")
    print(f"wrote {command.dest}")
    return 0


def _convert(recording: "StoredRecording", target: Format, command: ConvertCommand, bars: Bars) -> None:
    """Write a recording, or its calibration, in a format. The result is complete or does not exist."""
    from dronevio.cli.output_files import atomic_folder
    from dronevio.models.errors import InputError
    from dronevio.models.recordings.calibration.exports import CONFIGURATIONS
    from dronevio.models.recordings.euroc import write_euroc_recording
    from dronevio.models.recordings.exported import exported
    from dronevio.models.recordings.files import write_text
    from dronevio.models.recordings.tum import write_tum

    overwrite = command.output.overwrite
    sampling: Literal["increment"] | None = "increment" if command.imu_sampling == "increment" else None
    export = exported(recording, recording.frame_truth, sampling, from_epoch=command.stamps == "epoch")
    if target == "euroc":
        with atomic_folder(command.dest, overwrite) as folder:
            write_euroc_recording(folder, export, bars.bar("converting"), export.frame_truth)
    elif target == "tum":
        if recording.ground_truth is None:
            raise InputError(command.source, "no ground truth", "a recording with ground truth")
        write_tum(command.dest, recording.ground_truth)
    elif target in _RECORDINGS:
        from dronevio.models.recordings.bag.writer import write_bag

        storage: Literal["mcap", "sqlite3"] = "sqlite3" if target == "bag-sqlite" else "mcap"
        progress = bars.bar("converting")
        write_bag(command.dest, export, storage, command.images, progress, export.frame_truth, overwrite)
    else:
        files = CONFIGURATIONS[target](recording.rig, recording.frame_times_ns, recording.imu)
        with atomic_folder(command.dest, overwrite, mark=next(iter(files))) as folder:
            for name, text in files.items():
                write_text(folder / name, text)
