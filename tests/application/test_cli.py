"""The door: quick to open, honest about what it does not know, and every command behind it explains itself."""

import shlex
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dronevio import __version__
from dronevio.cli import COMMANDS, main
from dronevio.cli.benchmark import BenchmarkCommand
from dronevio.cli.estimate import EstimateCommand
from dronevio.cli.flight_options import parse_flight
from dronevio.cli.run import RunCommand
from dronevio.cli.terminal import parse

HEAVY = ("cv2", "gtsam", "gymnasium", "matplotlib", "mujoco", "numpy", "rerun", "rich", "scipy", "tyro")


def python(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)


def test_help_is_quick() -> None:
    command = [sys.executable, "-m", "dronevio.cli", "--help"]
    took_s = []
    for _ in range(3):
        start = time.perf_counter()
        shown = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout
        took_s.append(time.perf_counter() - start)
    assert min(took_s) < 0.5
    assert all(name in shown and summary in shown for name, summary in COMMANDS.items())
    assert "examples:" in shown


@pytest.mark.parametrize("code", ["import dronevio", "from dronevio.cli import main; main(['--help'])"])
def test_opening_the_door_loads_nothing_heavy(code: str) -> None:
    loaded = python(f"{code}\nimport sys\nprint('loaded:', *sys.modules)")
    assert loaded.returncode == 0, loaded.stderr
    modules = {name.partition(".")[0] for name in loaded.stdout.partition("loaded:")[2].split()}
    assert "dronevio" in modules
    assert not modules & set(HEAVY)


@pytest.mark.parametrize("arguments", [["sing"], ["--sing"], ["Run"]])
def test_unknown_command_is_bad_input(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert repr(arguments[0]) in captured.err and "expected one of run, fly" in captured.err


def test_version_is_that_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"{__version__}\n"


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    try:
        status = main([command, "--help"])
    except SystemExit as leaving:  # tyro leaves by itself
        status = leaving.code
    assert status in (0, None)
    shown = capsys.readouterr().out.lower()
    assert f"dronevio {command}" in shown
    assert "example" in shown


@pytest.mark.parametrize("command", [name for name in COMMANDS if name != "book"])
def test_help_imports_neither_the_simulator_nor_the_plots(command: str) -> None:
    code = f"from dronevio.cli import main\ntry:\n    main([{command!r}, '--help'])\nexcept SystemExit:\n    pass\n"
    loaded = python(f"{code}import sys\nprint('loaded:', *sys.modules)")
    assert loaded.returncode == 0, loaded.stderr
    modules = {name.partition(".")[0] for name in loaded.stdout.partition("loaded:")[2].split()}
    assert not modules & {"gymnasium", "matplotlib", "mujoco", "rerun"}
    if command not in ("run", "estimate", "fly"):  # their options are settings that live beside the code
        assert not modules & {"cv2", "gtsam", "scipy"}


@pytest.mark.parametrize("command", COMMANDS)
def test_wrong_option_is_bad_input(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    try:
        status = main([command, "--no-such-option"])
    except SystemExit as leaving:
        status = leaving.code
    assert status == 2
    captured = capsys.readouterr()
    assert captured.err and not captured.out


def test_examples_of_the_estimating_commands_are_in_order() -> None:
    """Their options are settings of the estimator, which may change their names."""
    readers = {
        EstimateCommand: lambda words: parse(EstimateCommand, words, "estimate"),
        RunCommand: lambda words: parse_flight(RunCommand, words, "run"),
        BenchmarkCommand: lambda words: parse(BenchmarkCommand, words, "benchmark"),
    }
    for command, read in readers.items():
        name = command.__name__.removesuffix("Command").lower()
        lines = [line.strip() for line in (command.__doc__ or "").splitlines()]
        examples = [shlex.split(line)[2:] for line in lines if line.startswith(f"dronevio {name} ")]
        assert len(examples) > 4
        for words in examples:
            assert isinstance(read(words[: words.index(">")] if ">" in words else words), command)


def test_a_reader_that_has_gone_is_no_trouble() -> None:
    command = [sys.executable, "-m", "dronevio.cli", "scenarios", "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        process.stdout.close()
        _, said = process.communicate(timeout=60)
    assert said == ""
    assert process.returncode == 141  # 128 + SIGPIPE, as the shell calls it


def test_what_the_system_refuses_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("in the way")
    assert main(["book", "imu", "--out", str(tmp_path / "file")]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err == f"dronevio: {tmp_path / 'file'}: File exists\n"
