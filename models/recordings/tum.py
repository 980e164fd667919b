"""Trajectories as TUM files: rows ``t x y z qx qy qz qw`` with the time in seconds, separated by spaces.

The format is that of the TUM RGB-D benchmark (Sturm et al., IROS 2012). Time stamps are converted between text and
integer nanoseconds exactly. The pose is that of the IMU.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from dronevio.models.recordings.files import write_text
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


def _seconds(t_ns: int) -> str:
    """Return a time [ns] as text in seconds with nine decimals."""
    whole, fraction = divmod(abs(t_ns), 10**9)
    return f"{'-' if t_ns < 0 else ''}{whole}.{fraction:09d}"
