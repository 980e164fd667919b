"""Benchmarks with metrics of the user."""

import csv
import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dronevio.cli import main
from dronevio.models.recordings.euroc import write_euroc_recording

POSES, HALF, BROKEN = (f"python:my_poses:{name}" for name in ("POSES", "HALF", "BROKEN"))
MODULE = """
from dronevio.eval.metrics import Metric

POSES = Metric("Number of poses", "poses", 0, "high", of=lambda scored: len(scored.estimate.t_ns))
HALF = Metric("Half a metre", "m", 2, of=lambda scored: 0.5)
BROKEN = Metric("Broken", "m", 3, of=lambda scored: scored.colour)
NUMBER = 3.0
"""
PROGRAM = """
[ $1 = good ] || exit 1
echo run >> "$2/runs"
cp "$2/truth.tum" "$4"
"""
FRAMES = 8


@pytest.fixture
def command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, noise_recording: Callable[..., Any]) -> list[str]:
    """Return the command of a benchmark of one flight and two programs, one of which fails, in the current folder."""
    recording = noise_recording(frames=FRAMES)
    write_euroc_recording(tmp_path / "noise", recording)
    truth = recording.ground_truth
    quat_xyzw = np.roll(truth.quat_wxyz, -1, axis=1)
    np.savetxt(
        tmp_path / "truth.tum", np.column_stack([truth.t_ns * 1e-9, truth.p_world_imu, quat_xyzw])[3::10], "%.9f"
    )
    (tmp_path / "program.sh").write_text(PROGRAM, encoding="utf-8")
    (tmp_path / "my_poses.py").write_text(MODULE, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.delitem(sys.modules, "my_poses", raising=False)
    programs = (
        f"{how}=external:sh {tmp_path}/program.sh {how} {tmp_path} {{recording}} {{output}}" for how in ("good", "bad")
    )
    return ["benchmark", "--recordings", "noise", "--estimators", *programs, "--out", "rows"]


def runs() -> int:
    """Return the number of runs of the program that does not fail."""
    return len(Path("runs").read_text(encoding="utf-8").splitlines())


def test_a_metric_is_stored_and_shown(command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*command, "--metrics", POSES, HALF]) == 0
    heading, _, bad, good = capsys.readouterr().out.splitlines()[1:5]
    assert "  Number of poses [poses]  Half a metre [m]  " in heading
    assert bad.split()[-3:] == ["failed", "failed", "–"] and good.split()[-3:-1] == [str(FRAMES), "0.5"]
    Path("my_poses.py").unlink()  # stored results are shown without it
    assert main([*command, "--json"]) == 0 and runs() == 1
    assert [row[POSES] for row in json.loads(capsys.readouterr().out)["rows"]] == [None, FRAMES]
    assert main(["report", "rows", "--format", "csv", "--measures", POSES]) == 0
    found = [(row["unit"], row["median"]) for row in csv.DictReader(capsys.readouterr().out.splitlines())]
    assert found == [("poses", "-inf"), ("poses", str(float(FRAMES)))]
    assert main(["report", "rows", "--format", "markdown"]) == 0
    assert r"Half a metre \[m\]" in capsys.readouterr().out
    assert main(["compare", "rows", "rows", "--metrics", HALF, "--json"]) == 0
    ratios = [each["ratios"][0]["median"] for each in json.loads(capsys.readouterr().out)["comparisons"]]
    assert ratios == [1.0, 1.0]
    assert main(["compare", "rows", "rows", "--metrics", POSES]) == 2  # large values are good
    assert re.search(f"metrics {POSES}; expected some of ate_m, .*, {HALF}$", capsys.readouterr().err, re.MULTILINE)


@pytest.mark.slow
def test_a_metric_is_on_the_page(command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*command, "--metrics", POSES]) == main(["report", "rows"]) == 0
    page = Path("rows/report.html").read_text(encoding="utf-8")
    assert re.search(r"<details[^>]* open[^>]*>\s*<summary>Number of poses \[poses\]", page)


@pytest.mark.slow
def test_runs_are_repeated_for_another_metric_and_for_another_function(command: list[str]) -> None:
    assert main(command) == main([*command, "--metrics", POSES]) == 0 and runs() == 2
    assert main([*command, "--metrics", POSES]) == main(command) == 0 and runs() == 2
    module = Path("my_poses.py")
    module.write_text(MODULE.replace("0.5", "0.25"), encoding="utf-8")
    assert main([*command, "--metrics", POSES]) == 0 and runs() == 3


def test_a_metric_that_raises_an_error_fails_the_run(command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*command, "--metrics", BROKEN]) == 0
    message = f"metric {BROKEN}: AttributeError: 'ScoredTrajectory' object has no attribute 'colour'"
    assert f"noise, good: {message}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("ate_m", "metric 'ate_m'; expected python:package.module:NAME"),
        ("python:my_poses:POSE", "metric python:my_poses:POSE: no such name; expected an instance of"),
        ("python:my_poses:NUMBER", "an object of type float; expected an instance of dronevio.eval.Metric"),
        ("python:no_such_module:POSES", "cannot import no_such_module"),
    ],
)
def test_a_wrong_name_is_refused_at_once(
    name: str, message: str, command: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*command, "--metrics", POSES, name]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not Path("rows").exists()
