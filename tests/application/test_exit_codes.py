"""Exit codes of errors: 2 for wrong input, 70 for a defect in dronevio, with what to report."""

import importlib
from collections.abc import Callable, Sequence
from typing import Any

import pytest

from dronevio import __version__
from dronevio.cli import main
from dronevio.models.errors import ConfigError, DefectError, IncompleteError

Result = Any  # the class of conftest, which cannot be imported


def failing(error: BaseException) -> type:
    """Return a module of a command that raises an error."""

    class Module:
        @staticmethod
        def main(arguments: Sequence[str]) -> int:
            raise error

    return Module


def incomplete() -> IncompleteError:
    """Return the error of a recording that is incomplete because a worker died."""
    error = IncompleteError("stopped after 3 of 9 frames: a rendering process was killed by SIGSEGV")
    error.__cause__ = DefectError("a rendering process was killed by SIGSEGV")
    return error


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (ConfigError("no such thing"), 2, "dronevio: no such thing\n"),
        (OSError(28, "No space left on device", "a.png"), 2, "dronevio: a.png: No space left on device\n"),
        (MemoryError("3.2 GiB"), 2, "dronevio: not enough memory: 3.2 GiB\n"),
        (KeyboardInterrupt(), 130, "dronevio: interrupted\n"),
        (IndexError("index 3\nis out of bounds"), 70, "IndexError: index 3 is out of bounds"),
        (AssertionError(), 70, "AssertionError"),
        (DefectError("a rendering process was killed by SIGSEGV"), 70, "a rendering process was killed by SIGSEGV"),
        (incomplete(), 70, "stopped after 3 of 9 frames: a rendering process was killed by SIGSEGV"),
    ],
)
def test_errors_have_their_exit_codes(
    error: BaseException,
    code: int,
    message: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(importlib, "import_module", lambda name: failing(error))
    assert main(["estimate", "a b"]) == code
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1
    if code != 70:
        assert captured.err == message
        return
    assert captured.err.startswith(f"dronevio: a defect in dronevio: {message}")
    assert "please report this line, the traceback, which --debug shows" in captured.err
    assert "`dronevio estimate 'a b'`" in captured.err and __version__ in captured.err


@pytest.mark.parametrize("words", [["--debug", "estimate", "x"], ["estimate", "x", "--debug"]])
def test_debug_shows_the_traceback_of_a_defect(
    words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(importlib, "import_module", lambda name: failing(IndexError("index 3")))
    assert main(words) == 70
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("Traceback") and lines[-2] == "IndexError: index 3"
    assert lines[-1].startswith("dronevio: a defect in dronevio: IndexError: index 3; please report this line")


def test_bad_inputs_are_one_line_and_exit_code_2(
    script: Callable[[str], Any], flown: Result, capsys: pytest.CaptureFixture[str]
) -> None:
    """A part of the table of the script, which has more than 60 rows."""
    bad_inputs = script("bad_inputs")
    cases = bad_inputs.cases()
    assert len(cases) > 60 and len({case.name for case in cases}) == len(cases)
    words = ("max-keyframes", "seed", "PNG", "IMU file", "estimate with", "nothing --port", "bag", "sensor.yaml")
    chosen = [case for case in cases if any(word in case.name for word in words)]
    assert len(chosen) > 12
    for answer in bad_inputs.answers(flown.folder, chosen):
        assert answer.is_right, (answer.case.name, answer.code, answer.err, answer.left)
    assert bad_inputs.main(bad_inputs.BadInputsCommand(flown.folder, ("sing", "laps"))) == 0
    assert "| `sing` | 2 | unknown command 'sing'; expected one of run, " in capsys.readouterr().out


def test_bad_answers_are_found(script: Callable[[str], Any], flown: Result, capsys: pytest.CaptureFixture[str]) -> None:
    bad_inputs = script("bad_inputs")
    good = bad_inputs.Case("version", ("--version",))
    assert not next(bad_inputs.answers(flown.folder, [good])).is_right
    capsys.readouterr()


@pytest.mark.slow
def test_extreme_settings_survive_or_are_refused(
    script: Callable[[str], Any], flown: Result, capsys: pytest.CaptureFixture[str]
) -> None:
    """A sample of the script, which takes minutes for all settings."""
    fuzz = script("settings_fuzz")
    command = fuzz.FuzzCommand(flown.folder, ("smoother.max_keyframes", "tracker.pyramid_levels"), from_s=1.0)
    assert fuzz.main(command) == 0
    assert "2 settings: 9 values refused, 4 accepted, of which 0 failed" in capsys.readouterr().out
