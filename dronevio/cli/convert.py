"""``dronevio convert``: recordings and their calibration, for other programs and from them."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from dronevio.cli.terminal import Bars, parse, print_json, print_table, progress_bars
from dronevio.models.recordings.bag.options import BagTopics

if TYPE_CHECKING:
    from dronevio.models.recordings.open import StoredRecording

Form = Literal[
    "euroc", "mcap", "bag", "bag-sqlite", "tum", "kalibr", "openvins", "vins", "orbslam3", "basalt", "kimera"
]
_BY_SUFFIX: dict[str, Form] = {".mcap": "mcap", ".tum": "tum"}


@dataclass(frozen=True)
class ConvertCommand:
    """Convert a recording, or write its calibration for another program.

    Recordings: euroc (a folder), mcap (one file), bag (a ROS 2 folder with MCAP inside) and bag-sqlite (with SQLite,
    for ROS 2 Humble and older). What is read back is the same to the bit: times, images, IMU, calibration, truth. Of
    the truth alone: tum.

    Calibration and settings of other programs, from the true parameters: kalibr, openvins and vins (VINS-Fusion), which
    run on a bag, and orbslam3, basalt and kimera, which run on an EuRoC folder.

    Examples:
      dronevio convert recordings/room-0 room-0.mcap
      dronevio convert recordings/room-0 room-0 --to bag --images png
      dronevio convert flight.mcap recordings/flight --to euroc --calibration camchain.yaml imu.yaml
      dronevio convert recordings/room-0 config/room-0 --to openvins
      dronevio convert recordings/room-0 truth.tum
    """

    source: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SOURCE")]
    """EuRoC folder, or ROS 2 bag: an .mcap or .db3 file, or a folder."""
    dest: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DEST")]
    """File or folder to make."""
    to: Form | None = None
    """What to make; mcap and tum go without saying where DEST ends so."""
    images: Literal["raw", "png"] = "raw"
    """In a bag: pixel by pixel, which every node reads, or as PNG, which takes less room."""
    cameras: int | None = None
    """Keep only the first so many cameras."""
    calibration: tuple[Path, ...] = ()
    """Kalibr's camchain.yaml, imu.yaml or both, in place of what a bag says."""
    topics: BagTopics = field(default_factory=BagTopics)
    """Topics of a bag, where they cannot be found by type."""
    overwrite: bool = False
    """Replace an earlier result, once the new one is complete."""
    json: bool = False
    """Print one JSON document instead of a table."""


def main(arguments: Sequence[str]) -> int:
    """Run the command."""
    command = parse(ConvertCommand, arguments, "convert")

    from dronevio.cli.folders import size_mb
    from dronevio.models.errors import ConfigError
    from dronevio.models.recordings.open import open_recording

    form = command.to or _BY_SUFFIX.get(command.dest.suffix)
    if form is None:
        raise ConfigError(f"{command.dest}: no telling what to make of it; expected --to, or a name with .mcap or .tum")
    if (command.dest.suffix == ".mcap") != (form == "mcap"):
        raise ConfigError(f"{command.dest} as {form}; expected a name with .mcap for mcap, and for nothing else")
    if command.cameras is not None and command.cameras < 1:
        raise ConfigError(f"--cameras {command.cameras}; expected 1 or more")
    _refuse_existing(command.dest, command.overwrite)
    recording = open_recording(command.source, command.cameras, command.calibration, command.topics)
    with progress_bars(quiet=command.json) as bars:
        _convert(recording, form, command, bars)
    truth = recording.ground_truth
    size = command.dest.stat().st_size * 1e-6 if command.dest.is_file() else size_mb(command.dest)
    summary = {
        "source": str(command.source),
        "dest": str(command.dest),
        "to": form,
        "complete": recording.complete,
        "cameras": len(recording.rig.cameras),
        "frames": len(recording.frame_times_ns),
        "imu_samples": len(recording.imu),
        "poses": len(truth) if truth is not None else 0,
        "size_mb": size,
    }
    if command.json:
        print_json(summary)
        return 0
    print_table(
        f"{recording.name} as {form}",
        ("", "value", "unit"),
        (
            ("cameras", f"{summary['cameras']}", ""),
            ("frames", f"{summary['frames']}", ""),
            ("IMU samples", f"{summary['imu_samples']}", ""),
            ("true poses", f"{summary['poses']}", ""),
            ("size", f"{size:.1f}" if size >= 0.1 else f"{size * 1e3:.1f}", "MB" if size >= 0.1 else "kB"),
        ),
    )
    if not recording.complete:
        print(f"{command.source} is incomplete: it was cut off; what there was of it is converted")
    print(f"wrote {command.dest}")
    return 0


def _convert(recording: "StoredRecording", form: Form, command: ConvertCommand, bars: Bars) -> None:
    """Write a recording in a form; all of it or nothing."""
    from dronevio.cli.folders import atomic_folder
    from dronevio.models.errors import InputError
    from dronevio.models.recordings.calibration.exports import CONFIGURATIONS
    from dronevio.models.recordings.euroc import write_euroc_recording
    from dronevio.models.recordings.files import write_text
    from dronevio.models.recordings.tum import write_tum

    if form == "euroc":
        with atomic_folder(command.dest, command.overwrite) as folder:
            write_euroc_recording(folder, recording, bars.bar("converting"), recording.frame_truth)
    elif form == "tum":
        if recording.ground_truth is None:
            raise InputError(command.source, "no true motion in it", "a recording with its truth")
        write_tum(command.dest, recording.ground_truth)
    elif form in ("mcap", "bag", "bag-sqlite"):
        from dronevio.models.recordings.bag.writer import write_bag

        storage: Literal["mcap", "sqlite3"] = "sqlite3" if form == "bag-sqlite" else "mcap"
        progress, told = bars.bar("converting"), recording.frame_truth
        write_bag(command.dest, recording, storage, command.images, progress, told, command.overwrite)
    else:
        files = CONFIGURATIONS[form](recording.rig, recording.frame_times_ns)
        with atomic_folder(command.dest, command.overwrite, mark=next(iter(files))) as folder:
            for name, text in files.items():
                write_text(folder / name, text)


def _refuse_existing(dest: Path, overwrite: bool) -> None:
    """Raise InputError if something is in the way: rather now than when the source has been read."""
    from dronevio.models.errors import InputError

    if dest.exists() and not overwrite and not (dest.is_dir() and not any(dest.iterdir())):
        raise InputError(dest, "it exists already", "a new name, or --overwrite")
