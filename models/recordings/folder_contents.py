"""What a folder with images in files and a table of IMU samples holds, whatever the layout of its data set is."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dronevio.models.errors import InputError
from dronevio.models.imu import ImuModel, Sampling, Times
from dronevio.models.recordings.calibration.reading import read_calibration
from dronevio.models.recordings.frame_truth import FrameTruth
from dronevio.models.recordings.image_list import ImageList
from dronevio.models.recordings.timed_table import TableFormat, TimedTable
from dronevio.models.rig import Rig
from dronevio.models.state import Trajectory


@dataclass(frozen=True, eq=False)
class FolderContents:
    """Contents of a folder, as they are stored: rows in the order of the files, with their defects."""

    name: str
    """Name of the recording."""
    folder: Path
    """Path of the folder."""
    lists: tuple[ImageList, ...]
    """Images of each camera."""
    imu: TimedTable
    """IMU samples, unchecked: angular velocity x y z [rad/s], specific force x y z [m/s²]; without rows if there is no
    IMU."""
    imu_form: TableFormat
    """Format of the IMU samples."""
    rig: Rig
    """Calibration of cameras and IMU."""
    sampling: Sampling = "point"
    """Meaning of the IMU samples; increments are stored as `interval_means`."""
    ground_truth: Trajectory | None = None
    """Ground truth of the IMU, None if the folder has none."""
    frame_truth: FrameTruth | None = None
    """Ground truth of the frames, None if the folder has none."""
    complete: bool = True
    """Whether the recording was written completely."""


def calibrated_rig(
    folder: Path, files: Sequence[Path], cameras: Sequence[int], t_ns: Times, imu_t_ns: Times, imu: ImuModel | None
) -> tuple[Rig, Sampling]:
    """Return the rig of calibration files for cameras of a folder, and the sampling of the IMU.

    Args:
        folder: The folder, for error messages.
        files: Calibration files of Kalibr or Basalt, one or more.
        cameras: Indices of the cameras that are used, in the order of the calibration.
        t_ns: (M,) Time stamps of the images of the first of them [ns].
        imu_t_ns: (N,) Time stamps of the IMU [ns].
        imu: Model of the IMU in place of that of the files, None for that.

    Raises:
        InputError: A file is damaged, or a camera or the noise of the IMU is missing.
    """
    calibration = read_calibration(files, rate_hz(t_ns, 20.0))
    if len(calibration.cameras) <= max(cameras):
        found = f"{len(calibration.cameras)} cameras, without cam{max(cameras)} of {folder}"
        raise InputError(files[0], found, "the calibration of all cameras, or others to use (--cameras)")
    if imu is not None:
        calibration = replace(calibration, imu=replace(imu, rate_hz=rate_hz(imu_t_ns, imu.rate_hz)))
    if calibration.imu is None:
        expected = (
            "Kalibr's imu.yaml as well (--calibration camchain.yaml imu.yaml), or the name of an IMU (--imu BMI088)"
        )
        raise InputError(files[0], "no noise densities of the IMU", expected)
    return calibration.rig().with_cameras(cameras), calibration.sampling


def rate_hz(t_ns: Times, default_hz: float) -> float:
    """Return the rate of time stamps (N,) [ns] by their median interval, the default without one [Hz]."""
    intervals_ns = np.diff(np.sort(t_ns))
    interval_ns = float(np.median(intervals_ns)) if len(intervals_ns) else 0.0
    return 1e9 / interval_ns if interval_ns > 0.0 else default_hz
