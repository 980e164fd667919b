"""Trajectories as files of any format: TUM, KITTI, or the ground truth of EuRoC."""

from pathlib import Path

from dronevio.models.errors import InputError
from dronevio.models.recordings import kitti
from dronevio.models.recordings.euroc import read_groundtruth, read_recording_truth
from dronevio.models.recordings.files import first_row
from dronevio.models.recordings.timed_table import Repeated
from dronevio.models.recordings.tum import Notice, no_notice, read_tum
from dronevio.models.state import Trajectory


def read_trajectory_file(
    path: Path, repeated: Repeated = "refuse", times: Path | None = None, notice: Notice = no_notice
) -> Trajectory:
    """Read a trajectory in TUM, KITTI or EuRoC format.

    Args:
        path: A TUM file, a KITTI file, a ground-truth CSV file of EuRoC, or an EuRoC folder with ground truth.
        repeated: Treatment of rows of a TUM file that repeat the time stamp of the previous row.
        times: The ``times.txt`` of a KITTI file, None for 10 Hz.
        notice: Function that receives a message if there are such rows.

    Raises:
        InputError: The file is missing, damaged or in another format, or ``times`` is given for a file with time
            stamps.
    """
    path = Path(path)
    row = "," if path.is_dir() else first_row(path, "a TUM, KITTI or EuRoC trajectory")
    if "," not in row and len(row.split()) in kitti.COLUMNS:
        return kitti.read_kitti(path, times)
    if times is not None:
        raise InputError(path, "a trajectory with time stamps", f"a KITTI trajectory, to which {times} applies")
    if "," not in row:
        return read_tum(path, repeated, notice)
    return read_recording_truth(path) if path.is_dir() else read_groundtruth(path)
