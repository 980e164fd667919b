"""Opening of recordings and trajectories of any supported format, which is detected from the path."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from dronevio.models.errors import ConfigError, InputError
from dronevio.models.imu import ImuModel, Times
from dronevio.models.recordings import dso_folder, kitti_folder
from dronevio.models.recordings.bag.options import STORAGES, BagTopics
from dronevio.models.recordings.calibration.euroc import count_cameras, read_euroc_rig
from dronevio.models.recordings.calibration.kalibr import CAMCHAIN_FILE
from dronevio.models.recordings.calibration.reading import read_calibrated_rig
from dronevio.models.recordings.euroc import EurocRecording, find_mav0, read_euroc_segment_times
from dronevio.models.recordings.segments import most_common
from dronevio.models.recordings.trajectory_file import read_trajectory_file
from dronevio.models.rig import Cameras, Rig
from dronevio.models.state import Trajectory

if TYPE_CHECKING:
    from dronevio.models.recordings.bag.recording import BagRecording
    from dronevio.models.recordings.gopro import VideoRecording

VIDEO_SUFFIXES = (".mp4", ".mov", ".360")
"""Suffixes of videos that may have telemetry, in lower case."""

StoredRecording: TypeAlias = "EurocRecording | BagRecording | VideoRecording"
"""Types that `open_recording` returns: a `Recording` with ``frame_truth``, ``complete``, ``defects`` and ``later``."""


def open_recording(
    path: Path | str,
    cameras: Cameras = None,
    calibration: Sequence[Path] = (),
    topics: BagTopics | None = None,
    repair: bool = False,
    imu: ImuModel | None = None,
    imu_rotation: str | None = None,
) -> StoredRecording:
    """Open a recording. Images are read one frame at a time, on request.

    Args:
        path: An EuRoC folder (``mav0`` or its parent), a ``.bag``, ``.mcap`` or ``.db3`` file, a folder written by
            ``ros2 bag``, a folder of DSO with an IMU, a drive or sequence of KITTI, or a video with the telemetry of a
            GoPro camera.
        cameras: Cameras to use, by their index in the calibration or their name: ``cam0``, ``cam1``. The first one
            is the main camera. Also their largest number, from the first on; None for all.
        calibration: Calibration files of Kalibr or Basalt that replace or complete the calibration of the recording.
        topics: Topics of a bag to read, if they cannot be found by type.
        repair: Whether to go on with defects such as damaged images, and to list them in ``defects`` of the recording
            and of its frames. Otherwise, they raise an error, and frames that not every camera has are left out.
            Where the clock steps, the recording is the first segment, and ``later`` has the other ones.
        imu: Model of the IMU in place of that of the recording, for example where its noise is unknown. The rate stays
            that of the recording.
        imu_rotation: Axes of the IMU of a video along those of the camera, such as ``yxz``; see
            `dronevio.models.recordings.gopro.imu_rotation_named`.

    Raises:
        InputError: The path is none of these, damaged or not supported.
        ConfigError: A camera does not exist, or topics are given for a recording that is not a bag.
    """
    path = Path(path)
    if path.suffix.lower() in VIDEO_SUFFIXES and not path.is_dir():
        from dronevio.models.recordings.gopro import VideoRecording

        _check_no_topics(path, topics)
        return VideoRecording.open(path, cameras, calibration, imu, imu_rotation, repair)
    if imu_rotation is not None:
        raise ConfigError(
            f"{path}: a rotation of the IMU is for videos; expected a calibration with the poses of cameras"
        )
    if is_bag(path):
        from dronevio.models.recordings.bag.recording import BagRecording  # takes half a second

        return BagRecording.open(path, cameras, calibration, topics, repair=repair, imu=imu)
    _check_no_topics(path, topics)
    if not path.exists():
        raise InputError(
            path, "no such file or folder", "a folder of EuRoC, TUM-VI or KITTI, a bag of ROS, or a video of a GoPro"
        )
    if kitti_folder.is_kitti_folder(path):
        contents = kitti_folder.read_kitti_contents(path, cameras, calibration, imu, for_odometry=repair)
        return EurocRecording.of(contents, repair)
    if dso_folder.is_dso_folder(path):
        return EurocRecording.of(dso_folder.read_dso_contents(path, cameras, calibration, imu), repair)
    return EurocRecording.open(path, cameras, repair, calibration, imu)


def _check_no_topics(path: Path, topics: BagTopics | None) -> None:
    """Raise ConfigError if topics are given for a recording that is not a bag."""
    if topics is not None and topics != BagTopics():
        raise ConfigError(f"{path}: topics are for bags; expected a recording of another format without them")


def is_recording_folder(path: Path) -> bool:
    """Return whether a path is a folder of EuRoC, TUM-VI, DSO or KITTI with images and their times."""
    is_euroc = (path / "mav0").is_dir() or (path / "cam0" / "data.csv").is_file()
    return is_euroc or dso_folder.is_dso_folder(path) or kitti_folder.is_kitti_folder(path)


def is_bag(path: Path) -> bool:
    """Return whether a path has the name or the contents of a bag."""
    if path.is_dir():
        if (path / "mav0").is_dir():
            return False
        return (path / "metadata.yaml").exists() or any(file.suffix in STORAGES for file in path.iterdir())
    return path.suffix in STORAGES


def read_rig(path: Path) -> Rig:
    """Return the rig of a recording or of calibration files (`read_calibrated_rig`).

    Raises:
        InputError: The path has no calibration, or is damaged.
    """
    path = Path(path)
    if is_bag(path):
        return open_recording(path).rig
    if path.is_dir() and not (path / CAMCHAIN_FILE).exists():
        mav0 = find_mav0(path)
        return read_euroc_rig(mav0, range(count_cameras(mav0)))
    return read_calibrated_rig(path)


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
    if kitti_folder.is_kitti_folder(path):
        return kitti_folder.read_kitti_truth(path)
    if dso_folder.is_dso_folder(path):
        return dso_folder.read_dso_truth(path)
    if not is_bag(path):
        return read_trajectory_file(path)
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
    elif kitti_folder.is_kitti_folder(path):
        segments = (kitti_folder.read_kitti_frame_times(path),)
    elif dso_folder.is_dso_folder(path):
        segments = (dso_folder.read_dso_frame_times(path),)
    elif not path.is_dir() or not (find_mav0(path) / "cam0").is_dir():
        return None
    else:
        segments = read_euroc_segment_times(path)
    return segments[0 if poses_ns is None else most_common(segments, poses_ns)] if segments else None
