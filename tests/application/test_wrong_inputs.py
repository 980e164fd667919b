"""Wrong calibrations and measurements: the warnings of ``dronevio estimate``, and the script that shows them."""

import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dronevio.models.recordings.open import open_recording
from dronevio.models.state import Health

Result = Any  # the class of conftest, which cannot be imported
CommandRunner = Callable[..., Result]


@pytest.fixture(scope="module")
def wrong_inputs(script: Callable[[str], Any]) -> Any:
    return script("wrong_inputs")


@pytest.mark.slow
def test_a_wrong_calibration_is_a_warning(flown: Result, run_command: CommandRunner, tmp_path: Path) -> None:
    """The first two rows of the rotation of the camera are exchanged, and one is negated."""
    wrong = tmp_path / "wrong"
    shutil.copytree(flown.folder, wrong)
    calibration = wrong / "mav0" / "cam0" / "sensor.yaml"
    text = calibration.read_text(encoding="utf-8")
    found = re.search(r"(?s)T_BS:.*?data: \[(.*?)\]", text)
    assert found is not None
    T = np.array([float(value) for value in found[1].split(",")]).reshape(4, 4)
    T[[0, 1], :3] = T[[1, 0], :3] * [[1.0], [-1.0]]
    turned = ", ".join(map(repr, T.ravel().tolist()))
    calibration.write_text(text[: found.start(1)] + turned + text[found.end(1) :], encoding="utf-8")
    result = run_command(tmp_path, "estimate", wrong, "--out", tmp_path / "e.tum", "--json")
    warnings = result.document["warnings"]
    assert warnings and warnings[0]["text"].startswith("lost: ") and warnings[0]["t_s"] > 0.0
    assert f"warning: {warnings[0]['t_s']:.2f} s after the first frame: {warnings[0]['text']}" in result.err
    good = run_command(tmp_path, "estimate", flown.folder, "--out", tmp_path / "good.tum", "--json")
    assert good.document["warnings"] == [] and good.err == ""
    assert 0.1 < good.document["innovations"]["median_nis"] < 5.0
    assert 0.0 < good.document["innovations"]["median_px"] < good.document["innovations"]["p95_px"] < 1.0


@pytest.mark.slow
def test_script_shows_what_is_noticed(wrong_inputs: Any, flown: Result, capsys: pytest.CaptureFixture[str]) -> None:
    faults = ("none", "crossed-flights", "accelerometer-in-g", "frozen-images")
    assert wrong_inputs.main(wrong_inputs.WrongInputsCommand(flown.folder, frames=80, faults=faults)) == 0
    rows = {line.split()[0]: line.split() for line in capsys.readouterr().out.splitlines()[3:] if line}
    assert set(rows) == {"none", "accelerometer-in-g", "frozen-images"}  # there is no other flight
    assert [rows["none"][i] for i in (3, 4)] == ["yes", "no"]
    assert [rows["accelerometer-in-g"][i] for i in (1, 3, 4)] == ["0", "yes", "yes"]


def test_each_fault_has_a_row_of_the_inspection(wrong_inputs: Any, script: Callable[[str], Any]) -> None:
    assert set(script("inspected_recordings").NAMES) == set(wrong_inputs.FAULTS) - {"none"}


def test_errors_count_only_while_tracking(wrong_inputs: Any, flown: Result) -> None:
    """A shift of the second half by 0.4 m is wrong from there on, unless the health is another."""
    recording = open_recording(flown.folder, 1)
    section = wrong_inputs.section_of(recording, 60)
    truth = recording.ground_truth
    assert truth is not None and section.ground_truth is None and len(section.frame_times_ns) == 60
    run = wrong_inputs.odometry(section)
    assert wrong_inputs.late_notice_s(run, truth) is None
    shifted = [
        replace(e, state=e.state and replace(e.state, T_world_imu=e.state.T_world_imu + 0.4 * np.eye(4, k=3)))
        if i >= 40
        else e
        for i, e in enumerate(run.estimates)
    ]
    wrong = replace(run, estimates=tuple(shifted))
    expected_s = (section.frame_times_ns[40] - section.frame_times_ns[0]) * 1e-9
    assert wrong_inputs.late_notice_s(wrong, truth) == pytest.approx(expected_s)
    known = replace(wrong, estimates=tuple(replace(e, health=Health.INERTIAL_ONLY) for e in wrong.estimates))
    assert wrong_inputs.late_notice_s(known, truth) is None
