"""Programs as estimators: what they are shown, what they may change, and the times of their poses."""

import errno
import fcntl
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.estimators.external_program import check_pose_times, copy_sensor_data, run_program
from dronevio.estimators.registry import estimator_named
from dronevio.models.errors import EvaluationError
from dronevio.models.recordings.euroc import GROUND_TRUTH_FILE, EurocRecording, write_euroc_recording

Make = Callable[..., Any]

POSES = """
import pathlib, sys
recording, output, *rest = map(pathlib.Path, sys.argv[1:])
stamps = [row.split(",")[0] for row in (recording / "mav0/cam0/data.csv").read_text().splitlines()[1:]]
output.write_text("".join(f"{t[:-9]}.{t[-9:]} 0 0 0 0 0 0 1\\n" for t in stamps))
"""
SHIFTED = POSES.replace("for t in stamps", "for t in (str(int(t) + 12_000_000) for t in stamps)")
SEARCH = """
for start in ("mav0", "mav0/cam0", "mav0/imu0", "mav0/cam0/data", "mav0/body.yaml"):
    for way in (recording / start / "..", (recording / start).resolve().parent):
        assert not [path for path in way.glob("*/data.csv") if "truth" in str(path)], way
assert not [path for path in recording.rglob("*") if path.is_symlink()]
(recording / "mav0/cam0/features.cache").write_text("a file of the program")
"""


@pytest.fixture
def folder(tmp_path: Path, noise_recording: Make) -> Path:
    """A recording of four frames of two cameras, with ground truth."""
    write_euroc_recording(tmp_path / "flight", noise_recording("euroc-stereo"))
    return tmp_path / "flight"


@pytest.fixture
def command(tmp_path: Path) -> Callable[..., list[str]]:
    """Makes the command of a program, given its text and further arguments."""

    def make(text: str, *more: str | Path) -> list[str]:
        program = tmp_path / "program.py"
        program.write_text(text)
        return [sys.executable, str(program), "{recording}", "{output}", *map(str, more)]

    return make


def test_no_path_leads_to_the_truth(folder: Path, command: Callable[..., list[str]]) -> None:
    run = run_program(command(POSES + SEARCH), folder)
    np.testing.assert_array_equal(run.trajectory.t_ns, EurocRecording.open(folder).frame_times_ns)
    assert run.cpu_s > 0.0 and not (folder / "mav0/cam0/features.cache").exists()


def test_the_copy_has_all_sensor_data(folder: Path, tmp_path: Path) -> None:
    copy_sensor_data(folder / "mav0", tmp_path / "copy")
    original = {path.relative_to(folder / "mav0") for path in (folder / "mav0").rglob("*") if path.is_file()}
    copied = {path.relative_to(tmp_path / "copy") for path in (tmp_path / "copy").rglob("*") if path.is_file()}
    assert original - copied == {path for path in original if "groundtruth" in path.parts[0]}
    assert GROUND_TRUTH_FILE in original - copied and copied < original
    assert all((tmp_path / "copy" / path).read_bytes() == (folder / "mav0" / path).read_bytes() for path in copied)


@pytest.mark.parametrize("where", ["copy", "recording"])
@pytest.mark.parametrize("change", ['open(file, "ab").write(b"x")', "pathlib.Path(file).unlink()"])
def test_changed_measurements_are_a_failure(
    folder: Path, command: Callable[..., list[str]], where: str, change: str
) -> None:
    file = "sorted(((rest[0] if rest else recording) / 'mav0/cam1/data').iterdir())[1]"
    words = command(POSES + f"file = {file}\n{change}\n", *([folder] if where == "recording" else []))
    with pytest.raises(EvaluationError, match=r"changed cam1/data/\d+\.png of the recording"):
        run_program(words, folder)


def test_blocks_are_shared_where_that_is_possible(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The request is FICLONE of linux/fs.h. A file system that refuses it gets a copy of the content."""
    cloned: list[int] = []

    def clone(target: int, request: int, source: int) -> int:
        assert request == 0x40049409
        cloned.append(source)
        if len(cloned) % 2:
            raise OSError(errno.EOPNOTSUPP, "Operation not supported")
        return 0

    monkeypatch.setattr(fcntl, "ioctl", clone)
    copy_sensor_data(folder / "mav0", tmp_path / "copy")
    files = [path for path in sorted((tmp_path / "copy").rglob("*")) if path.is_file()]
    assert len(cloned) == len(files)
    assert sum(path.stat().st_size > 0 for path in files) == (len(files) + 1) // 2  # the stand-in clones nothing


def test_a_constant_offset_has_to_be_stated(folder: Path, command: Callable[..., list[str]]) -> None:
    words = " ".join(command(SHIFTED))
    with pytest.raises(EvaluationError, match=r"0% have the time stamp of a frame .* is \+0\.0120 s; expected poses"):
        estimator_named(f"mine=external:{words}").run(folder)
    stated = estimator_named(f"mine=external@0.0125:{words}")
    assert len(stated.run(folder).trajectory) == 4
    assert stated.settings() != estimator_named(f"mine=external:{words}").settings()


FRAMES_NS = 10**18 + 50_000_000 * np.arange(100)


@settings(max_examples=50, deadline=None)
@given(st.integers(-900_000, 900_000), st.floats(-0.5, 0.5), st.integers(1, 10), st.integers(0, 2**32 - 1))
def test_poses_of_frames_are_accepted(jitter_ns: int, offset_s: float, stride: int, seed: int) -> None:
    """Keyframes only, poses between frames and jitter within the tolerance are accepted."""
    offset_ns = round(offset_s * 1e9)
    for poses_ns in (FRAMES_NS[::stride], FRAMES_NS[::-1][::-1][0] + 5_000_000 * np.arange(991)):
        check_pose_times(poses_ns + jitter_ns + offset_ns, FRAMES_NS, (0.0, offset_s), "program")
    arbitrary = FRAMES_NS + np.random.default_rng(seed).integers(2_000_000, 48_000_000, len(FRAMES_NS))
    with pytest.raises(EvaluationError, match="of which 0%"):
        check_pose_times(arbitrary, FRAMES_NS, (0.0,), "program")


def test_coarse_time_stamps_are_refused() -> None:
    """Time stamps that are rounded to a hundredth of a second, for frames at 30 Hz."""
    frames_ns = 10**18 + np.arange(300) * 10**9 // 30 + 4_000_000
    with pytest.raises(EvaluationError, match="time stamp of a frame within 1 ms"):
        check_pose_times(np.unique(np.round(frames_ns / 1e7).astype(np.int64) * 10**7), frames_ns, (0.0,), "program")
    with pytest.raises(EvaluationError, match="0% have"):
        check_pose_times(frames_ns + 3600 * 10**9, frames_ns, (0.0,), "program")
