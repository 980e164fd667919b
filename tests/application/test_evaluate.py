"""``dronevio evaluate``: scores of files in all formats, and errors for damaged ones."""

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from dronevio.cli import main
from dronevio.models.camera import CameraModel
from dronevio.models.imu import ImuSamples
from dronevio.models.recordings.euroc import write_euroc
from dronevio.models.recordings.kitti import write_kitti
from dronevio.models.recordings.tum import read_tum, write_tum
from dronevio.models.rig import EUROC_T_IMU_CAM0, Rig, RigCamera
from dronevio.models.rotation import exp_so3, quat_wxyz_from_matrix
from dronevio.models.state import Trajectory

START_NS = 1403715273262142976
GROUND_TRUTH = Path("mav0") / "state_groundtruth_estimate0" / "data.csv"


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    """An EuRoC folder of 8 s, beside an estimate without the first 4 s that is 5 % too large and tilted."""
    t_ns = START_NS + 5_000_000 * np.arange(1601)
    t = (t_ns - START_NS) * 1e-9
    p = np.stack([2 * np.sin(t), np.sin(2 * t), 0.3 * np.sin(3 * t)], axis=1)
    quat_wxyz = quat_wxyz_from_matrix(exp_so3(np.stack([0.1 * np.sin(t), 0 * t, 0.4 * t], axis=1)))
    zeros = np.zeros_like(p)
    truth = Trajectory(t_ns, p, quat_wxyz, zeros, zeros, zeros)
    rig = Rig((RigCamera(CameraModel(32, 24, 20.0, 20.0, 15.5, 11.5), EUROC_T_IMU_CAM0),))
    folder = tmp_path / "flight"
    write_euroc(folder, rig, ImuSamples(t_ns, zeros, zeros + [9.81, 0.0, 0.0]), truth, t_ns[::10])
    for stamp in t_ns[::10]:
        cv2.imwrite(str(folder / "mav0" / "cam0" / "data" / f"{stamp}.png"), np.full((24, 32), 99, np.uint8))
    late = truth[800::10]
    tilted = 1.05 * late.p_world_imu @ exp_so3(np.array([0.05, 0.0, 0.0])) + 3.0
    write_tum(tmp_path / "estimate.tum", Trajectory(late.t_ns, tilted, late.quat_wxyz))
    write_tum(tmp_path / "truth.tum", truth)
    return folder


def test_tables_have_scores_with_units(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", str(flight), str(flight.parent / "estimate.tum")]) == 0
    out = capsys.readouterr().out
    for text in (
        "alignment yaw",
        "ATE, position",
        "RPE over 1 s, orientation",
        "scale error",
        "+5.00",
        "coverage",
        "81 of 81",
    ):
        assert text in out


def test_scores_do_not_depend_on_the_format(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    estimate = str(flight.parent / "estimate.tum")
    documents = []
    for truth in (flight, flight / "mav0", flight / GROUND_TRUTH, flight.parent / "truth.tum"):
        assert main(["evaluate", str(truth), estimate, "--json"]) == 0
        documents.append(json.loads(capsys.readouterr().out))
    for document in documents:
        assert document["ate_m"] == documents[0]["ate_m"] and document["rpe_m"] == documents[0]["rpe_m"]
        assert document["scale_error_percent"] == pytest.approx(5.0)
        assert document["n_poses"] == 81 and document["first_pose_s"] == 4.0
    # Of 161 frames, 100 are later than 3 s after the first. Only a folder contains the frames.
    assert [document["coverage_percent"] for document in documents[2:]] == [None, None]
    assert documents[0]["coverage_percent"] == documents[1]["coverage_percent"] == 81.0


def test_a_recording_as_the_estimate_is_refused(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Truth and estimate are exchanged; two recordings are compared."""
    estimate = str(flight.parent / "estimate.tum")
    assert main(["evaluate", estimate, str(flight)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and f"dronevio evaluate {flight} {estimate}" in error
    assert main(["evaluate", str(flight), str(flight)]) == 0


@pytest.mark.parametrize(("every", "is_sparse"), [(10, False), (40, True)])
def test_sparse_ground_truth_is_said(
    flight: Path, capsys: pytest.CaptureFixture[str], every: int, is_sparse: bool
) -> None:
    """Poses every 50 ms are not; every 200 ms are, unless they are not interpolated."""
    truth, estimate = str(flight.parent / "sparse.tum"), str(flight.parent / "estimate.tum")
    write_tum(Path(truth), read_tum(flight.parent / "truth.tum")[::every])
    assert main(["evaluate", truth, estimate]) == 0
    assert ("a pose every 0.20 s" in capsys.readouterr().err) == is_sparse
    assert main(["evaluate", truth, estimate, "--association", "nearest"]) == 0
    assert not capsys.readouterr().err


def test_alignment_is_the_selected_one(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    errors = {}
    for mode in ("none", "yaw", "se3", "sim3"):
        arguments = [str(flight), str(flight.parent / "estimate.tum"), "--alignment", mode, "--json"]
        assert main(["evaluate", *arguments]) == 0
        errors[mode] = json.loads(capsys.readouterr().out)["ate_m"]["rmse"]
    assert errors["none"] == pytest.approx(3 * np.sqrt(3), rel=0.02)  # the translation by (3, 3, 3)
    assert errors["none"] > errors["yaw"] > errors["se3"] > 0.01 > 1e-9 > errors["sim3"]


def test_help_has_options_and_examples(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["evaluate", "--help"])
    assert caught.value.code == 0
    out = capsys.readouterr().out
    for text in ("dronevio evaluate V1_02_medium estimate.tum --alignment se3", "--json", "--alignment"):
        assert text in out


def test_evaluation_loads_no_heavy_package(flight: Path) -> None:
    code = (
        "import sys; from dronevio.cli import main; main(sys.argv[1:]);"
        "print(*{name.split('.')[0] for name in sys.modules}, file=sys.stderr)"
    )
    command = [sys.executable, "-c", code, "evaluate", str(flight), str(flight.parent / "estimate.tum")]
    loaded = subprocess.run(command, capture_output=True, text=True, check=True).stderr.split()
    assert "numpy" in loaded
    assert not {"scipy", "cv2", "mujoco", "gtsam", "rerun", "matplotlib", "gymnasium", "typeguard", "rich"} & set(
        loaded
    )


def test_kitti_files_are_read_with_and_without_times(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A horizontal drive of 900 m in the camera's world frame: x right, y down, z forward."""
    folder, n = flight.parent, 901
    p = np.outer(np.arange(n), [0.0, 0.0, 1.0]) + np.outer(20.0 * np.sin(0.02 * np.arange(n)), [1.0, 0.0, 0.0])
    quat_wxyz = quat_wxyz_from_matrix(exp_so3(np.outer(0.3 * np.sin(0.02 * np.arange(n)), [0.0, 1.0, 0.0])))
    truth = Trajectory(100_000_000 * np.arange(n), p, quat_wxyz)
    R = exp_so3(np.array([0.0, 0.7, 0.0]))  # about the vertical axis of KITTI
    rotated = quat_wxyz_from_matrix(R @ truth.rotations)
    write_kitti(folder / "truth.txt", truth)
    write_kitti(folder / "estimate.txt", Trajectory(truth.t_ns, 1.01 * p @ R.T + 5.0, rotated))
    (folder / "times.txt").write_text("".join(f"{0.2 * i:e}\n" for i in range(n)))
    files = [str(folder / "truth.txt"), str(folder / "estimate.txt")]
    assert main(["evaluate", *files, "--kitti", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["last_pose_s"] == pytest.approx(90.0) and document["rpe_pairs"] == 891
    assert document["ate_deg"]["max"] < 1e-6  # the alignment of yaw removes the rotation
    assert document["drift_percent"] == pytest.approx(1.0, rel=0.05)
    assert document["kitti"]["translation_percent"] == pytest.approx(1.0, rel=0.05)
    assert main(["evaluate", *files, "--times", str(folder / "times.txt"), "--json"]) == 0
    timed = json.loads(capsys.readouterr().out)
    assert timed["last_pose_s"] == pytest.approx(180.0) and timed["kitti"] is None
    assert timed["ate_m"] == document["ate_m"]
    assert main(["evaluate", *files, "--kitti"]) == 0
    shown = capsys.readouterr().out
    assert "KITTI benchmark" in shown and "800 m" in shown and "orientation, °/100 m" in shown
    # The metrics of other files are computed from their poses.
    tum = [str(folder / "truth.tum"), str(folder / "truth.tum"), "--kitti", "--json"]
    assert main(["evaluate", *tum]) == 0
    assert json.loads(capsys.readouterr().out)["kitti"]["ate_m"] == 0.0


def test_repeated_time_stamps_are_reported(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    estimate = flight.parent / "estimate.tum"
    rewritten(estimate, lambda content: content + content.split(b"\n")[-2] + b"\n")
    arguments = ["evaluate", str(flight), str(estimate), "--json"]
    assert main(arguments) == 0
    out, err = capsys.readouterr()
    assert "1 row repeats the previous time stamp; the first row of each time is used" in err
    assert json.loads(out)["n_poses"] == 81
    assert main([*arguments, "--repeated", "refuse"]) == 2


def test_time_offset_is_estimated_and_not_applied(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth = read_tum(flight.parent / "truth.tum")
    write_tum(flight.parent / "late.tum", replace(truth[::10], t_ns=truth.t_ns[::10] + 30_000_000))
    arguments = ["evaluate", str(flight), str(flight.parent / "late.tum"), "--json"]
    documents = []
    for options in ([], ["--estimate-time-offset"], ["--time-offset-s", "-0.03"]):
        assert main([*arguments, *options]) == 0
        documents.append(json.loads(capsys.readouterr().out))
    plain, estimated, corrected = documents
    assert plain["best_time_offset_s"] is None and estimated["best_time_offset_s"] == pytest.approx(-0.03, abs=1e-4)
    assert estimated["ate_m"] == plain["ate_m"] and plain["ate_m"]["rmse"] > 0.01 > corrected["ate_m"]["rmse"]
    assert main([*arguments[:-1], "--estimate-time-offset"]) == 0
    assert "error is smallest: -0.0300" in capsys.readouterr().out


def test_plot_is_written(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = flight.parent / "plots" / "score.png"
    assert main(["evaluate", str(flight), str(flight.parent / "estimate.tum"), "--plot", str(picture)]) == 0
    image = cv2.imread(str(picture))
    assert image is not None and image.shape[0] > 400 and image.std() > 5.0
    capsys.readouterr()
    assert main(["evaluate", str(flight), str(flight.parent / "estimate.tum"), "--plot", str(flight)]) == 2
    assert "a folder; expected the name of a file to write" in capsys.readouterr().err


def rewritten(path: Path, change: Callable[[bytes], bytes]) -> None:
    content = path.read_bytes()
    path.write_bytes(change(content))
    assert path.read_bytes() != content


def with_decreasing_time(content: bytes) -> bytes:
    lines = content.split(b"\n")
    return b"\n".join([*lines[:20], lines[10], *lines[21:]])


def corrupt(flight: Path, fault: str) -> tuple[list[str], str]:
    """Corrupt a recording, and return the command line that fails with the beginning of its message."""
    estimate, truth = flight.parent / "estimate.tum", flight / GROUND_TRUTH
    imu, image = flight / "mav0" / "imu0" / "data.csv", flight / "mav0" / "cam0" / "data" / f"{START_NS}.png"
    evaluate_command = ["evaluate", str(flight), str(estimate), "--json"]
    estimate_command = ["estimate", str(flight), "--out", str(flight.parent / "out.tum"), "--json"]
    match fault:
        case "missing folder":
            shutil.rmtree(flight)
            return evaluate_command, f"{flight}: no such file; expected"
        case "missing recording":
            shutil.rmtree(flight)
            return estimate_command, f"{flight}: no such file or folder; expected a folder of EuRoC"
        case "missing estimate":
            estimate.unlink()
            return evaluate_command, f"{estimate}: no such file; expected"
        case "empty truth":
            rewritten(truth, lambda _: b"")
            return evaluate_command, f"{truth}: no rows; expected"
        case "empty IMU":
            rewritten(imu, lambda content: content.split(b"\n")[0] + b"\n")
            return estimate_command, f"{imu}: no rows; expected"
        case "truncated estimate":
            rewritten(estimate, lambda content: content[:-30])
            return evaluate_command, f"{estimate}:82: a last row of"
        case "truncated IMU":
            rewritten(imu, lambda content: content[: len(content) // 2])
            return estimate_command, "a last row"
        case "time runs backwards in the truth":
            rewritten(truth, with_decreasing_time)
            return (
                evaluate_command,
                f"{truth}:21: time stamp {START_NS + 45_000_000} ns after {START_NS + 90_000_000} ns; expected",
            )
        case "time runs backwards in the IMU":
            rewritten(imu, with_decreasing_time)
            return [*estimate_command, "--strict"], f"{imu}:21: sample at {START_NS + 45_000_000} ns); expected"
        case "image cut off":
            rewritten(image, lambda content: content[:-10])
            return [*estimate_command, "--strict"], f"{image}: a truncated PNG; expected an image of 32 × 24 px"
        case "no image at all":
            rewritten(image, lambda _: b"hello")
            return [*estimate_command, "--strict"], f"{image}: data that cannot be decoded; expected"
        case "missing image":
            image.unlink()
            return [*estimate_command, "--strict"], f"no file data/{image.name}); expected"
        case "no time in common":
            rewritten(estimate, lambda content: content.replace(b"\n14037", b"\n15037"))
            return evaluate_command, "0 poses in common; expected at least 3"
    raise AssertionError(fault)


@pytest.mark.parametrize(
    "fault",
    [
        "missing folder",
        "missing recording",
        "missing estimate",
        "empty truth",
        "empty IMU",
        "truncated estimate",
        "truncated IMU",
        "time runs backwards in the truth",
        "time runs backwards in the IMU",
        "image cut off",
        "no image at all",
        "missing image",
        "no time in common",
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(flight: Path, fault: str, capfd: pytest.CaptureFixture[str]) -> None:
    arguments, message = corrupt(flight, fault)
    before = sorted(flight.parent.rglob("*"))
    assert main(arguments) == 2
    out, err = capfd.readouterr()
    assert out == ""
    assert err.startswith("dronevio: ") and err.endswith("\n") and err.count("\n") == 1
    assert message in err
    assert sorted(flight.parent.rglob("*")) == before  # no partial result


def test_unknown_choice_is_bad_input(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["evaluate", str(flight), str(flight.parent / "estimate.tum")]
    assert main([*arguments, "--alignment", "affine"]) == 2
    assert "invalid choice 'affine'" in capsys.readouterr().err
    assert main([*arguments, "--rpe-delta", "0"]) == 2
    assert "--rpe-delta 0.0; expected a number, more than 0" in capsys.readouterr().err
