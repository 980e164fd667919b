"""Trajectories as TUM files: rows ``t x y z qx qy qz qw`` with the time in seconds, separated by spaces.

The format is that of the TUM RGB-D benchmark (Sturm et al., IROS 2012). Time stamps are converted between text and
integer nanoseconds exactly. The pose is that of the IMU.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from dronevio.models.errors import InputError
from dronevio.models.recordings import kitti
from dronevio.models.recordings.files import first_row, write_text
from dronevio.models.recordings.timed_table import (
    Repeated,
    TableFormat,
    check_unit_quaternions,
    parse_decimal_seconds,
    read_timed_table,
)
from dronevio.models.rotation import quat_wxyz_from_xyzw, quat_xyzw_from_wxyz
from dronevio.models.state import Trajectory

Notice = Callable[[str], None]
"""Function that receives a sentence about the repair of an input file."""

TUM = TableFormat("a TUM trajectory (t x y z qx qy qz qw)", (8,), None, parse_decimal_seconds, "seconds")
"""Format of a TUM trajectory."""

_HEADER = "# t [s] p_world_imu x y z [m] q_world_imu x y z w\n"
_TREATMENTS = {
    "first": "the first row of each time is used",
    "last": "the last row of each time is used",
    "keep": "all are kept",
}


def no_notice(_: str) -> None:
    """Ignore a notice."""


def read_tum(path: Path, repeated: Repeated = "refuse", notice: Notice = no_notice) -> Trajectory:
    """Read a TUM trajectory.

    Args:
        path: The file to read.
        repeated: Treatment of rows that repeat the time stamp of the previous row.
        notice: Function that receives a message if there are such rows.

    Raises:
        InputError: The file is missing, empty, truncated or not a TUM file, or its time stamps do not increase.
    """
    table = read_timed_table(Path(path), TUM, repeated)
    if table.n_repeated:
        rows = "row repeats" if table.n_repeated == 1 else "rows repeat"
        notice(f"{path}: {table.n_repeated} {rows} the previous time stamp; {_TREATMENTS[repeated]}")
    quat_wxyz = np.ascontiguousarray(quat_wxyz_from_xyzw(table.values[:, 3:7]))
    check_unit_quaternions(table, quat_wxyz)
    return Trajectory(table.t_ns, np.ascontiguousarray(table.values[:, :3]), quat_wxyz)


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write a TUM trajectory without loss of precision."""
    poses = np.hstack([trajectory.p_world_imu, quat_xyzw_from_wxyz(trajectory.quat_wxyz)])
    rows = zip(trajectory.t_ns.tolist(), poses.tolist(), strict=True)
    write_text(Path(path), _HEADER + "".join(f"{_seconds(t)} {' '.join(map(repr, pose))}\n" for t, pose in rows))


def read_trajectory(
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
    from dronevio.models.recordings.euroc import read_groundtruth, read_recording_truth

    return read_recording_truth(path) if path.is_dir() else read_groundtruth(path)


def _seconds(t_ns: int) -> str:
    """Return a time [ns] as text in seconds with nine decimals."""
    whole, fraction = divmod(abs(t_ns), 10**9)
    return f"{'-' if t_ns < 0 else ''}{whole}.{fraction:09d}"
