"""Trajectories as TUM files: rows of ``t x y z qx qy qz qw``, the time in seconds, separated by spaces.

The format is that of the TUM RGB-D benchmark (Sturm et al., IROS 2012). Time stamps pass between text and integer
nanoseconds without ever being a float; the pose is that of the IMU.
"""

from pathlib import Path

import numpy as np

from dronevio.models.recordings.euroc import ground_truth_file, read_groundtruth
from dronevio.models.recordings.files import first_row, write_text
from dronevio.models.recordings.timed_table import (
    TableFormat,
    check_unit_quaternions,
    parse_decimal_seconds,
    read_timed_table,
)
from dronevio.models.rotation import quat_wxyz_from_xyzw, quat_xyzw_from_wxyz
from dronevio.models.state import Trajectory

TUM = TableFormat("a TUM trajectory (t x y z qx qy qz qw)", (8,), None, parse_decimal_seconds, "seconds")
"""The format of the file."""

_HEADER = "# t [s] p_world_imu x y z [m] q_world_imu x y z w\n"


def read_tum(path: Path) -> Trajectory:
    """Read a TUM trajectory.

    Raises:
        InputError: It is missing, empty, cut off or not a TUM file, or time does not increase.
    """
    table = read_timed_table(Path(path), TUM)
    quat_wxyz = np.ascontiguousarray(quat_wxyz_from_xyzw(table.values[:, 3:7]))
    check_unit_quaternions(table, quat_wxyz)
    return Trajectory(table.t_ns, np.ascontiguousarray(table.values[:, :3]), quat_wxyz)


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write a TUM trajectory, which `read_tum` reads back to the bit."""
    poses = np.hstack([trajectory.p_world_imu, quat_xyzw_from_wxyz(trajectory.quat_wxyz)])
    rows = zip(trajectory.t_ns.tolist(), poses.tolist(), strict=True)
    write_text(Path(path), _HEADER + "".join(f"{_seconds(t)} {' '.join(map(repr, pose))}\n" for t, pose in rows))


def read_trajectory(path: Path) -> Trajectory:
    """Read a trajectory, whatever its format: a TUM file, a ground-truth CSV of EuRoC, or an EuRoC folder's truth.

    Raises:
        InputError: It is none of these, or damaged.
    """
    path = Path(path)
    if path.is_dir():
        return read_groundtruth(ground_truth_file(path))
    return read_groundtruth(path) if "," in first_row(path, "a TUM or EuRoC trajectory") else read_tum(path)


def _seconds(t_ns: int) -> str:
    """Return a time [ns] in seconds, all nine decimals."""
    whole, fraction = divmod(abs(t_ns), 10**9)
    return f"{'-' if t_ns < 0 else ''}{whole}.{fraction:09d}"
