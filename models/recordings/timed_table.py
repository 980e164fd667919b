"""Tables of numbers over time: text files whose rows are a time stamp and a fixed number of values.

The reader is strict, so that damaged files are refused instead of misread. Numpy parses the whole table at once; only
if that fails, the rows are checked one by one to find the first error.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from decimal import Context, Decimal
from pathlib import Path
from typing import Literal, NoReturn

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.errors import InputError
from dronevio.models.imu import Times
from dronevio.models.recordings.files import read_text

Repeated = Literal["refuse", "first", "last", "keep"]
"""Treatment of rows that repeat the time stamp of the previous row: raise an error, use the first or the last of them,
or keep all of them with time stamps one nanosecond apart."""

TIME_LIMIT_NS = 2**62
"""Upper limit of time stamps, 146 years, so that the difference of two fits into 64 bits [ns]."""

_INTEGER = re.compile(r"[+-]?\d+", re.ASCII)
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
"""Syntax of a finite number."""
_SECONDS = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,2})?", re.ASCII)
_EXACT = Context(prec=200)
_UNIT_TOLERANCE = 0.05  # above rounding to two decimals, below the effect of exchanged columns
_MAX_QUOTED = 40  # characters of a quotation in an error message


@dataclass(frozen=True)
class TableFormat:
    """Format of the rows of a table."""

    name: str
    """Description of the table for error messages, such as ``an IMU table``."""
    columns: tuple[int, ...]
    """Allowed numbers of columns, including the time stamp."""
    delimiter: str | None
    """Delimiter between columns, None for white space."""
    parse_time: Callable[[str], int]
    """Function that converts the text of a time stamp to nanoseconds, or raises ValueError."""
    time_unit: str
    """Unit of time stamps for error messages, such as ``whole nanoseconds``."""

    @property
    def row(self) -> str:
        """Description of a row for error messages."""
        counts = " or ".join(map(str, self.columns))
        between = "commas" if self.delimiter == "," else "spaces"
        return f"{counts} numbers between {between}, first the time in {self.time_unit}"


@dataclass(frozen=True, eq=False)
class TimedTable:
    """A table of numbers over time."""

    path: Path
    """File from which the table was read."""
    t_ns: Times
    """(N,) Time stamps, strictly increasing if they were checked [ns]."""
    values: Array
    """(N, C) Values of the other columns, all finite if they were checked."""
    lines: npt.NDArray[np.int64]
    """(N,) Line number of each row in the file, counted from 1."""
    n_repeated: int = 0
    """Number of rows that repeat the time stamp of the previous row."""

    @classmethod
    def empty(cls, path: Path, columns: int = 6) -> "TimedTable":
        """Return a table without rows."""
        return cls(path, np.zeros(0, np.int64), np.zeros((0, columns)), np.zeros(0, np.int64))

    def place(self, row: int) -> str:
        """Return file and line of a row."""
        return f"{self.path}:{self.lines[row]}"

    def selected(self, rows: npt.NDArray[np.int64]) -> "TimedTable":
        """Return the table of some of the rows."""
        return TimedTable(self.path, self.t_ns[rows], self.values[rows], self.lines[rows])


def parse_integer_ns(text: str) -> int:
    """Return the time [ns] of a text with a whole number of nanoseconds.

    Raises:
        ValueError: The text is not a whole number.
    """
    if not _INTEGER.fullmatch(text):
        raise ValueError(f"{text!r} is not a whole number")
    return int(text)


def parse_decimal_seconds(text: str) -> int:
    """Return the time [ns] of a text with a decimal number of seconds, rounded to the nearest nanosecond.

    The conversion is exact and does not use floats, because a time since 1970 in nanoseconds needs 61 bits and a double
    has 53.

    Raises:
        ValueError: The text is not a number of seconds.
    """
    whole, point, fraction = text.partition(".")
    if point and whole.isdecimal() and len(fraction) == 9 and fraction.isdecimal() and text.isascii():
        return int(whole + fraction)  # fast path for the usual nine decimals
    if not _SECONDS.fullmatch(text) or len(text) > 64:
        raise ValueError(f"{text!r} is not a number of seconds")
    return int(Decimal(text).scaleb(9, _EXACT).to_integral_value(context=_EXACT))


def read_timed_table(path: Path, form: TableFormat, repeated: Repeated = "refuse", checked: bool = True) -> TimedTable:
    """Read a table of numbers over time. Empty lines and lines that begin with ``#`` are ignored.

    Args:
        path: The file to read.
        form: Format of its rows.
        repeated: Treatment of rows that repeat the time stamp of the previous row.
        checked: Whether numbers must be finite and time stamps must increase.

    Raises:
        InputError: The file is missing, empty or truncated, a row has a wrong number of columns or a value that is not
            a number; or, if they are checked, a number is not finite or the time stamps do not increase.
    """
    return parse_timed_table(path, read_text(path, form.name), form, repeated, checked)


def parse_timed_table(
    path: Path, text: str, form: TableFormat, repeated: Repeated = "refuse", checked: bool = True
) -> TimedTable:
    """Parse the text of a table that was read from ``path``; see `read_timed_table`.

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
        _raise_first_error(path, numbered, form)
    check_not_truncated(path, text, numbered, form.delimiter)
    table = TimedTable(path, t_ns, values, lines)
    if not checked:
        return table
    _check_finite(table, form)
    if repeated != "refuse":
        table = _without_repetitions(table, repeated)
    check_increasing(path, table.t_ns, table.lines)
    return table


def check_table(table: TimedTable, form: TableFormat) -> None:
    """Check that the numbers of a table are finite and its time stamps increase.

    Raises:
        InputError: A number is not finite, or a time stamp is not later than the previous one.
    """
    _check_finite(table, form)
    check_increasing(table.path, table.t_ns, table.lines)


def numbered_rows(text: str) -> list[tuple[int, str]]:
    """Return line number and text of each row of a table, without empty lines and comments."""
    return [(i, row) for i, line in enumerate(text.split("\n"), 1) if (row := line.strip()) and row[0] != "#"]


def check_not_truncated(path: Path, text: str, numbered: list[tuple[int, str]], delimiter: str | None) -> None:
    """Check that a table does not end within a number.

    A table is regarded as truncated if the last line end is missing and the last number is shorter than those of all
    other rows. The missing line end alone is no evidence, because many programs omit it, except if there is one row
    only.

    Args:
        path: The file.
        text: Its text.
        numbered: Its rows with their line numbers, at least one.
        delimiter: Delimiter between columns, None for white space.

    Raises:
        InputError: The table is truncated.
    """
    if numbered[-1][0] != text.count("\n") + 1:
        return
    lengths = [len(row.split(delimiter)[-1].strip()) for _, row in numbered]
    if lengths[-1] < min(lengths[:-1], default=lengths[-1] + 1):
        found = "a last number without a line end, shorter than those of all other rows"
        raise InputError(path, found, "a complete file, not a truncated one", numbered[-1][0])


def check_increasing(path: Path, t_ns: Times, lines: npt.NDArray[np.int64]) -> None:
    """Check that time stamps increase.

    Args:
        path: The file.
        t_ns: (N,) Time stamps [ns].
        lines: (N,) Their line numbers in the file.

    Raises:
        InputError: A time stamp is not later than the previous one.
    """
    wrong = np.flatnonzero(t_ns[1:] <= t_ns[:-1])
    if wrong.size:
        i = int(wrong[0]) + 1
        found = f"time stamp {t_ns[i]} ns after {t_ns[i - 1]} ns"
        raise InputError(path, found, "time stamps that increase from row to row", int(lines[i]))


def check_unit_quaternions(table: TimedTable, quat_wxyz: Array) -> None:
    """Check that quaternions (N, 4) that were read from a table have unit length.

    Raises:
        InputError: The length of a quaternion differs from 1.
    """
    with np.errstate(over="ignore"):  # for numbers near the largest float
        norm = np.linalg.norm(quat_wxyz, axis=1)
    wrong = np.flatnonzero(~(np.abs(norm - 1.0) < _UNIT_TOLERANCE))
    if wrong.size:
        found = f"a quaternion of length {norm[wrong[0]]:.3g}"
        raise InputError(table.path, found, "a unit quaternion", int(table.lines[wrong[0]]))


def _without_repetitions(table: TimedTable, repeated: Repeated) -> TimedTable:
    """Return a table without repeated time stamps. Decreasing time stamps remain for `check_increasing` to find."""
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
    """Return time stamps (N,) [ns] and other columns (N, C) of rows, or raise ValueError or OverflowError."""
    parts = [row.split(form.delimiter, 1) for row in rows]
    if min(map(len, parts)) < 2 or not all(part[1].strip() for part in parts):
        raise ValueError("a row of one column")
    t_ns = np.array([form.parse_time(part[0].strip()) for part in parts], dtype=np.int64)
    if t_ns.min() <= -TIME_LIMIT_NS or t_ns.max() >= TIME_LIMIT_NS:
        raise OverflowError("a time stamp above the limit")
    values = np.loadtxt([part[1] for part in parts], delimiter=form.delimiter, comments=None, ndmin=2)
    if values.shape[1] + 1 not in form.columns:
        raise ValueError("a wrong number of columns")
    return t_ns, values


def _check_finite(table: TimedTable, form: TableFormat) -> None:
    """Raise InputError unless all values are finite."""
    infinite = np.flatnonzero(~np.isfinite(table.values).all(axis=1))
    if infinite.size:
        raise InputError(table.path, "a non-finite number", form.row, int(table.lines[infinite[0]]))


def _raise_first_error(path: Path, numbered: list[tuple[int, str]], form: TableFormat) -> NoReturn:
    """Raise InputError for the first row that numpy cannot parse."""
    columns: int | None = None
    for line, row in numbered:
        fields = [field.strip() for field in row.split(form.delimiter)]
        if len(fields) not in form.columns or (columns is not None and len(fields) != columns):
            what = f"{len(fields)} column{'s' if len(fields) > 1 else ''}"
            if line == numbered[-1][0]:
                what = f"a last row of {what} (a truncated file?)"
            raise InputError(path, what, form.row if columns is None else f"{columns} columns, as before", line)
        columns = len(fields)
        try:
            if abs(form.parse_time(fields[0])) >= TIME_LIMIT_NS:
                raise ValueError
        except ValueError:
            raise InputError(path, f"time stamp {quoted(fields[0])}", f"{form.time_unit}, below 2⁶² ns", line) from None
        for field in fields[1:]:
            if not NUMBER.fullmatch(field):
                raise InputError(path, quoted(field), "a finite number", line)
    raise InputError(path, "rows that are not numbers", form.row)


def quoted(text: str) -> str:
    """Return a text for an error message: in quotes, on one line and of limited length."""
    return repr(text if len(text) <= _MAX_QUOTED else text[:_MAX_QUOTED] + "…")
