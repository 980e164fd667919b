"""Trajectories as KITTI odometry files: one row per frame with the upper three rows of the pose matrix.

The format is that of the KITTI odometry benchmark (Geiger, Lenz, Urtasun, CVPR 2012): twelve numbers per row, or
thirteen with the frame number in front if frames are missing. The files have no time stamps. Times may come from the
``times.txt`` of the sequence, in seconds since the start; without it, frames are 0.1 s apart, the rate of KITTI's
cameras.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.errors import InputError
from dronevio.models.imu import Times
from dronevio.models.recordings.files import first_row, read_text, write_text
from dronevio.models.recordings.timed_table import (
    NUMBER,
    TIME_LIMIT_NS,
    check_increasing,
    check_not_truncated,
    numbered_rows,
    parse_decimal_seconds,
    quoted,
)
from dronevio.models.rotation import nearest_rotations, quat_wxyz_from_matrix
from dronevio.models.state import Trajectory

FRAME_NS = 100_000_000
"""Interval between frames if no times are given: KITTI's cameras run at 10 Hz [ns]."""

R_UP_KITTI = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""(3, 3) Rotation from KITTI's world frame, that of the first camera (x right, y down, z forward), to FLU axes
(x forward, y left, z up)."""
COLUMNS = (12, 13)
"""Allowed numbers of columns: the matrix without or with the frame number."""

_NAME = "a KITTI trajectory (rows of a pose matrix)"
_ROW = "12 numbers between spaces, or 13 with the frame number in front"
_TIMES = "KITTI times: one number of seconds per line, increasing"
_MAX_FRAME = TIME_LIMIT_NS // FRAME_NS
_ORTHONORMAL = 0.05  # largest deviation of RᵀR from the identity; rounding to two decimals is below


@dataclass(frozen=True, eq=False)
class KittiPoses:
    """Poses of a KITTI file, without conversion."""

    path: Path
    """File from which the poses were read."""
    frames: npt.NDArray[np.int64]
    """(N,) Frame numbers, strictly increasing."""
    Ts_world_cam: Array
    """(N, 3, 4) Poses whose rotations are orthonormal up to the digits of the file."""
    lines: npt.NDArray[np.int64]
    """(N,) Line number of each pose in the file, counted from 1."""

    def trajectory(self, times_ns: Times | None = None) -> Trajectory:
        """Return the trajectory, with the nearest rotations to the matrices.

        Args:
            times_ns: (M,) Time stamps of all frames of the sequence [ns], None for 10 Hz.

        Raises:
            InputError: A frame has no time stamp.
        """
        if times_ns is None:
            return self._stamped(self.frames * FRAME_NS)
        untimed = np.flatnonzero(self.frames >= len(times_ns))
        if untimed.size:
            found, line = f"frame {self.frames[untimed[0]]}", int(self.lines[untimed[0]])
            raise InputError(self.path, found, f"frames below {len(times_ns)}, which have times", line)
        return self._stamped(times_ns[self.frames])

    def _stamped(self, t_ns: Times) -> Trajectory:
        quat_wxyz = quat_wxyz_from_matrix(nearest_rotations(self.Ts_world_cam[:, :, :3]))
        return Trajectory(t_ns, np.ascontiguousarray(self.Ts_world_cam[:, :, 3]), quat_wxyz)


def is_kitti(path: Path) -> bool:
    """Return whether a path is a file whose first row has the number of columns of a KITTI trajectory.

    Raises:
        InputError: The file cannot be read or is empty.
    """
    if path.is_dir():
        return False
    row = first_row(path, _NAME)
    return "," not in row and len(row.split()) in COLUMNS


def read_kitti(path: Path, times: Path | None = None) -> Trajectory:
    """Read a KITTI trajectory. The poses are those of the file, in general of the left camera.

    Args:
        path: The file of poses.
        times: The ``times.txt`` of the sequence, None for 10 Hz.

    Raises:
        InputError: A file is missing, empty, truncated or in another format, or a frame has no time stamp.
    """
    return read_kitti_poses(path).trajectory(None if times is None else read_times_ns(times))


def read_kitti_poses(path: Path) -> KittiPoses:
    """Read the poses of a KITTI file without conversion.

    Raises:
        InputError: The file is missing, empty, truncated or in another format, or a matrix is not a rotation.
    """
    path = Path(path)
    text = read_text(path, _NAME)
    numbered = numbered_rows(text)
    if not numbered:
        raise InputError(path, "no rows", f"{_NAME}: {_ROW}")
    try:
        values = np.loadtxt([row for _, row in numbered], comments=None, ndmin=2)
        if values.shape[1] not in COLUMNS or not np.isfinite(values).all():
            raise ValueError
    except ValueError:
        _raise_first_error(path, numbered)
    check_not_truncated(path, text, numbered, None)
    lines = np.array([i for i, _ in numbered])
    frames = np.arange(len(values))
    if values.shape[1] == 13:
        frames = _frame_numbers(path, values[:, 0], lines)
    poses = KittiPoses(path, frames, np.ascontiguousarray(values[:, -12:]).reshape(-1, 3, 4), lines)
    _check_rotations(poses)
    return poses


def read_times_ns(path: Path) -> Times:
    """Return the times (M,) [ns] of all frames from the ``times.txt`` of a sequence.

    Raises:
        InputError: The file is missing, empty or in another format, or its times do not increase.
    """
    path = Path(path)
    numbered = numbered_rows(read_text(path, _TIMES))
    if not numbered:
        raise InputError(path, "no rows", _TIMES)
    times = []
    for line, row in numbered:
        try:
            times.append(parse_decimal_seconds(row))
            if abs(times[-1]) >= TIME_LIMIT_NS:
                raise ValueError
        except ValueError:
            raise InputError(path, quoted(row), _TIMES, line) from None
    t_ns = np.array(times, dtype=np.int64)
    check_increasing(path, t_ns, np.array([i for i, _ in numbered]))
    return t_ns


def write_kitti(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory as a KITTI file, without time stamps; positions keep their full precision."""
    rows = trajectory.Ts_world_imu[:, :3].reshape(-1, 12).tolist()
    write_text(Path(path), "".join(f"{' '.join(map(repr, row))}\n" for row in rows))


def _frame_numbers(path: Path, values: Array, lines: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return the frame numbers (N,), or raise InputError."""
    wrong = np.flatnonzero((values != np.round(values)) | (values < 0) | (values >= _MAX_FRAME))
    if wrong.size:
        row = int(wrong[0])
        raise InputError(path, f"frame {values[row]:g}", "a frame number, a whole number from 0 on", int(lines[row]))
    wrong = np.flatnonzero(values[1:] <= values[:-1])
    if wrong.size:
        row = int(wrong[0]) + 1
        found = f"frame {values[row]:.0f} after frame {values[row - 1]:.0f}"
        raise InputError(path, found, "frame numbers that increase from row to row", int(lines[row]))
    return values.astype(np.int64)


def _check_rotations(poses: KittiPoses) -> None:
    """Raise InputError unless all matrices are rotations up to rounding."""
    R = poses.Ts_world_cam[:, :, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        deviation = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2))
        wrong = np.flatnonzero(~((deviation < _ORTHONORMAL) & (np.linalg.det(R) > 0.0)))
    if wrong.size:
        row = int(wrong[0])
        raise InputError(
            poses.path, "a matrix that is not a rotation", "a rotation and a position", int(poses.lines[row])
        )


def _raise_first_error(path: Path, numbered: list[tuple[int, str]]) -> NoReturn:
    """Raise InputError for the first row that numpy cannot parse."""
    columns: int | None = None
    for line, row in numbered:
        fields = row.split()
        if len(fields) not in COLUMNS or (columns is not None and len(fields) != columns):
            what = f"{len(fields)} column{'s' if len(fields) > 1 else ''}"
            if line == numbered[-1][0]:
                what = f"a last row of {what} (a truncated file?)"
            raise InputError(path, what, _ROW if columns is None else f"{columns} columns, as before", line)
        columns = len(fields)
        for field in fields:
            if not NUMBER.fullmatch(field) or not np.isfinite(float(field)):
                raise InputError(path, quoted(field), "a finite number", line)
    raise InputError(path, "rows that are not numbers", _ROW)
