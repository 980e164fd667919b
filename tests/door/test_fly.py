"""dronevio fly, by its door."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dronevio.cli import main
from dronevio.models.camera import CameraModel
from dronevio.models.recordings.euroc import EurocRecording
from dronevio.models.rig import EUROC_T_IMU_CAM0, RigCamera, euroc_rig
from dronevio.sim.scenario import SCENARIOS


def test_a_flight_is_a_recording(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    small = CameraModel(width=188, height=120, fx=115.0, fy=115.0, cx=92.0, cy=62.0)
    rig = replace(euroc_rig(), cameras=(RigCamera(small, EUROC_T_IMU_CAM0),))
    monkeypatch.setitem(SCENARIOS, "short", replace(SCENARIOS["short"], rig=rig))  # small images are drawn sooner
    target = tmp_path / "flight"
    assert main(["fly", "--scenario", "short", "--seed", "2", "--out", str(target), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["recording"] == str(target)
    assert said["frames"] == 120
    assert said["peak_speed_m_s"] > 0.5
    recording = EurocRecording.open(target)
    assert recording.ground_truth is not None
    assert len(recording.frame_times_ns) == 120
    assert recording.frame(119).images[0].shape == (120, 188)
    assert recording.ground_truth.length_m == pytest.approx(said["path_m"], rel=1e-6)
    np.testing.assert_array_equal(np.diff(recording.frame_times_ns), 50_000_000)
    assert main(["fly", "--scenario", "short", "--out", str(target)]) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert [entry.name for entry in tmp_path.iterdir()] == ["flight"]


def test_unknown_scenarios_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fly", "--scenario", "moon", "--out", str(tmp_path / "x")]) == 2
    error = capsys.readouterr().err.strip()
    assert "moon" in error
    assert "room" in error
    assert len(error.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []
