"""Folders in the format of DSO, as in the exports of TUM-VI: ``cam0/images``, ``cam0/times.txt`` and ``imu.txt``.

A row of ``times.txt`` has the name of an image without its suffix, its time in seconds and its exposure time. Names of
TUM-VI are the time in nanoseconds, which is more exact. A row of ``imu.txt`` has the time in nanoseconds, angular
velocity and specific force. The ground truth ``gt_imu.csv`` is that of EuRoC. Format: Engel, Usenko and Cremers, "A
photometrically calibrated benchmark for monocular visual odometry", arXiv 1607.02555, and the TUM-VI data set.
"""

from collections.abc import Sequence
from itertools import count
from pathlib import Path

import numpy as np

from dronevio.models.errors import InputError
from dronevio.models.imu import ImuModel, Times
from dronevio.models.recordings.euroc import read_groundtruth
from dronevio.models.recordings.files import read_text
from dronevio.models.recordings.folder_contents import FolderContents, calibrated_rig
from dronevio.models.recordings.image_list import ImageList, is_file_name
from dronevio.models.recordings.timed_table import (
    TableFormat,
    numbered_rows,
    parse_decimal_seconds,
    parse_integer_ns,
    quoted,
    read_timed_table,
)
from dronevio.models.rig import Cameras, camera_indices
from dronevio.models.state import Trajectory

IMU_FILE, TIMES_FILE, TRUTH_FILE = "imu.txt", "times.txt", "gt_imu.csv"
"""Names of the files of IMU, images and ground truth."""
IMU_TABLE = TableFormat("IMU samples of TUM-VI", (7,), None, parse_integer_ns, "whole nanoseconds")
"""Columns: time, angular velocity x y z [rad/s], specific force x y z [m/s²]."""

_CALIBRATION = ("camchain.yaml", "imu_config.yaml")  # in exports of TUM-VI
_TIMES = "a list of images: rows of name, time [s], and possibly the exposure time"
_NANOSECONDS = 15  # digits; a name with fewer is a number


def is_dso_folder(path: Path) -> bool:
    """Return whether a path is a folder in the format of DSO with an IMU."""
    return (path / IMU_FILE).is_file() and (path / "cam0" / TIMES_FILE).is_file()


def read_dso_contents(
    folder: Path, cameras: Cameras = None, calibration: Sequence[Path] = (), imu: ImuModel | None = None
) -> FolderContents:
    """Return the contents of a folder.

    Args:
        folder: The folder.
        cameras: Cameras to use.
        calibration: Calibration files of Kalibr or Basalt; by default, ``camchain.yaml`` and ``imu_config.yaml`` in the
            folder.
        imu: Model of the IMU in place of that of the calibration.

    Raises:
        InputError: A file is missing or damaged.
        ConfigError: A camera does not exist.
    """
    present = next(number for number in count() if not (folder / f"cam{number}" / TIMES_FILE).is_file())
    used = camera_indices(cameras, present)
    lists = tuple(_read_times(folder / f"cam{number}") for number in used)
    table = read_timed_table(folder / IMU_FILE, IMU_TABLE, checked=False)
    files = tuple(calibration) or tuple(folder / name for name in _CALIBRATION if (folder / name).is_file())
    if not files:
        raise InputError(folder, "no calibration", "one of Kalibr or Basalt (--calibration camchain.yaml imu.yaml)")
    rig, sampling = calibrated_rig(folder, files, used, lists[0].t_ns, table.t_ns, imu)
    truth = read_dso_truth(folder) if (folder / TRUTH_FILE).exists() else None
    return FolderContents(folder.resolve().name, folder, lists, table, IMU_TABLE, rig, sampling, truth)


def read_dso_truth(folder: Path) -> Trajectory:
    """Return the ground truth of a folder.

    Raises:
        InputError: It is missing or damaged.
    """
    return read_groundtruth(folder / TRUTH_FILE)


def read_dso_frame_times(folder: Path) -> Times:
    """Return the time stamps (M,) [ns] of the frames of the first camera.

    Raises:
        InputError: The list is missing or damaged.
    """
    return np.unique(_read_times(folder / "cam0").t_ns)


def _read_times(camera: Path) -> ImageList:
    """Return the images of a camera, or raise InputError."""
    path = camera / TIMES_FILE
    rows = numbered_rows(read_text(path, _TIMES))
    if not rows:
        raise InputError(path, "no rows", _TIMES)
    t_ns, files = [], []
    for line, row in rows:
        name, *numbers = row.split()
        try:
            is_time = name.isdecimal() and len(name) >= _NANOSECONDS
            t_ns.append(parse_integer_ns(name) if is_time else parse_decimal_seconds(numbers[0]))
        except (ValueError, IndexError):
            raise InputError(path, quoted(row), _TIMES, line) from None
        if not is_file_name(name):
            raise InputError(path, f"file name {quoted(name)}", "the name of a file in the folder images", line)
        files.append(camera / "images" / f"{name}.png")
    return ImageList(path, np.array(t_ns, dtype=np.int64), tuple(files), np.array([line for line, _ in rows]))
