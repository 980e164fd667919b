"""``dronevio log``: estimates of any program in a rerun file."""

import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.chunk import RrdReader

from dronevio.cli import main
from dronevio.cli.commands.log import names_of
from dronevio.cli.commands.view import viewer_program
from dronevio.models.errors import ConfigError
from dronevio.models.recordings.open import read_trajectory
from dronevio.models.recordings.tum import write_tum
from dronevio.models.rotation import exp_so3

Result = Any  # the class of conftest, which cannot be imported
CommandRunner = Callable[..., Result]


@pytest.fixture(scope="module")
def results(flown: Result, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with two estimates of the short flight: one rotated about z, one 2 % too large with half the poses."""
    folder = tmp_path_factory.mktemp("results")
    truth = read_trajectory(flown.folder)[::10]
    rotated = truth.p_world_imu @ exp_so3(np.array([0.0, 0.0, 2.0])).T + 5.0
    write_tum(folder / "rotated.tum", replace(truth, p_world_imu=rotated))
    write_tum(folder / "large.tum", replace(truth[::2], p_world_imu=1.02 * truth.p_world_imu[::2]))
    return folder


@pytest.fixture(scope="module")
def logged(flown: Result, results: Path, run_command: CommandRunner) -> Result:
    """The rerun file of both estimates."""
    out = results / "new" / "both.rrd"
    estimates = [results / "rotated.tum", results / "large.tum"]
    return run_command(out, "log", flown.folder, *estimates, "--names", "Rotated, 2 % large", "-o", out, "--json")


def entities(path: Path) -> set[str]:
    """Return the paths of the entities of a rerun file."""
    return {chunk.entity_path for chunk in RrdReader(path).stream()}


def test_document_has_file_and_errors(logged: Result, flown: Result) -> None:
    document = logged.document
    assert document["recording"] == str(flown.folder)
    assert document["out"] == str(logged.folder)
    assert document["size_mb"] == pytest.approx(logged.folder.stat().st_size * 1e-6)
    assert [row["name"] for row in document["estimates"]] == ["Rotated", "2 % large"]
    rotated, large = (row["ate_m"] for row in document["estimates"])
    assert rotated < 1e-6 < large < 0.1


def test_file_is_valid_and_contains_both_estimates(logged: Result) -> None:
    command = [*viewer_program(), "rrd", "verify", str(logged.folder)]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    found = entities(logged.folder)
    for name in ("Rotated", "2\\ \\%\\ large"):
        assert f"/world/estimates/{name}/path_so_far" in found
        assert f"/error/position/{name}/aligned" in found
    assert "/world/surroundings/surface0" in found  # from the file beside the recording
    assert [path.name for path in logged.folder.parent.iterdir()] == ["both.rrd"]


def test_table_has_file_and_errors(
    flown: Result, results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "one.rrd"
    assert main(["log", str(flown.folder), str(results / "large.tum"), "--out", str(out), "--crf", "63"]) == 0
    printed = capsys.readouterr().out
    for text in ("large", "ATE", str(out), "dronevio view"):
        assert text in printed.replace("\n", "")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "no estimate"),
        (["rotated.tum", "--names", "a,b"], "--names"),
        (["rotated.tum", "large.tum", "--names", "a,a"], "--names"),
        (["rotated.tum", "--out", "x.txt"], ".rrd"),
        (["rotated.tum", "--crf", "64"], "--crf 64"),
        (["nothing.tum"], "nothing.tum"),
        (["rotated.tum", "--truth", "nothing.tum"], "nothing.tum"),
        (["rotated.tum", "late.tum"], "late: "),
    ],
)
def test_bad_input_is_one_line(
    flown: Result,
    results: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    late = read_trajectory(results / "rotated.tum")
    write_tum(results / "late.tum", replace(late, t_ns=late.t_ns + 10**12))
    monkeypatch.chdir(tmp_path)
    words = [str(results / word) if word.endswith(".tum") else word for word in arguments]
    assert main(["log", str(flown.folder), *words]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_existing_file_is_not_overwritten(logged: Result, flown: Result, results: Path) -> None:
    before = logged.folder.read_bytes()
    assert main(["log", str(flown.folder), str(results / "large.tum"), "-o", str(logged.folder)]) == 2
    assert logged.folder.read_bytes() == before


def test_names_are_those_of_files_and_folders() -> None:
    assert names_of([Path("a/vins.tum"), Path("b/orb.tum")]) == ["vins", "orb"]
    assert names_of([Path("a/estimate.tum"), Path("b/estimate.tum")]) == ["a/estimate", "b/estimate"]
    assert names_of([Path("a.tum"), Path("b.tum")], "x, y z") == ["x", "y z"]
    with pytest.raises(ConfigError):
        names_of([Path("a.tum"), Path("a.tum")])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_killed_command_leaves_a_readable_file(flown: Result, results: Path, tmp_path: Path) -> None:
    unfinished = tmp_path / "x.incomplete.rrd"
    command = [sys.executable, "-m", "dronevio.cli", "log", str(flown.folder), str(results / "rotated.tum")]
    with subprocess.Popen([*command, "-o", str(tmp_path / "x.rrd"), "--json"], stdout=subprocess.DEVNULL) as writer:
        sizes = [0] * 8  # of the last 40 ms: a message is either written as a whole, or not yet begun
        while writer.poll() is None and not (sizes[-1] > 100_000 and sizes[0] == sizes[-1]):
            time.sleep(0.005)
            sizes = [*sizes[1:], unfinished.stat().st_size if unfinished.exists() else 0]
        writer.send_signal(signal.SIGKILL)
        assert writer.wait(10) == -signal.SIGKILL
    assert [path.name for path in tmp_path.iterdir()] == ["x.incomplete.rrd"]
    assert "/world/truth/path_so_far" in entities(unfinished)
