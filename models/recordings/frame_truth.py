"""Ground truth of camera frames: true exposure times, exposure durations and gains.

The table ``frame_groundtruth0/data.csv`` of an EuRoC folder is an extension of the format, which other readers ignore
and which is optional. It reveals the jitter and the offset of time stamps.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.errors import InputError
from dronevio.models.imu import Times
from dronevio.models.recordings.files import read_text
from dronevio.models.recordings.timed_table import TIME_LIMIT_NS, TableFormat, parse_integer_ns, parse_timed_table

FRAME_TRUTH_FILE = Path("frame_groundtruth0") / "data.csv"
"""Path of the table below ``mav0``."""
FRAME_TRUTH_TABLE = TableFormat("a table of frame ground truth", (5,), ",", parse_integer_ns, "whole nanoseconds")
"""Columns: time stamp, true middle of the exposure [ns], exposure duration [s], gain, and 1 if lit."""

_HEADER = "#timestamp [ns],true middle of the exposure [ns],exposure time [s],gain,lit\n"


@dataclass(frozen=True, eq=False)
class FrameTruth:
    """Ground truth of M frames."""

    t_ns: Times
    """(M,) Recorded time stamps of the frames [ns]."""
    exposed_ns: Times
    """(M,) True middle of the exposure of the middle row, on the IMU clock [ns]."""
    exposure_s: Array
    """(M,) Exposure durations of the frames [s]."""
    gain: Array
    """(M,) Gains relative to the nominal gain."""
    lit: npt.NDArray[np.bool_]
    """(M,) Whether light reached the cameras."""


def read_frame_truth(path: Path) -> FrameTruth:
    """Read the ground truth of frames.

    Raises:
        InputError: The file is missing, truncated or in another format, or its time stamps do not increase.
    """
    return parse_frame_truth(path, read_text(path, FRAME_TRUTH_TABLE.name))


def parse_frame_truth(path: Path, text: str) -> FrameTruth:
    """Parse the ground truth of frames from a text that was read from ``path``.

    Raises:
        InputError: The text is truncated or in another format, or its time stamps do not increase.
    """
    table = parse_timed_table(path, text, FRAME_TRUTH_TABLE)
    # A float has 53 bits, too few for a time since 1970 in nanoseconds, so this column is parsed again as integers.
    rows = text.split("\n")
    exposed_ns = [_exposed_ns(path, rows[line - 1], line) for line in table.lines.tolist()]
    exposure_s, gain, lit = np.ascontiguousarray(table.values[:, 1:].T)
    return FrameTruth(table.t_ns, np.array(exposed_ns, dtype=np.int64), exposure_s, gain, lit != 0.0)


def frame_truth_text(truth: FrameTruth) -> str:
    """Return the text of the table without loss of precision."""
    columns = (truth.t_ns, truth.exposed_ns, truth.exposure_s, truth.gain, truth.lit.astype(int))
    rows = zip(*(column.tolist() for column in columns), strict=True)
    return _HEADER + "".join(f"{','.join(map(repr, row))}\n" for row in rows)


def _exposed_ns(path: Path, row: str, line: int) -> int:
    """Return the second column of a row [ns], or raise InputError."""
    text = row.split(",")[1].strip()
    try:
        t_ns = parse_integer_ns(text)
    except ValueError:
        raise InputError(path, f"exposed at {text[:40]!r}", "whole nanoseconds", line) from None
    if abs(t_ns) >= TIME_LIMIT_NS:
        raise InputError(path, f"exposed at {text[:40]}", "whole nanoseconds, below 2⁶² ns", line)
    return t_ns
