"""Opening of recordings and trajectories of any supported format, which is detected from the path."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from dronevio.models.errors import ConfigError, InputError
from dronevio.models.imu import ImuModel, Times
from dronevio.models.recordings import tum
from dronevio.models.recordings.bag.options import BagTopics
from dronevio.models.recordings.calibration.euroc import count_cameras, read_euroc_rig
from dronevio.models.recordings.calibration.kalibr import CAMCHAIN_FILE, read_kalibr
from dronevio.models.recordings.euroc import EurocRecording, find_mav0, read_euroc_segment_times
from dronevio.models.recordings.segments import most_common
from dronevio.models.rig import Rig
from dronevio.models.state import Trajectory

if TYPE_CHECKING:
    from dronevio.models.recordings.bag.recording import BagRecording

StoredRecording: TypeAlias = "EurocRecording | BagRecording"
"""Types that `open_recording` returns: a `Recording` with ``frame_truth``, ``complete``, ``defects`` and ``later``."""

_STORAGES = (".mcap", ".db3")


def open_recording(
    path: Path | str,
    cameras: int | None = None,
    calibration: Sequence[Path] = (),
    topics: BagTopics | None = None,
    repair: bool = False,
    imu: ImuModel | None = None,
) -> StoredRecording:
    """Open a recording. Images are read one frame at a time, on request.

    Args:
        path: An EuRoC folder (``mav0`` or its parent), an ``.mcap`` or ``.db3`` file, or a folder written by
            ``ros2 bag``.
        cameras: Number of cameras to use, in the order of the calibration; None for all.
        calibration: Calibration files of Kalibr, for a bag without a complete calibration.
        topics: Topics of a bag to read, if they cannot be found by type.
        repair: Whether to go on with defects such as damaged images, and to list them in ``defects`` of the recording
            and of its frames. Otherwise, they raise an error, and frames that not every camera has are left out.
            Where the clock steps, the recording is the first segment, and ``later`` has the other ones.
        imu: Model of the IMU in place of that of the recording, for example where its noise is unknown. The rate stays
            that of the recording.

    Raises:
        InputError: The path is none of these, damaged or not supported.
        ConfigError: The number of cameras is less than 1, or calibration or topics are given for an EuRoC folder, which
            contains its own.
    """
    path = Path(path)
    if is_bag(path):
        from dronevio.models.recordings.bag.recording import BagRecording  # takes half a second

        return BagRecording.open(path, cameras, calibration, topics, repair=repair, imu=imu)
    if calibration or (topics is not None and topics != BagTopics()):
        raise ConfigError(f"{path}: calibration and topics are for bags; expected an EuRoC folder without them")
    if path.suffix == ".bag":
        raise InputError(
            path, "a bag of ROS 1", "one of ROS 2; convert it with rosbags-convert --src OLD.bag --dst NEW"
        )
    if not path.exists():
        raise InputError(path, "no such file or folder", "an EuRoC folder, an .mcap file or a ROS 2 bag")
    recording = EurocRecording.open(path, cameras, repair)
    if imu is None:
        return recording
    rig = replace(recording.rig, imu=replace(imu, rate_hz=recording.rig.imu.rate_hz))
    return replace(recording, rig=rig, later=tuple(replace(segment, rig=rig) for segment in recording.later))


def is_bag(path: Path) -> bool:
    """Return whether a path has the name or the contents of a ROS 2 bag."""
    if path.is_dir():
        if (path / "mav0").is_dir():
            return False
        return (path / "metadata.yaml").exists() or any(file.suffix in _STORAGES for file in path.iterdir())
    return path.suffix in _STORAGES


def read_rig(path: Path) -> Rig:
    """Return the rig of a recording or of Kalibr's files (`kalibr.read_kalibr`).

    Raises:
        InputError: The path has no calibration, or is damaged.
    """
    path = Path(path)
    if is_bag(path):
        return open_recording(path).rig
    if path.is_dir() and not (path / CAMCHAIN_FILE).exists():
        mav0 = find_mav0(path)
        return read_euroc_rig(mav0, count_cameras(mav0))
    return read_kalibr(path)


def read_trajectory(path: Path, poses_ns: Times | None = None) -> Trajectory:
    """Read a trajectory: a TUM or KITTI file, a ground-truth CSV file of EuRoC, or the ground truth of a recording.

    Args:
        path: The file or folder.
        poses_ns: Time stamps of poses; where the clock of a bag steps, the ground truth is the part with the most of
            these, or the first one [ns].

    Raises:
        InputError: The path is none of these, damaged, or a recording without ground truth.
    """
    path = Path(path)
    if not is_bag(path):
        return tum.read_trajectory(path)
    from dronevio.models.recordings.bag.recording import read_truth

    return read_truth(path, poses_ns)


def read_frame_times(path: Path, poses_ns: Times | None = None) -> Times | None:
    """Return the time stamps (M,) [ns] of the frames of a recording, None if the path is not a recording with images.

    Args:
        path: The recording.
        poses_ns: Time stamps of poses; where the clock of the recording steps, the frames are those of the segment with
            the most of these, or of the first segment [ns].

    Raises:
        InputError: The recording is damaged.
    """
    path = Path(path)
    if is_bag(path):
        from dronevio.models.recordings.bag.recording import read_bag_frame_times

        segments = read_bag_frame_times(path)
    elif not path.is_dir() or not (find_mav0(path) / "cam0").is_dir():
        return None
    else:
        segments = read_euroc_segment_times(path)
    return segments[0 if poses_ns is None else most_common(segments, poses_ns)] if segments else None
