"""``dronevio refly``: images along a recorded trajectory, with its IMU samples or synthesized ones."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dronevio.cli import main
from dronevio.models.recordings.euroc import EurocRecording


@pytest.mark.slow
def test_recorded_imu_samples_are_kept(flown: Any, run_command: Any, tmp_path: Path) -> None:
    mav0 = flown.folder / "mav0"
    options = ("--start-s", "2", "--duration-s", "0.5", "--rig", "nano", "--world", "low-texture", "--json")
    paths = ("--trajectory", mav0, "--imu", mav0 / "imu0" / "data.csv", "--out", tmp_path / "again")
    again = run_command(tmp_path / "again", "refly", *paths, *options)
    assert again.document["imu"] == "real" and again.document["frames"] == 11


@pytest.fixture(scope="module")
def synthesized(flown: Any, run_command: Any, tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder = tmp_path_factory.mktemp("refly") / "out"
    return run_command(
        folder, "refly", "--trajectory", flown.folder, "--rig", "euroc-stereo", "--world", "low-texture",
        "--start-s", "2", "--duration-s", "0.5", "--seed", "3", "--out", folder, "--json",
    )  # fmt: skip


@pytest.mark.slow
def test_imu_samples_are_synthesized_without_recorded_ones(flown: Any, synthesized: Any) -> None:
    assert synthesized.document["imu"] == "synthesized"
    original, again = EurocRecording.open(flown.folder), EurocRecording.open(synthesized.folder)
    assert original.ground_truth is not None and again.ground_truth is not None
    assert np.all(np.isin(again.imu.t_ns, original.imu.t_ns))  # the time stamps are those of the recording
    row = int(np.searchsorted(original.ground_truth.t_ns, again.ground_truth.t_ns[0]))
    truth = original.ground_truth[row : row + len(again.ground_truth)]
    assert np.abs(again.ground_truth.p_world_imu - truth.p_world_imu).max() < 2e-3  # in its world frame
    frame = again.frame(5)
    assert len(frame.images) == 2 and frame.images[1].std() > 5.0


def test_bad_input_is_one_line(flown: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(flown.folder / "mav0" / "state_groundtruth_estimate0", tmp_path / "truth")
    trajectory = str(tmp_path / "truth" / "data.csv")
    for options, expected in (
        (["--world", "moon"], "unknown world 'moon'"),
        (["--rig", "no/such.yaml"], "no rig"),
        (["--start-s", "100"], "of a path of 6"),
        (["--margin-m", "5"], "larger world"),
    ):
        assert main(["refly", "--trajectory", trajectory, "--out", str(tmp_path / "out"), *options]) == 2
        error = capsys.readouterr().err
        assert expected in error and error.count("\n") == 1, error
    assert not (tmp_path / "out").exists()
