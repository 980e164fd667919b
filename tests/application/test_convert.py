"""``dronevio convert``: conversions are lossless, and errors are one line."""

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from dronevio.cli import main
from dronevio.models.recordings.bag.file import BagFile
from dronevio.models.recordings.bag.topics import IMAGE_TYPES
from dronevio.models.recordings.calibration.exports import CONFIGURATIONS
from dronevio.models.recordings.euroc import INCOMPLETE, write_euroc_recording
from dronevio.models.recordings.exported import EPOCH_NS
from dronevio.models.recordings.images import encode_png
from dronevio.models.recordings.open import open_recording, read_rig, read_trajectory


@pytest.fixture
def flight(tmp_path: Path, noise_recording: Callable[..., Any]) -> Path:
    recording = noise_recording()
    write_euroc_recording(tmp_path / "flight", recording, frame_truth=recording.frame_truth)
    return tmp_path / "flight"


def test_conversions_are_lossless(
    tmp_path: Path, flight: Path, run_command: Callable[..., Any], assert_same_recording: Callable[..., None]
) -> None:
    original = open_recording(flight)
    document = run_command(tmp_path, "convert", flight, tmp_path / "a.mcap", "--json").document
    assert document["to"] == "mcap" and document["complete"] is True
    assert [document[name] for name in ("cameras", "frames", "imu_samples", "poses")] == [2, 4, 40, 40]
    assert document["size_mb"] == pytest.approx((tmp_path / "a.mcap").stat().st_size * 1e-6)
    run_command(tmp_path, "convert", tmp_path / "a.mcap", tmp_path / "bag", "--to", "bag", "--images", "png")
    run_command(tmp_path, "convert", tmp_path / "bag", tmp_path / "old", "--to", "bag-sqlite")
    run_command(tmp_path, "convert", tmp_path / "old", tmp_path / "back", "--to", "euroc")
    for name in ("a.mcap", "bag", "old", "back"):
        assert_same_recording(open_recording(tmp_path / name), original)
    tables = [path.relative_to(flight) for path in flight.rglob("*") if path.suffix in (".csv", ".yaml")]
    assert len(tables) == 10
    for table in tables:
        assert (tmp_path / "back" / table).read_bytes() == (flight / table).read_bytes(), table


def test_ground_truth_is_converted_alone(tmp_path: Path, flight: Path, run_command: Callable[..., Any]) -> None:
    shown = run_command(tmp_path, "convert", flight, tmp_path / "truth.tum").out
    assert "true poses" in shown and "wrote" in shown and "frames" not in shown and "IMU" not in shown
    truth = open_recording(flight).ground_truth
    assert truth is not None
    np.testing.assert_array_equal(read_trajectory(tmp_path / "truth.tum").quat_wxyz, truth.quat_wxyz)


@pytest.mark.parametrize("program", CONFIGURATIONS)
def test_calibrations_are_written_for_other_programs(
    tmp_path: Path, flight: Path, run_command: Callable[..., Any], program: str
) -> None:
    document = run_command(tmp_path, "convert", flight, tmp_path / program, "--to", program, "--json").document
    assert [document[name] for name in ("cameras", "frames", "imu_samples", "poses")] == [2, 0, 0, 0]
    recording = open_recording(flight)
    written = {path.name: path.read_text() for path in (tmp_path / program).iterdir()}
    assert written == CONFIGURATIONS[program](recording.rig, recording.frame_times_ns, recording.imu)


def test_kalibr_files_describe_the_rig(tmp_path: Path, flight: Path, run_command: Callable[..., Any]) -> None:
    run_command(tmp_path, "convert", flight, tmp_path / "kalibr", "--to", "kalibr")
    for path in (tmp_path / "kalibr", tmp_path / "kalibr" / "camchain.yaml", flight):
        rig = read_rig(path)
        np.testing.assert_array_equal(rig.cameras[1].T_imu_cam, open_recording(flight).rig.cameras[1].T_imu_cam)


def test_incomplete_recordings_are_reported(tmp_path: Path, flight: Path, run_command: Callable[..., Any]) -> None:
    (flight / "mav0" / INCOMPLETE).touch()
    next(iter((flight / "mav0" / "cam1" / "data").iterdir())).unlink()
    document = run_command(tmp_path, "convert", flight, tmp_path / "a.mcap", "--json").document
    assert document["complete"] is False and document["frames"] == 3
    assert "incomplete" in run_command(tmp_path, "convert", flight, tmp_path / "b.mcap").out


def test_cameras_can_be_left_out(tmp_path: Path, flight: Path, run_command: Callable[..., Any]) -> None:
    run_command(tmp_path, "convert", flight, tmp_path / "a.mcap", "--cameras", 0)
    assert len(open_recording(tmp_path / "a.mcap").rig.cameras) == 1


def error_of(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    capsys.readouterr()
    assert main([str(argument) for argument in arguments]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.startswith("dronevio: ")
    return captured.err


def test_nothing_is_overwritten_without_the_option(
    tmp_path: Path, flight: Path, run_command: Callable[..., Any], capsys: pytest.CaptureFixture[str]
) -> None:
    formats = {"a.mcap": "mcap", "bag": "bag", "euroc": "euroc", "a.tum": "tum", "kalibr": "kalibr"}
    for name, form in formats.items():
        run_command(tmp_path, "convert", flight, tmp_path / name, "--to", form)
        assert "--overwrite" in error_of(capsys, "convert", flight, tmp_path / name, "--to", form)
        run_command(tmp_path, "convert", flight, tmp_path / name, "--to", form, "--overwrite")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter").write_text("dear")
    for form in ("bag", "euroc", "kalibr"):
        error_of(capsys, "convert", flight, tmp_path / "mine", "--to", form, "--overwrite", "--json")
    assert (tmp_path / "mine" / "letter").read_text() == "dear"
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["flight", "mine", *formats])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["missing", "a.mcap"], "no such file or folder"),
        (["flight", "somewhere"], "expected --to"),
        (["flight", "somewhere", "--to", "mcap"], "ends with .mcap for mcap only"),
        (["flight", "a.mcap", "--to", "bag"], "ends with .mcap for mcap only"),
        (["flight", "a.mcap", "--cameras", "7"], "cameras 7; expected different ones of cam0 to cam1"),
        (["flight", "a.mcap", "--calibration", "x.yaml"], "x.yaml: no such file"),
    ],
)
def test_bad_input_is_one_line(
    flight: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(flight.parent)
    error = error_of(capsys, "convert", *arguments, "--json")
    assert message in error and error.count("\n") == 1
    assert [path.name for path in flight.parent.iterdir()] == ["flight"]


def test_recording_without_truth_has_no_tum_file(
    tmp_path: Path, noise_recording: Callable[..., Any], capsys: pytest.CaptureFixture[str]
) -> None:
    write_euroc_recording(tmp_path / "flight", replace(noise_recording(), ground_truth=None))
    assert "no ground truth" in error_of(capsys, "convert", tmp_path / "flight", tmp_path / "a.tum", "--json")


def test_bag_is_the_ground_truth_of_an_evaluation(
    tmp_path: Path, flight: Path, run_command: Callable[..., Any]
) -> None:
    run_command(tmp_path, "convert", flight, tmp_path / "a.mcap")
    run_command(tmp_path, "convert", flight, tmp_path / "truth.tum")
    result = run_command(tmp_path, "evaluate", tmp_path / "a.mcap", tmp_path / "truth.tum", "--json")
    assert json.loads(result.out)["ate_m"]["rmse"] == pytest.approx(0.0, abs=1e-9)


def test_exports_of_simulated_flights_begin_at_the_epoch(
    tmp_path: Path, noise_recording: Callable[..., Any], run_command: Callable[..., Any]
) -> None:
    """The stamps of a simulated flight count from its start; those of its exports do not, unless asked for."""
    recording = replace(noise_recording(), ground_truth=None)
    start_ns = recording.imu.t_ns[0]
    imu = replace(recording.imu, t_ns=recording.imu.t_ns - start_ns)
    write_euroc_recording(
        tmp_path / "flight", replace(recording, imu=imu, frame_times_ns=recording.frame_times_ns - start_ns)
    )
    for name, options, first_ns in (
        ("a.mcap", (), EPOCH_NS),
        ("b.mcap", ("--stamps", "recorded"), 0),
        ("folder", ("--to", "euroc", "--imu-sampling", "increment"), EPOCH_NS + 5_000_000),
    ):
        run_command(tmp_path, "convert", tmp_path / "flight", tmp_path / name, *options)
        converted = open_recording(tmp_path / name)
        assert converted.imu.t_ns[0] == first_ns, name
        assert converted.imu.sampling == ("increment" if "increment" in options else "point")


def test_images_in_bags_are_compressed_by_default(
    tmp_path: Path, flight: Path, run_command: Callable[..., Any]
) -> None:
    for name, options, topic in (
        ("png.mcap", (), "/cam1/image_raw/compressed"),
        ("raw.mcap", ("--images", "raw"), "/cam1/image_raw"),
    ):
        run_command(tmp_path, "convert", flight, tmp_path / name, *options)
        assert topic in BagFile(tmp_path / name).topics_of_type(*IMAGE_TYPES)


def test_bags_become_bags_of_ros_1(
    tmp_path: Path, flight: Path, run_command: Callable[..., Any], assert_same_recording: Callable[..., None]
) -> None:
    """The line of the help text works, with the program of the package rosbags, and back to the first format."""
    run_command(tmp_path, "convert", flight, tmp_path / "room", "--to", "bag")
    program = Path(sys.executable).with_name("rosbags-convert")
    arguments = [str(program), "--src", str(tmp_path / "room"), "--dst", str(tmp_path / "room.bag")]
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    with AnyReader([tmp_path / "room.bag"]) as reader:
        counts = {topic: info.msgcount for topic, info in reader.topics.items()}
        assert counts["/imu0"] == 40 and counts["/cam1/image_raw/compressed"] == 4
        connection = next(c for c in reader.connections if c.topic == "/imu0")
        _, _, raw = next(reader.messages([connection]))
        stamp = cast(Any, reader.deserialize(raw, connection.msgtype)).header.stamp
    assert stamp.sec * 10**9 + stamp.nanosec == open_recording(flight).imu.t_ns[0]
    run_command(tmp_path, "convert", tmp_path / "room.bag", tmp_path / "again", "--to", "euroc")
    assert_same_recording(open_recording(tmp_path / "again"), open_recording(flight))


def test_recordings_without_an_imu_are_truth_alone(
    tmp_path: Path, run_command: Callable[..., Any], capsys: pytest.CaptureFixture[str]
) -> None:
    """A sequence of the odometry benchmark of KITTI."""
    folder = tmp_path / "dataset" / "sequences" / "07"
    (folder / "image_0").mkdir(parents=True)
    for k in range(3):
        (folder / "image_0" / f"{k:06d}.png").write_bytes(encode_png(np.full((24, 32), k, np.uint8)))
    (folder / "times.txt").write_text("0.0\n0.1\n0.2\n")
    (folder / "calib.txt").write_text("P0: 70 0 16 0 0 70 12 0 0 0 1 0\n")
    (tmp_path / "dataset" / "poses").mkdir()
    (tmp_path / "dataset" / "poses" / "07.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 3)
    run_command(tmp_path, "convert", folder, tmp_path / "truth.tum")
    assert len(read_trajectory(tmp_path / "truth.tum")) == 3
    assert main(["convert", str(folder), str(tmp_path / "out"), "--to", "euroc"]) == 2
    assert "no IMU; expected a recording with an IMU" in capsys.readouterr().err


LIMITED = """
import resource, sys
from dronevio.cli import main
resource.setrlimit(resource.RLIMIT_FSIZE, (3000, 3000))
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.parametrize(
    "target", [["out.mcap"], ["out", "--to", "bag"], ["out", "--to", "bag-sqlite"], ["out", "--to", "euroc"], ["o.tum"]]
)
def test_a_full_disk_is_named_and_leaves_nothing(tmp_path: Path, flight: Path, target: list[str]) -> None:
    """The largest size of a file stands for the size of the disk."""
    (tmp_path / "place").mkdir()
    arguments = [sys.executable, "-c", LIMITED, "convert", str(flight), *target]
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=120, check=False, cwd=tmp_path / "place")
    assert done.returncode == 2, done.stderr
    [line] = [line for line in done.stderr.splitlines() if line.startswith("dronevio:")]
    assert target[0] in line and "cannot be written" in line
    assert "Traceback" not in done.stderr
    assert list((tmp_path / "place").iterdir()) == []
