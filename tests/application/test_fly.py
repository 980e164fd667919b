"""``dronevio fly``: the recording of a simulated flight."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dronevio.cli import main
from dronevio.cli.flight_options import COLLIDED
from dronevio.models.recordings.euroc import EurocRecording


def test_flight_is_an_euroc_recording(flown: Any) -> None:
    document = flown.document
    assert document["recording"] == str(flown.folder)
    assert document["scenario"] == "short-v0" and document["seed"] == 0
    assert document["frames"] == 120
    assert document["peak_speed_m_s"] > 0.5
    recording = EurocRecording.open(flown.folder)
    assert recording.ground_truth is not None
    assert recording.rig.imu.rate_hz == 200.0
    assert len(recording.frame_times_ns) == 120 and len(recording.imu) == document["imu_samples"]
    assert recording.frame(119).images[0].shape == (480, 752)
    assert recording.ground_truth.length_m == pytest.approx(document["path_m"], rel=1e-6)
    np.testing.assert_array_equal(np.diff(recording.frame_times_ns), 50_000_000)
    assert [entry.name for entry in flown.folder.parent.iterdir()] == ["flight"]
    assert sorted(entry.name for entry in flown.folder.iterdir()) == ["mav0", "scenario.json", "world.npz"]


def test_recording_is_not_overwritten_without_the_option(flown: Any, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fly", "--scenario", "short", "--out", str(flown.folder)]) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert len(EurocRecording.open(flown.folder).frame_times_ns) == 120


def test_unknown_scenario_is_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fly", "--scenario", "moon", "--out", str(tmp_path / "x")]) == 2
    error = capsys.readouterr().err.strip()
    assert "moon" in error
    assert "room" in error
    assert len(error.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_a_collision_has_an_exit_code_of_its_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "crash"
    assert main(["fly", "short", "--faults.rotor-fails-at-s", "3", "--out", str(out)]) == COLLIDED == 3
    assert "the flight ended early: the drone crashed" in capsys.readouterr().out
    assert len(EurocRecording.open(out).frame_times_ns) > 20
