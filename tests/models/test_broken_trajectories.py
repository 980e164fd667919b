"""Fuzzed TUM and KITTI files: each is refused with file and line, or read exactly."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.models.errors import InputError
from dronevio.models.recordings.kitti import read_kitti, read_times_ns
from dronevio.models.recordings.timed_table import Repeated, parse_decimal_seconds
from dronevio.models.recordings.trajectory_file import read_trajectory_file
from dronevio.models.recordings.tum import read_tum
from dronevio.models.rotation import exp_so3, quat_wxyz_from_matrix, quat_xyzw_from_wxyz
from dronevio.models.state import Trajectory

_WITHOUT_LINE = re.compile("no rows|no such file|cannot be read")  # errors that concern the whole file
REPETITIONS: tuple[Repeated, ...] = ("first", "last", "keep")
_INTERESTING = [*b"0123456789+-.eE \t\n\r,#;xnaif\0", 0xFF, 0xC3, 0xA9, 0xE2, 0x80, 0xA8, 0x1C, 0x85, 0xA0]


def tum_text(rng: np.random.Generator, n: int = 6) -> bytes:
    t = 1403715273.0 + np.cumsum(rng.uniform(0.01, 0.1, n))
    q = quat_xyzw_from_wxyz(quat_wxyz_from_matrix(exp_so3(rng.normal(size=(n, 3)))))
    rows = (f"{s:.6f} " + " ".join(f"{x:.7f}" for x in (*rng.normal(size=3), *r)) for s, r in zip(t, q, strict=True))
    return ("# t x y z qx qy qz qw\n" + "\n".join(rows) + "\n").encode()


def kitti_text(rng: np.random.Generator, n: int = 6) -> bytes:
    T = np.concatenate([exp_so3(rng.normal(size=(n, 3))), rng.normal(size=(n, 3, 1))], axis=2)
    numbered = rng.random() < 0.5
    rows = [(f"{i} " if numbered else "") + " ".join(f"{x:.9g}" for x in row.ravel()) for i, row in enumerate(T)]
    return ("\n".join(rows) + "\n").encode()


def times_text(rng: np.random.Generator, n: int = 6) -> bytes:
    return ("\n".join(f"{s:e}" for s in np.cumsum(rng.uniform(0.05, 0.2, n))) + "\n").encode()


def mutated(content: bytes, rng: np.random.Generator) -> bytes:
    """Return a file after one to four random changes."""
    data = bytearray(content)
    for _ in range(rng.integers(1, 5)):
        at = int(rng.integers(0, len(data) + 1))
        end = min(len(data), at + int(rng.integers(1, 40)))
        match int(rng.integers(0, 7)):
            case 0:
                data[at:at] = bytes([int(rng.choice(_INTERESTING))])
            case 1:
                del data[at:end]
            case 2 if at < len(data):
                data[at] = int(rng.choice(_INTERESTING))
            case 3:
                data[at:at] = data[at:end]
            case 4:
                del data[at:]
            case 5:
                words = data.split(b" ")
                i, j = rng.integers(0, len(words), 2)
                words[i], words[j] = words[j], words[i]
                data = bytearray(b" ".join(words))
            case 6:
                data[at:at] = rng.choice([b"nan", b"inf", b"1e999", b"-0", b"1e-400", b"9" * 30, b"\xe2\x80\xa8"])
    return bytes(data)


def rows_of(content: bytes) -> list[list[str]]:
    """Return the fields of a table by an independent parser."""
    text = content.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    return [line.split() for line in text.split("\n") if line.strip() and not line.strip().startswith("#")]


def check_tum(path: Path, content: bytes) -> None:
    read = read_tum(path)
    rows = rows_of(content)
    assert read.t_ns.tolist() == [parse_decimal_seconds(row[0]) for row in rows]
    values = np.array([[float(x) for x in row[1:]] for row in rows])
    np.testing.assert_array_equal(read.p_world_imu, values[:, :3])
    np.testing.assert_array_equal(quat_xyzw_from_wxyz(read.quat_wxyz), values[:, 3:])
    assert_valid(read)


def check_kitti(path: Path, content: bytes) -> None:
    read = read_kitti(path)
    values = np.array([[float(x) for x in row] for row in rows_of(content)])
    frames = values[:, 0] if values.shape[1] == 13 else np.arange(len(values))
    np.testing.assert_array_equal(read.t_ns, 100_000_000 * frames)
    T = values[:, -12:].reshape(-1, 3, 4)
    np.testing.assert_array_equal(read.p_world_imu, T[:, :, 3])
    np.testing.assert_allclose(read.rotations, T[:, :, :3], atol=0.06)
    assert_valid(read)


def check_times(path: Path, content: bytes) -> None:
    assert read_times_ns(path).tolist() == [parse_decimal_seconds(" ".join(row)) for row in rows_of(content)]


def assert_valid(read: Trajectory) -> None:
    assert np.isfinite(read.p_world_imu).all() and np.all(np.diff(read.t_ns) > 0)
    np.testing.assert_allclose(np.linalg.norm(read.quat_wxyz, axis=1), 1.0, atol=0.05)


FORMATS: dict[str, tuple[Callable[[np.random.Generator], bytes], Callable[[Path, bytes], None]]] = {
    "TUM": (tum_text, check_tum),
    "KITTI": (kitti_text, check_kitti),
    "times": (times_text, check_times),
}


def read_or_refuse(path: Path, content: bytes, check: Callable[[Path, bytes], None]) -> bool:
    """Check a file, and return whether it is refused with a complete message."""
    path.write_bytes(content)
    try:
        check(path, content)
    except InputError as error:
        message = str(error)
        assert error.path == path and message.startswith(str(path))
        assert "expected" in message and "\n" not in message and len(message) < 500 + len(str(path))
        assert error.line is not None or _WITHOUT_LINE.search(message), message
        if error.line is not None:
            assert 1 <= error.line <= content.count(b"\n") + content.count(b"\r") + 1
        return True
    return False


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMATS)
def test_two_thousand_fuzzed_files(form: str, tmp_path: Path) -> None:
    make, check = FORMATS[form]
    refused = 0
    for seed in range(2000):
        rng = np.random.default_rng(seed)
        refused += read_or_refuse(tmp_path / "x.txt", mutated(make(rng), rng), check)
    assert 200 < refused < 1950  # some files are still valid


@pytest.mark.parametrize("form", FORMATS)
def test_arbitrary_bytes_are_refused_or_read(form: str, tmp_path_factory: pytest.TempPathFactory) -> None:
    path, check = tmp_path_factory.mktemp("text") / "x.txt", FORMATS[form][1]

    @settings(max_examples=300, deadline=None)
    @given(st.one_of(st.binary(max_size=200), st.text(max_size=200).map(lambda text: text.encode("utf-8", "replace"))))
    def run(content: bytes) -> None:
        read_or_refuse(path, content, check)

    run()


@settings(max_examples=300, deadline=None)
@given(
    st.lists(
        st.lists(
            st.one_of(
                st.integers(-(10**20), 10**20).map(str),
                st.floats().map(repr),
                st.sampled_from(["1", "0", "-1", "1e999", "nan", "0x1", "1_0", "٣", "", "+", "1.5.2", "∞", "1e"]),
            ),
            min_size=7,
            max_size=14,
        ),
        min_size=1,
        max_size=4,
    ),
    st.sampled_from([" ", "\t", "  ", ",", " , "]),
)
def test_rows_of_arbitrary_fields_are_refused_or_read(
    tmp_path_factory: pytest.TempPathFactory, rows: list[list[str]], between: str
) -> None:
    path = tmp_path_factory.getbasetemp() / "rows.txt"
    content = "".join(between.join(row) + "\n" for row in rows).encode()
    for check in (check_tum, check_kitti):
        read_or_refuse(path, content, check)
    try:
        assert_valid(read_trajectory_file(path))  # in the format that is detected
    except InputError as error:
        assert error.path == path


def test_repeated_time_stamps_are_treated_as_requested(tmp_path: Path) -> None:
    path = tmp_path / "x.tum"
    notices: list[str] = []
    stamps = ["1.0", "2.0", "2.0", "2.0", "2.000000001", "3.0"]
    path.write_text("".join(f"{t} {i} 0 0 0 0 0 1\n" for i, t in enumerate(stamps)))
    with pytest.raises(InputError, match="after 2000000000 ns") as caught:
        read_tum(path)
    assert caught.value.line == 3
    first, last, keep = (read_tum(path, treatment, notices.append) for treatment in REPETITIONS)
    assert first.p_world_imu[:, 0].tolist() == [0, 1, 4, 5] and last.p_world_imu[:, 0].tolist() == [0, 3, 4, 5]
    assert keep.t_ns.tolist() == [10**9, 2 * 10**9, 2 * 10**9 + 1, 2 * 10**9 + 2, 2 * 10**9 + 3, 3 * 10**9]
    assert [notice.removeprefix(f"{path}: ") for notice in notices] == [
        "2 rows repeat the previous time stamp; the first row of each time is used",
        "2 rows repeat the previous time stamp; the last row of each time is used",
        "2 rows repeat the previous time stamp; all are kept",
    ]
    path.write_text("1.0 0 0 0 0 0 0 1\n2.0 0 0 0 0 0 0 1\n2.0 0 0 0 0 0 0 1\n1.5 0 0 0 0 0 0 1\n")
    for treatment in REPETITIONS:  # decreasing time stamps are always refused
        with pytest.raises(InputError, match="1500000000 ns after 2000000000 ns") as caught:
            read_tum(path, treatment)
        assert caught.value.line == 4
