"""Trajectories as KITTI odometry files: a row a frame, the upper three rows of its pose as a matrix.

The format is that of the KITTI odometry benchmark (Geiger, Lenz, Urtasun, CVPR 2012): twelve numbers a row, or thirteen
with the number of the frame in front, where frames are left out. There are no time stamps; they may come from the
sequence's ``times.txt``, seconds after the start, one a frame. Without it frames count as 0.1 s apart, the rate of
KITTI's cameras.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np
import numpy.typing as npt

from dronevio.models.errors import InputError
from dronevio.models.imu import Times
from dronevio.models.recordings.files import first_row, read_text, write_text
from dronevio.models.recordings.timed_table import (
    NUMBER,
    TIME_LIMIT_NS,
    check_increasing,
    check_whole,
    numbered_rows,
    parse_decimal_seconds,
    shown,
)
from dronevio.models.rotation import nearest_rotations, quat_wxyz_from_matrix
from dronevio.models.state import Trajectory

Array = npt.NDArray[np.float64]

FRAME_NS = 100_000_000
"""Time between frames where no times are given [ns]: KITTI's cameras run at 10 Hz."""

R_UP_KITTI = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""From KITTI's world, which is that of the first camera (x right, y down, z forward), to x forward, y left, z up."""
COLUMNS = (12, 13)
"""How many numbers a row has: those of the matrix, with or without that of the frame."""

_NAME = "a KITTI trajectory (rows of a pose's matrix)"
_ROW = "12 numbers between spaces, or 13 with the frame's number in front"
_TIMES = "KITTI's times: one number of seconds a line, increasing"
_MOST_FRAMES = TIME_LIMIT_NS // FRAME_NS
_SKEW = 0.05  # deviation of RᵀR from the identity that rounding to two decimals stays below


@dataclass(frozen=True, eq=False)
class KittiPoses:
    """The poses of a KITTI file as they stand there."""

    path: Path
    """Where they were read."""
    frames: npt.NDArray[np.int64]
    """(N,) Numbers of the frames, increasing."""
    Ts_world_cam: Array
    """(N, 3, 4) Poses; their rotations are such to the digits of the file."""
    lines: npt.NDArray[np.int64]
    """(N,) Line of the file, counted from 1, on which each pose stands."""

    def trajectory(self, times_ns: Times | None = None) -> Trajectory:
        """Return the poses over time, their matrices made exact rotations.

        Args:
            times_ns: (M,) Time stamps of all frames of the sequence [ns]; None for 10 Hz.

        Raises:
            InputError: There are frames without a time.
        """
        if times_ns is None:
            return self._stamped(self.frames * FRAME_NS)
        late = np.flatnonzero(self.frames >= len(times_ns))
        if late.size:
            found = f"frame {self.frames[late[0]]}"
            raise InputError(self.path, found, f"frames below {len(times_ns)}, which have times", self._line(late[0]))
        return self._stamped(times_ns[self.frames])

    def _stamped(self, t_ns: Times) -> Trajectory:
        quat_wxyz = quat_wxyz_from_matrix(nearest_rotations(self.Ts_world_cam[:, :, :3]))
        return Trajectory(t_ns, np.ascontiguousarray(self.Ts_world_cam[:, :, 3]), quat_wxyz)

    def _line(self, row: int) -> int:
        return int(self.lines[row])


def is_kitti(path: Path) -> bool:
    """Say whether a path is a file whose first row has as many numbers as KITTI's.

    Raises:
        InputError: It is a file that cannot be read or is empty.
    """
    if path.is_dir():
        return False
    row = first_row(path, _NAME)
    return "," not in row and len(row.split()) in COLUMNS


def read_kitti(path: Path, times: Path | None = None) -> Trajectory:
    """Read a KITTI trajectory; the pose is that of the left camera, or whatever the file says that it is.

    Args:
        path: The file of poses.
        times: The sequence's ``times.txt``; None for 10 Hz.

    Raises:
        InputError: A file is missing, empty, cut off or not what it should be, or frames have no times.
    """
    return read_kitti_poses(path).trajectory(None if times is None else read_times_ns(times))


def read_kitti_poses(path: Path) -> KittiPoses:
    """Read the poses of a KITTI file as they stand there.

    Raises:
        InputError: It is missing, empty, cut off or no such file, or a matrix is far from a rotation.
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
        _raise_first_fault(path, numbered)
    check_whole(path, text, numbered, None)
    lines = np.array([i for i, _ in numbered])
    frames = np.arange(len(values))
    if values.shape[1] == 13:
        frames = _frame_numbers(path, values[:, 0], lines)
    poses = KittiPoses(path, frames, np.ascontiguousarray(values[:, -12:]).reshape(-1, 3, 4), lines)
    _check_rotations(poses)
    return poses


def read_times_ns(path: Path) -> Times:
    """Read a sequence's ``times.txt``: the time of every frame (M,) [ns].

    Raises:
        InputError: It is missing, empty, or no such file, or time does not increase.
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
            raise InputError(path, shown(row), _TIMES, line) from None
    t_ns = np.array(times, dtype=np.int64)
    check_increasing(path, t_ns, np.array([i for i, _ in numbered]))
    return t_ns


def write_kitti(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory as a KITTI file, without its times; positions come back to the bit."""
    rows = trajectory.Ts_world_imu[:, :3].reshape(-1, 12).tolist()
    write_text(Path(path), "".join(f"{' '.join(map(repr, row))}\n" for row in rows))


def _frame_numbers(path: Path, values: Array, lines: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return the numbers of frames (N,), or raise InputError."""
    wrong = np.flatnonzero((values != np.round(values)) | (values < 0) | (values >= _MOST_FRAMES))
    if wrong.size:
        row = int(wrong[0])
        raise InputError(path, f"frame {values[row]:g}", "whole numbers from 0 on, of frames", int(lines[row]))
    wrong = np.flatnonzero(values[1:] <= values[:-1])
    if wrong.size:
        row = int(wrong[0]) + 1
        found = f"frame {values[row]:.0f} after frame {values[row - 1]:.0f}"
        raise InputError(path, found, "frame numbers that increase from row to row", int(lines[row]))
    return values.astype(np.int64)


def _check_rotations(poses: KittiPoses) -> None:
    """Raise InputError unless all matrices are rotations, up to rounding."""
    R = poses.Ts_world_cam[:, :, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        skew = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2))
        wrong = np.flatnonzero(~((skew < _SKEW) & (np.linalg.det(R) > 0.0)))
    if wrong.size:
        row = int(wrong[0])
        raise InputError(
            poses.path, "a matrix that is no rotation", "a pose: rotation and position", int(poses.lines[row])
        )


def _raise_first_fault(path: Path, numbered: list[tuple[int, str]]) -> NoReturn:
    """Find the first row that numpy could not read and raise InputError for it."""
    columns: int | None = None
    for line, row in numbered:
        fields = row.split()
        if len(fields) not in COLUMNS or (columns is not None and len(fields) != columns):
            what = f"{len(fields)} column{'s' if len(fields) > 1 else ''}"
            if line == numbered[-1][0]:
                what = f"a last row of {what} (a file cut off?)"
            raise InputError(path, what, _ROW if columns is None else f"{columns} columns, as above", line)
        columns = len(fields)
        for field in fields:
            if not NUMBER.fullmatch(field) or not np.isfinite(float(field)):
                raise InputError(path, shown(field), "a finite number", line)
    raise InputError(path, "rows that are no numbers", _ROW)
