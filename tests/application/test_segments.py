"""Recordings whose clock steps, in the commands and in the library: each segment is estimated on its own."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dronevio as dv
from dronevio.cli import main
from dronevio.estimator.slam.visual_slam import VisualSlam
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples
from dronevio.models.protocols import Recording
from dronevio.models.recordings.open import open_recording
from dronevio.models.recordings.segments import segments_of
from dronevio.models.recordings.tum import read_tum, write_tum
from dronevio.models.state import Trajectory

Result = Any  # the class of conftest, which cannot be imported
CommandRunner = Callable[..., Result]
CHANGE_NS = -1_513_000_000


@pytest.fixture(scope="module")
def stepped(flown: Result, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The short flight with a clock that steps back by 1.513 s in the middle."""
    folder = tmp_path_factory.mktemp("stepped") / "flight"
    shutil.copytree(flown.folder, folder, copy_function=os.link)
    times = open_recording(flown.folder).frame_times_ns
    middle_ns = int(times[len(times) // 2])
    for name in ("imu0", "cam0"):
        path = folder / "mav0" / name / "data.csv"
        header, *rows = path.read_text().splitlines(keepends=True)
        split = [row.split(",", 1) for row in rows]
        edited = [f"{int(t) + (CHANGE_NS if int(t) >= middle_ns else 0)},{rest}" for t, rest in split]
        path.unlink()  # a link to the original
        path.write_text("".join([header, *edited]))
    return folder


@pytest.fixture(scope="module")
def estimated(stepped: Path, run_command: CommandRunner, tmp_path_factory: pytest.TempPathFactory) -> Result:
    folder = tmp_path_factory.mktemp("estimated")
    return run_command(
        folder, "estimate", stepped, "--out", folder / "e.tum", "--imu-rate", folder / "imu.tum", "--json"
    )


def test_each_segment_has_its_files_and_figures(estimated: Result, stepped: Path, flown: Result) -> None:
    assert sorted(file.name for file in estimated.folder.iterdir()) == ["e.tum", "e_2.tum", "imu.tum", "imu_2.tum"]
    document, whole = estimated.document, open_recording(flown.folder)
    assert set(document) == {"recording", "segments"} and document["recording"] == str(stepped)
    first, second = document["segments"]
    half = len(whole.frame_times_ns) // 2
    assert (first["frames"], second["frames"]) == (half, len(whole.frame_times_ns) - half)
    assert first["estimate"] == str(estimated.folder / "e.tum") and second["imu_rate"] == str(
        estimated.folder / "imu_2.tum"
    )
    assert first["defects"]["clock_step"]["count"] == 1 and second["defects"] == {}
    warnings = [line for line in estimated.err.splitlines() if "clock step" in line]
    assert len(warnings) == 1 and "(-1.513 s)" in warnings[0]
    truth = whole.ground_truth
    assert truth is not None
    for name, frames, shift_ns in (("e.tum", slice(None, half), 0), ("e_2.tum", slice(half, None), CHANGE_NS)):
        poses = read_tum(estimated.folder / name)
        assert np.isin(poses.t_ns - shift_ns, whole.frame_times_ns[frames]).all() and len(poses) > 0.3 * half
        shifted = Trajectory(poses.t_ns - shift_ns, poses.p_world_imu, poses.quat_wxyz)
        assert dv.ate(truth, shifted).rmse < 0.05


def test_a_segment_without_a_map_does_not_end_the_others(
    stepped: Path, run_command: CommandRunner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written, save_ply = [], VisualSlam.save_ply

    def save(slam: VisualSlam, path: Path, recording: Recording) -> None:
        """Refuse the map of the first segment."""
        written.append(path.name)
        if len(written) == 1:
            raise ConfigError("map without keyframes of this flight; expected one or more")
        save_ply(slam, path, recording)

    monkeypatch.setattr(VisualSlam, "save_ply", save)
    words = "--slam", "--map.no-worker", "--save-ply", tmp_path / "p.ply", "--out", tmp_path / "e.tum"
    shown = run_command(tmp_path, "estimate", stepped, *words)
    assert written == ["p.ply", "p_2.ply"] and "warning: flight" in shown.err and "map without keyframes" in shown.err
    assert {file.name for file in tmp_path.iterdir()} >= {"e.tum", "e_2.tum", "e_2_map.tum"}


def test_the_library_estimates_all_segments(estimated: Result, stepped: Path, tmp_path: Path) -> None:
    """With the bytes of the command; an estimator of the user's has one segment."""
    run = dv.estimate(stepped)
    (later,) = run.later
    for name, of in (("e.tum", run), ("e_2.tum", later)):
        write_tum(tmp_path / name, of.trajectory)
        assert (tmp_path / name).read_bytes() == (estimated.folder / name).read_bytes()
    assert "clock step" in run.estimates[-1].events and later.later == ()
    recording = dv.open_recording(stepped, repair=True)
    segment = recording.later[0]
    with pytest.raises(ConfigError, match="one estimator for the 2 segments of"):
        dv.estimate(recording, dv.VisualInertialOdometry(recording.rig))
    own = dv.estimate(segment, dv.VisualInertialOdometry(segment.rig))
    np.testing.assert_array_equal(own.trajectory.p_world_imu, later.trajectory.p_world_imu)


def test_estimates_are_evaluated_on_the_frames_of_their_segment(
    estimated: Result, stepped: Path, run_command: CommandRunner, tmp_path: Path
) -> None:
    for name, segment in zip(("e.tum", "e_2.tum"), segments_of(open_recording(stepped, repair=True)), strict=True):
        poses, frames = read_tum(estimated.folder / name).t_ns, segment.frame_times_ns
        late = frames > frames[0] + 3 * 10**9
        expected = 100.0 * np.isin(frames[late], poses).mean() if late.any() else None
        scores = run_command(tmp_path, "evaluate", stepped, estimated.folder / name, "--json").document
        assert scores["coverage_percent"] == pytest.approx(expected)
        assert dv.evaluate(stepped, estimated.folder / name).scores.coverage_percent == pytest.approx(expected)


def test_logs_show_the_segment_of_the_estimate(
    estimated: Result, stepped: Path, run_command: CommandRunner, tmp_path: Path
) -> None:
    out = tmp_path / "e.rrd"
    result = run_command(tmp_path, "log", stepped, estimated.folder / "e_2.tum", "--out", out, "--json")
    assert "segment 2 of 2, which has the most of the poses" in result.err and out.stat().st_size > 10_000


def test_strict_and_convert_refuse_a_step_back(stepped: Path, tmp_path: Path, capsys: Any) -> None:
    assert main(["estimate", str(stepped), "--strict", "--out", str(tmp_path / "e.tum")]) == 2
    assert "1 × clock step" in capsys.readouterr().err
    assert main(["convert", str(stepped), str(tmp_path / "a.mcap")]) == 2
    assert "data.csv" in capsys.readouterr().err and not (tmp_path / "a.mcap").exists()


def test_a_segment_without_a_pose_is_said(flown: Result, tmp_path: Path, capsys: Any) -> None:
    """The clock steps three frames before the end."""
    folder = tmp_path / "flight"
    shutil.copytree(flown.folder, folder, copy_function=os.link)
    times = open_recording(flown.folder).frame_times_ns
    for name in ("imu0", "cam0"):
        path = folder / "mav0" / name / "data.csv"
        header, *rows = path.read_text().splitlines(keepends=True)
        split = [row.split(",", 1) for row in rows]
        path.unlink()
        path.write_text(
            header + "".join(f"{int(t) + (10**12 if int(t) >= times[-3] else 0)},{rest}" for t, rest in split)
        )
    assert main(["estimate", str(folder), "--out", str(tmp_path / "e.tum")]) == 0
    shown = capsys.readouterr()
    assert "flight, segment 2 of 2: no pose after 3 frames" in shown.err and "segment 1 of 2" in shown.out
    assert (tmp_path / "e.tum").exists() and not (tmp_path / "e_2.tum").exists()


def test_arrays_with_one_stamp_are_refused_with_what_to_do() -> None:
    values = np.zeros((3, 3))
    with pytest.raises(ConfigError, match=r"spread over the time before it by recordings\.bursts"):
        ImuSamples(np.array([1, 5, 5]), values, values)
    with pytest.raises(ConfigError, match="where the clock steps, a new estimator begins"):
        ImuSamples(np.array([1, 5, 4]), values, values)
