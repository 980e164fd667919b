"""Trajectories as TUM files: rows of ``t x y z qx qy qz qw``, the time in seconds, separated by spaces.

The format is that of the TUM RGB-D benchmark (Sturm et al., IROS 2012). Time stamps pass between text and integer
nanoseconds without ever being a float; the pose is that of the IMU.
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
"""Is told, in a sentence, what a reader mended."""

TUM = TableFormat("a TUM trajectory (t x y z qx qy qz qw)", (8,), None, parse_decimal_seconds, "seconds")
"""The format of the file."""

_HEADER = "# t [s] p_world_imu x y z [m] q_world_imu x y z w\n"
_COUNTED = {"first": "of each time the first counts", "last": "of each time the last counts", "keep": "all are kept"}


def unheard(_: str) -> None:
    """Ignore a notice."""


def read_tum(path: Path, repeated: Repeated = "refuse", notice: Notice = unheard) -> Trajectory:
    """Read a TUM trajectory.

    Args:
        path: The file.
        repeated: What becomes of rows that repeat the time stamp above.
        notice: Is told if there are such rows.

    Raises:
        InputError: It is missing, empty, cut off or not a TUM file, or time does not increase.
    """
    table = read_timed_table(Path(path), TUM, repeated)
    if table.n_repeated:
        rows = "row repeats" if table.n_repeated == 1 else "rows repeat"
        notice(f"{path}: {table.n_repeated} {rows} the time stamp above; {_COUNTED[repeated]}")
    quat_wxyz = np.ascontiguousarray(quat_wxyz_from_xyzw(table.values[:, 3:7]))
    check_unit_quaternions(table, quat_wxyz)
    return Trajectory(table.t_ns, np.ascontiguousarray(table.values[:, :3]), quat_wxyz)


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write a TUM trajectory, which `read_tum` reads back to the bit."""
    poses = np.hstack([trajectory.p_world_imu, quat_xyzw_from_wxyz(trajectory.quat_wxyz)])
    rows = zip(trajectory.t_ns.tolist(), poses.tolist(), strict=True)
    write_text(Path(path), _HEADER + "".join(f"{_seconds(t)} {' '.join(map(repr, pose))}\n" for t, pose in rows))


def read_trajectory(
    path: Path, repeated: Repeated = "refuse", times: Path | None = None, notice: Notice = unheard
) -> Trajectory:
    """Read a trajectory, whatever its format: TUM, KITTI, a ground-truth CSV of EuRoC, or an EuRoC folder's truth.

    Args:
        path: The file or folder.
        repeated: What becomes of rows of a TUM file that repeat the time stamp above.
        times: The ``times.txt`` of a KITTI file; None for 10 Hz.
        notice: Is told of rows that repeat a time stamp.

    Raises:
        InputError: It is none of these, or damaged; or times are given for a file that has its own.
    """
    path = Path(path)
    row = "," if path.is_dir() else first_row(path, "a TUM, KITTI or EuRoC trajectory")
    if "," not in row and len(row.split()) in kitti.COLUMNS:
        return kitti.read_kitti(path, times)
    if times is not None:
        raise InputError(path, "a trajectory with time stamps", f"one of KITTI's, to which {times} would belong")
    if "," not in row:
        return read_tum(path, repeated, notice)
    from dronevio.models.recordings.euroc import ground_truth_file, read_groundtruth

    return read_groundtruth(ground_truth_file(path) if path.is_dir() else path)


def _seconds(t_ns: int) -> str:
    """Return a time [ns] in seconds, all nine decimals."""
    whole, fraction = divmod(abs(t_ns), 10**9)
    return f"{'-' if t_ns < 0 else ''}{whole}.{fraction:09d}"
