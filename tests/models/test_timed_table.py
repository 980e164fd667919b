"""Tables of numbers over time: exact values, and refused files with line and cause."""

import gc
import math
import re
import time
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.models.errors import InputError
from dronevio.models.recordings.euroc import IMU_TABLE
from dronevio.models.recordings.timed_table import (
    TableFormat,
    TimedTable,
    parse_decimal_seconds,
    parse_integer_ns,
    read_timed_table,
)
from dronevio.models.recordings.tum import TUM

CSV = TableFormat("a table", (3, 5), ",", parse_integer_ns, "whole nanoseconds")
HEADER = "#timestamp [ns],a,b\n"
GOOD = HEADER + "1403715273262142976,1.5,-2e-3\n1403715273312143104,0.25,7\n1403715273362142976,.5,1.\n"

finite = st.floats(allow_nan=False, allow_infinity=False)


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("tables") / "table.csv"


def read(path: Path, text: str | bytes, form: TableFormat = CSV) -> TimedTable:
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return read_timed_table(path, form)


def refusal(path: Path, text: str | bytes, form: TableFormat = CSV) -> InputError:
    with pytest.raises(InputError) as caught:
        read(path, text, form)
    message = str(caught.value)
    assert message.startswith(str(path)) and "expected" in message and "\n" not in message
    return caught.value


def test_numbers_and_times_are_exact(scratch: Path) -> None:
    table = read(scratch, GOOD)
    np.testing.assert_array_equal(table.t_ns, [1403715273262142976, 1403715273312143104, 1403715273362142976])
    np.testing.assert_array_equal(table.values, [[1.5, -2e-3], [0.25, 7.0], [0.5, 1.0]])
    np.testing.assert_array_equal(table.lines, [2, 3, 4])


@pytest.mark.parametrize(
    "text",
    [
        GOOD.replace("\n", "\r\n"),
        GOOD.replace("\n", "\r"),
        GOOD.replace(",", " ,  "),
        "\ufeff" + GOOD,
        GOOD.replace(HEADER, ""),
        GOOD.replace("\n", "\n\n  \n# in between\n"),
    ],
    ids=["crlf", "cr", "spaces", "byte order mark", "no header", "empty lines and comments"],
)
def test_formatting_does_not_change_the_numbers(scratch: Path, text: str) -> None:
    table, plain = read(scratch, text), read(scratch, GOOD)
    np.testing.assert_array_equal(table.t_ns, plain.t_ns)
    np.testing.assert_array_equal(table.values, plain.values)


@pytest.mark.parametrize(
    ("old", "new", "line", "found"),
    [
        ("0.25,7\n", "0.25\n", 3, "2 columns"),
        ("0.25,7\n", "0.25,7,\n", 3, "4 columns"),
        ("0.25,7\n", "0.25,7,8,9\n", 3, "5 columns"),
        ("0.25,7\n", "0.25,\n", 3, "''"),
        ("0.25", "0,25", 3, "4 columns"),
        ("0.25", "x", 3, "'x'"),
        ("0.25", "nan", 3, "non-finite"),
        ("0.25", "-inf", 3, "non-finite"),
        ("0.25", "1e999", 3, "non-finite"),
        ("0.25", "1_0", 3, "'1_0'"),
        ("0.25", "0x10", 3, "'0x10'"),
        ("0.25", "٣", 3, "'٣'"),
        ("1403715273312143104", "1403715273312143104.0", 3, "time stamp '1403715273312143104.0'"),
        ("1403715273312143104", "1.4e18", 3, "time stamp '1.4e18'"),
        ("1403715273312143104", "99999999999999999999", 3, "time stamp '99999999999999999999'"),
        ("1403715273312143104", "", 3, "time stamp ''"),
        ("1403715273262142976", f"{-(2**62)}", 2, f"time stamp '{-(2**62)}'"),
        ("1403715273362142976", f"{2**62}", 4, f"time stamp '{2**62}'"),
        ("1403715273312143104", "1403715273262142976", 3, "after 1403715273262142976"),
        ("1403715273312143104", "1403715273262142975", 3, "after 1403715273262142976"),
        (",.5,1.\n", ",.5\n", 4, "last row of 2 columns"),
        (",.5,1.\n", "", 4, "last row of 1 column"),
        (",7\n1403715273362142976,.5,1.\n", ",7.25\n1403715273362142976,.5,1.", 4, "without a line end"),
        ("0.25", "0.25 # why", 3, "'0.25 # why'"),
    ],
)
def test_errors_name_the_line_and_the_cause(scratch: Path, old: str, new: str, line: int, found: str) -> None:
    error = refusal(scratch, GOOD.replace(old, new))
    assert error.line == line
    assert found in str(error)


@pytest.mark.parametrize("text", ["", "\n\n", HEADER, "# nothing"])
def test_empty_tables_are_refused(scratch: Path, text: str) -> None:
    assert "no rows" in str(refusal(scratch, text))


def test_other_files_are_refused(scratch: Path, tmp_path: Path) -> None:
    assert refusal(scratch, GOOD.encode() + b"\xff\xfe\n").line == 5
    refusal(scratch, b"\0" * 64)
    with pytest.raises(InputError, match="no such file"):
        read_timed_table(tmp_path / "missing.csv", CSV)
    with pytest.raises(InputError, match="a folder"):
        read_timed_table(tmp_path, CSV)


@pytest.mark.parametrize(("form", "separator"), [(CSV, ","), (TUM, " ")])
def test_truncated_files_are_refused_or_shorter(scratch: Path, form: TableFormat, separator: str) -> None:
    width = form.columns[0] - 1
    rows = [(str(5 * i + 1), *(repr(math.sin(7.0 * i + k)) for k in range(width))) for i in range(6)]
    text = "# header\n" + "".join(separator.join(row) + "\n" for row in rows)
    whole = read(scratch, text, form)
    accepted = 0
    for end in range(len(text)):
        try:
            table = read(scratch, text[:end], form)
        except InputError:
            continue
        n = len(table.t_ns)
        np.testing.assert_array_equal(table.t_ns, whole.t_ns[:n])
        np.testing.assert_array_equal(table.values[:-1], whole.values[: n - 1])
        # The last number may lack digits if another row has as few.
        np.testing.assert_allclose(table.values[-1], whole.values[n - 1], rtol=1e-12)
        accepted += 1
    assert accepted >= 5  # one for each line end except the last one and that of the header


def test_the_last_line_end_may_be_missing(scratch: Path) -> None:
    text = HEADER + "1,2.5,3.5\n2,4.5,5.5"
    np.testing.assert_array_equal(read(scratch, text).values, [[2.5, 3.5], [4.5, 5.5]])
    refusal(scratch, text[:-1])
    refusal(scratch, HEADER + "1,2.5,3.5")


NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", re.ASCII)


def expected_rows(text: str, columns: tuple[int, ...], separator: str | None) -> list[list[float]] | None:
    """Return the rows by an independent parser, with exact times; None if the text has to be refused."""
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    rows: list[list[float]] = []
    for line in (line.strip() for line in lines):
        if not line or line.startswith("#"):
            continue
        fields = [field.strip() for field in line.split(separator)]
        if not all(NUMBER.fullmatch(field) for field in fields) or len(fields) not in columns:
            return None
        if separator and not fields[0].lstrip("+-").isdigit():
            return None
        time_ns = int(fields[0]) if separator else round(Fraction(fields[0]) * 10**9)
        rows.append([time_ns, *map(float, fields[1:])])
    ends = [line.split(separator)[-1].strip() for line in map(str.strip, lines) if line and not line.startswith("#")]
    lacks_line_end = lines[-1].strip() != "" and not lines[-1].strip().startswith("#")
    is_truncated = lacks_line_end and (len(ends) < 2 or len(ends[-1]) < min(map(len, ends[:-1])))
    is_complete = bool(rows) and not is_truncated and len(set(map(len, rows))) == 1
    is_finite = is_complete and all(math.isfinite(x) for row in rows for x in row[1:]) and abs(rows[-1][0]) < 2**62
    is_increasing = is_finite and all(a[0] < b[0] for a, b in pairwise(rows))
    return rows if is_increasing and all(abs(row[0]) < 2**62 for row in rows) else None


edits = st.lists(
    st.tuples(
        st.floats(0, 1),
        st.integers(0, 12),
        st.one_of(
            st.text("0123456789.,-+eE \n\t#naif_x", max_size=6),
            st.sampled_from(["\r", "\0", "é", "\x0b", "\u2028", "1e400", "nan", "\n\n", "#", ",,", "٣", "\x1c"]),
        ),
    ),
    max_size=3,
)


@pytest.mark.parametrize("form", [CSV, TUM], ids=["csv", "tum"])
@settings(max_examples=600, deadline=None)
@given(edits=edits, data=st.data())
def test_broken_text_is_refused_or_read_as_expected(
    scratch: Path, form: TableFormat, edits: list[tuple[float, int, str]], data: st.DataObject
) -> None:
    text = GOOD if form is CSV else "# t x y z q\n1.5 1 2 3 0 0 0 1\n1.55 1 2 3.5 0 0 0 1\n1.6e0 1 -2 3 0 0.6 0 .8\n"
    for where, length, inserted in edits:
        start = round(where * len(text))
        text = text[:start] + inserted + text[start + length :]
    expected = expected_rows(text, form.columns, form.delimiter)
    if expected is None:
        refusal(scratch, text, form)
    else:
        table = read(scratch, text, form)
        assert table.t_ns.tolist() == [row[0] for row in expected]
        np.testing.assert_array_equal(table.values, [row[1:] for row in expected])


def test_a_comment_at_the_end_is_no_truncation(scratch: Path) -> None:
    whole = "1,0.25,0.125,0.5\n2,0.25,0.125,0.5\n3,0.25,0.125,1\n"
    form = TableFormat("a table", (4,), ",", parse_integer_ns, "whole nanoseconds")
    for end in ("# done", "#", "   ", ""):
        assert read(scratch, whole + end, form).values[-1].tolist() == [0.25, 0.125, 1.0]
    with pytest.raises(InputError, match="truncated"):
        read(scratch, whole.rstrip("\n"), form)


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=200))
def test_any_bytes_are_refused_or_read(scratch: Path, content: bytes) -> None:
    try:
        assert len(read(scratch, content).t_ns) > 0
    except InputError as error:
        assert str(error).startswith(str(scratch))


@given(st.integers(1 - 2**62, 2**62 - 1), st.integers(0, 12))
def test_decimal_seconds_are_exact(t_ns: int, zeros: int) -> None:
    sign, (whole, fraction) = "-" if t_ns < 0 else "", divmod(abs(t_ns), 10**9)
    assert parse_decimal_seconds(f"{sign}{whole}.{fraction:09d}{'0' * zeros}") == t_ns
    assert parse_decimal_seconds(f"{sign}{abs(t_ns)}e-9") == t_ns


@given(st.decimals(-(10**9), 10**9, places=14))
def test_decimal_seconds_round_to_the_nearest_nanosecond(t_s: object) -> None:
    assert parse_decimal_seconds(f"{t_s:f}") == round(Fraction(str(t_s)) * 10**9)
    assert parse_decimal_seconds(f"{t_s:e}") == round(Fraction(str(t_s)) * 10**9)


@pytest.mark.parametrize(
    "text", ["", "1.2.3", "nan", "inf", "1e", "0x1", "1,5", "1e999999999999", "1" * 100, "1_0", "٣.5"]
)
def test_invalid_decimal_seconds_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match="not a number of seconds"):
        parse_decimal_seconds(text)


@pytest.mark.slow
def test_long_tables_are_read_fast(tmp_path: Path) -> None:
    n = 100_000
    values = np.random.default_rng(0).normal(size=(n, 6))
    rows = (f"{5_000_000 * i},{','.join(map(repr, row))}\n" for i, row in enumerate(values.tolist()))
    text = "".join(rows)
    (tmp_path / "imu.csv").write_text(text)
    ratios = []
    gc.disable()  # its cost depends on what earlier tests have left in memory
    try:
        for _ in range(5):
            start = time.process_time()
            table = read_timed_table(tmp_path / "imu.csv", IMU_TABLE)
            middle = time.process_time()
            numbers = [[float(field) for field in line.split(",")] for line in text.splitlines()]
            ratios.append((middle - start) / (time.process_time() - middle))
    finally:
        gc.enable()
    assert len(numbers) == n
    assert min(ratios) < 2.5  # measured: 1.3; checks of rows and fields one by one take 7
    np.testing.assert_array_equal(table.values, values)
