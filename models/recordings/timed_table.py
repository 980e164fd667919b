"""Tables of numbers over time: text files whose rows are a time stamp and a fixed count of numbers.

The reader is strict, because a wrong number that is read silently costs more than one that is refused, and fast:
numpy parses the whole table at once, and only when that fails does a second look, line by line, find the fault.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from decimal import Context, Decimal
from pathlib import Path
from typing import Literal, NoReturn

import numpy as np
import numpy.typing as npt

from dronevio.models.errors import InputError
from dronevio.models.imu import Times
from dronevio.models.recordings.files import read_text

Array = npt.NDArray[np.float64]

Repeated = Literal["refuse", "first", "last", "keep"]
"""What becomes of rows that repeat the time stamp above: an error, the first or the last of them counts, or all are
kept, each stamped a nanosecond after the one before."""

TIME_LIMIT_NS = 2**62
"""Time stamps stay below it, 146 years, so that differences of two fit into 64 bits [ns]."""

_INTEGER = re.compile(r"[+-]?\d+", re.ASCII)
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
"""How a finite number is written."""
_SECONDS = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,2})?", re.ASCII)
_EXACT = Context(prec=200)
_UNIT_TOLERANCE = 0.05  # rounding to two decimals stays below; a wrong order of columns does not
_SHOWN = 40  # characters of a faulty text that a message shows


@dataclass(frozen=True)
class TableFormat:
    """How the rows of a table are written."""

    name: str
    """What the table is, for messages: ``an IMU table``."""
    columns: tuple[int, ...]
    """The allowed numbers of columns, the time stamp included."""
    delimiter: str | None
    """What stands between two columns; None for any white space."""
    parse_time: Callable[[str], int]
    """Turns the text of a time stamp into ns, and raises ValueError where it is none."""
    time_unit: str
    """How time stamps are written, for messages: ``whole nanoseconds``."""

    @property
    def row(self) -> str:
        """What a row should be, for messages."""
        counts = " or ".join(map(str, self.columns))
        between = "commas" if self.delimiter == "," else "spaces"
        return f"{counts} numbers between {between}, first the time in {self.time_unit}"


@dataclass(frozen=True, eq=False)
class TimedTable:
    """A table of numbers over time."""

    path: Path
    """Where it was read."""
    t_ns: Times
    """(N,) Time stamps [ns], strictly increasing."""
    values: Array
    """(N, C) The other columns, all finite."""
    lines: npt.NDArray[np.int64]
    """(N,) Line of the file, counted from 1, on which each row stands."""
    n_repeated: int = 0
    """How many rows of the file repeat the time stamp above."""


def parse_integer_ns(text: str) -> int:
    """Return the time [ns] that is written as a whole number of nanoseconds.

    Raises:
        ValueError: It is not.
    """
    if not _INTEGER.fullmatch(text):
        raise ValueError(f"{text!r} is no whole number")
    return int(text)


def parse_decimal_seconds(text: str) -> int:
    """Return the time [ns] that is written in seconds, exactly, rounded to the nearest nanosecond.

    A double has 53 bits and a time since 1970 in nanoseconds needs 61, so the text never goes through a float.

    Raises:
        ValueError: It is no number of seconds.
    """
    whole, point, fraction = text.partition(".")
    if point and whole.isdecimal() and len(fraction) == 9 and fraction.isdecimal() and text.isascii():
        return int(whole + fraction)  # the usual nine decimals, four times as fast
    if not _SECONDS.fullmatch(text) or len(text) > 64:
        raise ValueError(f"{text!r} is no number of seconds")
    return int(Decimal(text).scaleb(9, _EXACT).to_integral_value(context=_EXACT))


def read_timed_table(path: Path, form: TableFormat, repeated: Repeated = "refuse") -> TimedTable:
    """Read a table of numbers over time; empty lines, and lines that begin with ``#``, are passed over.

    Args:
        path: The file.
        form: How its rows are written.
        repeated: What becomes of rows that repeat the time stamp above.

    Raises:
        InputError: The file is missing, empty or cut off, has a row with too few or too many columns, something that
            is not a finite number, or time stamps that do not increase.
    """
    return parse_timed_table(path, read_text(path, form.name), form, repeated)


def parse_timed_table(path: Path, text: str, form: TableFormat, repeated: Repeated = "refuse") -> TimedTable:
    """Read a table from its text, which comes from ``path``; see `read_timed_table`.

    Raises:
        InputError: As `read_timed_table`.
    """
    numbered = numbered_rows(text)
    if not numbered:
        raise InputError(path, "no rows", f"{form.name}: rows of {form.row}")
    lines = np.array([i for i, _ in numbered])
    rows = [row for _, row in numbered]
    try:
        t_ns, values = _parse(rows, form)
    except (ValueError, OverflowError):
        _raise_first_fault(path, numbered, form)
    check_whole(path, text, numbered, form.delimiter)
    table = TimedTable(path, t_ns, values, lines)
    _check_finite(table, form)
    if repeated != "refuse":
        table = _settled(table, repeated)
    check_increasing(path, table.t_ns, table.lines)
    return table


def numbered_rows(text: str) -> list[tuple[int, str]]:
    """Return the rows of a table with their line numbers, without empty lines and comments."""
    return [(i, row) for i, line in enumerate(text.split("\n"), 1) if (row := line.strip()) and row[0] != "#"]


def check_whole(path: Path, text: str, numbered: list[tuple[int, str]], delimiter: str | None) -> None:
    """Check that a table does not end within a number: without a line end, and its last shorter than all above it.

    Many programs leave out the last line end, so that alone proves nothing; but with a single row nothing else speaks
    for it. Where a comment or an empty line is the last one, the row above it has its line end.

    Raises:
        InputError: It does.
    """
    if numbered[-1][0] != text.count("\n") + 1:
        return
    lengths = [len(row.split(delimiter)[-1].strip()) for _, row in numbered]
    if lengths[-1] < min(lengths[:-1], default=lengths[-1] + 1):
        found = "a last number without a line end, shorter than all above it"
        raise InputError(path, found, "a whole file; this one seems cut off", numbered[-1][0])


def check_increasing(path: Path, t_ns: Times, lines: npt.NDArray[np.int64]) -> None:
    """Check that time stamps (N,) [ns], which stand on the given lines (N,) of a file, increase.

    Raises:
        InputError: One does not.
    """
    wrong = np.flatnonzero(t_ns[1:] <= t_ns[:-1])
    if wrong.size:
        i = int(wrong[0]) + 1
        found = f"time stamp {t_ns[i]} ns after {t_ns[i - 1]} ns"
        raise InputError(path, found, "time stamps that increase from row to row", int(lines[i]))


def check_unit_quaternions(table: TimedTable, quat_wxyz: Array) -> None:
    """Check that the quaternions (N, 4) read from a table are of unit length.

    Raises:
        InputError: One is not.
    """
    with np.errstate(over="ignore"):  # of numbers near the largest float
        norm = np.linalg.norm(quat_wxyz, axis=1)
    wrong = np.flatnonzero(~(np.abs(norm - 1.0) < _UNIT_TOLERANCE))
    if wrong.size:
        found = f"a quaternion of length {norm[wrong[0]]:.3g}"
        raise InputError(table.path, found, "one of length 1", int(table.lines[wrong[0]]))


def _settled(table: TimedTable, repeated: Repeated) -> TimedTable:
    """Return a table of which no row repeats a time stamp; that time runs backwards is left to be found."""
    same = table.t_ns[1:] == table.t_ns[:-1]
    if not same.any():
        return table
    if repeated == "keep" and np.all(table.t_ns[1:] >= table.t_ns[:-1]):
        count = np.arange(len(table.t_ns))
        t_ns = np.maximum.accumulate(table.t_ns - count) + count
        return replace(table, t_ns=t_ns, n_repeated=int(same.sum()))
    kept = np.concatenate([~same, [True]] if repeated == "last" else [[True], ~same])
    return TimedTable(table.path, table.t_ns[kept], table.values[kept], table.lines[kept], int(same.sum()))


def _parse(rows: list[str], form: TableFormat) -> tuple[Times, Array]:
    """Return time stamps (N,) and the other columns (N, C) of rows, or raise ValueError or OverflowError."""
    parts = [row.split(form.delimiter, 1) for row in rows]
    if min(map(len, parts)) < 2 or not all(part[1].strip() for part in parts):
        raise ValueError("a row of one column")
    t_ns = np.array([form.parse_time(part[0].strip()) for part in parts], dtype=np.int64)
    if t_ns.min() <= -TIME_LIMIT_NS or t_ns.max() >= TIME_LIMIT_NS:
        raise OverflowError("a time stamp beyond the limit")
    values = np.loadtxt([part[1] for part in parts], delimiter=form.delimiter, comments=None, ndmin=2)
    if values.shape[1] + 1 not in form.columns:
        raise ValueError("a wrong number of columns")
    return t_ns, values


def _check_finite(table: TimedTable, form: TableFormat) -> None:
    """Raise InputError unless all values are finite."""
    infinite = np.flatnonzero(~np.isfinite(table.values).all(axis=1))
    if infinite.size:
        raise InputError(table.path, "a number that is not finite", form.row, int(table.lines[infinite[0]]))


def _raise_first_fault(path: Path, numbered: list[tuple[int, str]], form: TableFormat) -> NoReturn:
    """Find the first row that numpy could not read and raise InputError for it."""
    columns: int | None = None
    for line, row in numbered:
        fields = [field.strip() for field in row.split(form.delimiter)]
        if len(fields) not in form.columns or (columns is not None and len(fields) != columns):
            what = f"{len(fields)} column{'s' if len(fields) > 1 else ''}"
            if line == numbered[-1][0]:
                what = f"a last row of {what} (a file cut off?)"
            raise InputError(path, what, form.row if columns is None else f"{columns} columns, as above", line)
        columns = len(fields)
        try:
            if abs(form.parse_time(fields[0])) >= TIME_LIMIT_NS:
                raise ValueError
        except ValueError:
            raise InputError(path, f"time stamp {shown(fields[0])}", f"{form.time_unit}, below 2⁶² ns", line) from None
        for field in fields[1:]:
            if not NUMBER.fullmatch(field):
                raise InputError(path, shown(field), "a finite number", line)
    raise InputError(path, "rows that are no numbers", form.row)


def shown(text: str) -> str:
    """Return a text as a message can show it: quoted, on one line, not endless."""
    return repr(text if len(text) <= _SHOWN else text[:_SHOWN] + "…")
