"""What is really true of a recording's frames: when they were exposed, for how long, and how much they were amplified.

A table ``frame_groundtruth0/data.csv`` beside an EuRoC folder's other truth, of our own: other readers pass over it,
and recordings need not have it. A real camera's stamps jitter and are off; here is by how much.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dronevio.models.errors import InputError
from dronevio.models.imu import Times
from dronevio.models.recordings.files import read_text
from dronevio.models.recordings.timed_table import TIME_LIMIT_NS, TableFormat, parse_integer_ns, parse_timed_table

Array = npt.NDArray[np.float64]

FRAME_TRUTH_FILE = Path("frame_groundtruth0") / "data.csv"
"""Where the table is, below ``mav0``."""
FRAME_TRUTH_TABLE = TableFormat("a table of frames", (5,), ",", parse_integer_ns, "whole nanoseconds")
"""Time stamp, true middle of the exposure [ns], exposure time [s], gain, 1 if lit."""

_HEADER = "#timestamp [ns],true middle of the exposure [ns],exposure time [s],gain,lit\n"


@dataclass(frozen=True, eq=False)
class FrameTruth:
    """The truth about frames."""

    t_ns: Times
    """(M,) Time stamps, as recorded [ns]."""
    exposed_ns: Times
    """(M,) True middle of the exposure of the middle row, on the IMU's clock [ns]."""
    exposure_s: Array
    """(M,) Exposure times [s]."""
    gain: Array
    """(M,) Amplification, relative to the nominal one."""
    lit: npt.NDArray[np.bool_]
    """(M,) False where no light reached the cameras."""


def read_frame_truth(path: Path) -> FrameTruth:
    """Read the truth about frames.

    Raises:
        InputError: It is missing, cut off or not such a table, or time does not increase.
    """
    return parse_frame_truth(path, read_text(path, FRAME_TRUTH_TABLE.name))


def parse_frame_truth(path: Path, text: str) -> FrameTruth:
    """Read the truth about frames from its text, which comes from ``path``.

    Raises:
        InputError: It is cut off or not such a table, or time does not increase.
    """
    table = parse_timed_table(path, text, FRAME_TRUTH_TABLE)
    # 53 bits of a float do not hold a time since 1970 in nanoseconds, so this column is read again, as whole numbers.
    rows = text.split("\n")
    exposed_ns = [_exposed_ns(path, rows[line - 1], line) for line in table.lines.tolist()]
    exposure_s, gain, lit = np.ascontiguousarray(table.values[:, 1:].T)
    return FrameTruth(table.t_ns, np.array(exposed_ns, dtype=np.int64), exposure_s, gain, lit != 0.0)


def frame_truth_text(truth: FrameTruth) -> str:
    """Return the text of the table, which `read_frame_truth` reads back to the bit."""
    columns = (truth.t_ns, truth.exposed_ns, truth.exposure_s, truth.gain, truth.lit.astype(int))
    rows = zip(*(column.tolist() for column in columns), strict=True)
    return _HEADER + "".join(f"{','.join(map(repr, row))}\n" for row in rows)


def _exposed_ns(path: Path, row: str, line: int) -> int:
    """Return the second column of a row, or raise InputError."""
    text = row.split(",")[1].strip()
    try:
        t_ns = parse_integer_ns(text)
    except ValueError:
        raise InputError(path, f"exposed at {text[:40]!r}", "whole nanoseconds", line) from None
    if abs(t_ns) >= TIME_LIMIT_NS:
        raise InputError(path, f"exposed at {text[:40]}", "whole nanoseconds, below 2⁶² ns", line)
    return t_ns
