"""Recordings of whatever kind: EuRoC folders and ROS 2 bags, told apart by what they are."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from dronevio.models.errors import ConfigError, InputError
from dronevio.models.imu import Times
from dronevio.models.recordings import tum
from dronevio.models.recordings.bag.options import BagTopics
from dronevio.models.recordings.calibration.euroc import count_cameras, read_rig
from dronevio.models.recordings.calibration.kalibr import CAMCHAIN_FILE, read_kalibr
from dronevio.models.recordings.euroc import EurocRecording, find_mav0, read_frame_times
from dronevio.models.rig import Rig
from dronevio.models.state import Trajectory

if TYPE_CHECKING:
    from dronevio.models.recordings.bag.recording import BagRecording

StoredRecording: TypeAlias = "EurocRecording | BagRecording"
"""What `open_recording` returns: a `Recording` that also knows its ``frame_truth`` and whether it is ``complete``."""

_STORAGES = (".mcap", ".db3")


def open_recording(
    path: Path | str,
    cameras: int | None = None,
    calibration: Sequence[Path] = (),
    topics: BagTopics | None = None,
) -> StoredRecording:
    """Open a recording, whatever its kind; images are read one at a time, when they are asked for.

    Args:
        path: An EuRoC folder (the one that holds ``mav0``, or ``mav0`` itself), an ``.mcap`` or ``.db3`` file, or a
            folder as ``ros2 bag`` makes it.
        cameras: Use only the first so many cameras; None for all.
        calibration: Kalibr's files, for a bag that does not say all of its rig.
        topics: Which topics of a bag to read, where they cannot be found by type.

    Raises:
        InputError: It is none of these, damaged or not supported.
        ConfigError: Calibration or topics for an EuRoC folder, which has its own.
    """
    path = Path(path)
    if is_bag(path):
        from dronevio.models.recordings.bag.recording import BagRecording  # half a second, for those who read bags only

        return BagRecording.open(path, cameras, calibration, topics)
    if calibration or (topics is not None and topics != BagTopics()):
        raise ConfigError(f"{path}: calibration and topics are for bags; expected an EuRoC folder without them")
    if path.suffix == ".bag":
        raise InputError(path, "a bag of ROS 1", "one of ROS 2; rosbags-convert --src OLD.bag --dst NEW makes it one")
    if not path.exists():
        raise InputError(path, "no such file or folder", "an EuRoC folder, an .mcap file or a ROS 2 bag")
    return EurocRecording.open(path, cameras)


def is_bag(path: Path) -> bool:
    """Say whether a path looks like a ROS 2 bag."""
    if path.is_dir():
        if (path / "mav0").is_dir():
            return False
        return (path / "metadata.yaml").exists() or any(inside.suffix in _STORAGES for inside in path.iterdir())
    return path.suffix in _STORAGES


def rig_of_file(path: Path) -> Rig:
    """Return the rig that a file or folder describes: a recording, or Kalibr's files (`kalibr.read_kalibr`).

    Raises:
        InputError: It describes none, or is damaged.
    """
    path = Path(path)
    if is_bag(path):
        return open_recording(path).rig
    if path.is_dir() and not (path / CAMCHAIN_FILE).exists():
        mav0 = find_mav0(path)
        return read_rig(mav0, count_cameras(mav0))
    return read_kalibr(path)


def read_trajectory(path: Path) -> Trajectory:
    """Read a trajectory: a TUM file, a ground-truth CSV of EuRoC, or the truth of a recording of any kind.

    Raises:
        InputError: It is none of these, damaged, or a bag without truth.
    """
    path = Path(path)
    if not is_bag(path):
        return tum.read_trajectory(path)
    from dronevio.models.recordings.bag.recording import read_truth

    return read_truth(path)


def frame_times_ns(path: Path) -> Times | None:
    """Return the time stamps (M,) [ns] of the frames of a recording, None where a path is none with images.

    Raises:
        InputError: It is a damaged one.
    """
    path = Path(path)
    if is_bag(path):
        from dronevio.models.recordings.bag.recording import read_bag_frame_times

        return read_bag_frame_times(path)
    if not path.is_dir() or not (find_mav0(path) / "cam0").is_dir():
        return None
    return read_frame_times(path)
