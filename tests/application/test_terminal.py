"""Tables and options that all commands share."""

import sys
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest

from dronevio.cli import main
from dronevio.cli.commands.benchmark import print_benchmark
from dronevio.cli.options import Output, OutputOptions, RecordingInput, RecordingOptions
from dronevio.cli.terminal import command_line, parse, print_table, print_values, with_scenario
from dronevio.models.errors import ConfigError
from tests.rows import row_of


@dataclass(frozen=True)
class Command:
    """A command with shared groups of options."""

    size: float = 1.5
    """Size of something that is described at such a length
    that its docstring has a second line [m]."""
    lengths: tuple[float, ...] | None = None
    """Lengths of something [m]."""
    reading: RecordingInput = field(default_factory=RecordingOptions)
    """How the recording is read."""
    output: Output = field(default_factory=OutputOptions)
    """How the result is written and printed."""


def test_first_and_named_columns_are_left_aligned(capsys: pytest.CaptureFixture[str]) -> None:
    print_table("Errors", ("error", "rmse", "unit"), [("ATE", "0.1", "m"), ("orientation", "12.25", "°")], ("unit",))
    assert capsys.readouterr().out == (
        "Errors\n"
        "error         rmse  unit\n"
        "───────────  ─────  ────\n"
        "ATE            0.1  m\n"
        "orientation  12.25  °\n"
        "\n"
    )  # fmt: skip


def test_table_without_title_or_rows_has_headings(capsys: pytest.CaptureFixture[str]) -> None:
    print_values("", ())
    assert capsys.readouterr().out == "  value  unit\n  ─────  ────\n\n"


def use_narrow_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let standard output be a terminal with 40 columns."""
    monkeypatch.setenv("COLUMNS", "40")
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)


def test_last_column_is_broken_between_words_on_a_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    use_narrow_terminal(monkeypatch)
    row = ("easy", "room-easy-v0, corridor-easy-v0, warehouse-easy-v0")
    print_table("", ("name", "scenarios"), [row, ("one", "hover-v0")], ("scenarios",))
    assert capsys.readouterr().out == (
        "name  scenarios\n"
        "────  ──────────────────────────────────\n"
        "easy  room-easy-v0, corridor-easy-v0,\n"
        "      warehouse-easy-v0\n"
        "one   hover-v0\n"
        "\n"
    )  # fmt: skip


def test_numbers_and_short_columns_are_never_broken(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    use_narrow_terminal(monkeypatch)
    print_table("", ("a", "b"), [("x" * 30, "1 2 3 4 5 6 7 8 9")])
    print_table("", ("a", "text"), [("x" * 30, "a text of some length")], ("text",))
    assert capsys.readouterr().out.count("\n") == 2 * 4


def test_lines_outside_of_a_terminal_are_whole(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    print_table("", ("name", "text"), [("a", "word " * 20)], ("text",))
    assert ("word " * 20).strip() in capsys.readouterr().out


def test_benchmark_table_has_one_line_per_estimator(capsys: pytest.CaptureFixture[str]) -> None:
    rows = [
        row_of("short-v0", "room", seed, "vio", "a", "b", "ok", ate_m=0.1 * seed, rpe_m=0.2, cpu_ms_mean=9.0)
        for seed in range(1, 4)
    ]
    print_benchmark(rows)
    table = capsys.readouterr().out.splitlines()[1:-1]
    assert len(table) == 3  # headings, rule, and one estimator on one scenario
    assert table[2].split() == ["short-v0", "vio", "3/3", "0", "0.2", "(0.15–0.25)", "0.2", "(0.2–0.2)", "9.0"]


def test_rows_of_other_lengths_are_refused() -> None:
    with pytest.raises(ValueError, match="argument"):
        print_table("", ("a", "b"), [("1",)])


def test_shared_options_have_no_prefix() -> None:
    words = ["--size", "2", "--cameras", "1", "--calibration", "a", "b", "--topics.imu", "/imu"]
    words += ["--json", "--overwrite"]
    command = parse(Command, words, "test")
    assert command.size == 2.0
    assert (command.reading.cameras, command.reading.calibration) == (("1",), (Path("a"), Path("b")))
    assert command.reading.topics.imu == ("/imu",)
    assert command.output == OutputOptions(json=True, overwrite=True)


def test_defaults_are_those_of_the_dataclass_or_are_replaced() -> None:
    assert parse(Command, [], "test") == Command()
    other = Command(2.5, (1.0, 2.0), RecordingOptions(cameras=("1",)), OutputOptions(json=True))
    assert parse(Command, [], "test", vars(other)) == other
    assert parse(Command, ["--lengths", "4"], "test", vars(other)) == replace(other, lengths=(4.0,))
    assert parse(Command, [], "test", {"size": 2.5}) == Command(2.5)


def test_help_texts_have_no_line_breaks(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit):
        parse(Command, ["--help"], "test")
    shown = capsys.readouterr().out
    assert "Size of something that is described at such a length that its docstring has a second line [m]." in shown
    assert "Print one JSON document instead of tables." in shown  # from the base of `OutputOptions`


def test_wrong_options_are_named_on_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ConfigError, match=r"^--size 'x'; expected a number \(see dronevio test --help\)$"):
        parse(Command, ["--size", "x"], "test")
    assert capsys.readouterr().err == ""  # the command line prints the message


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ([], []),
        (["room", "--seed", "3"], ["--scenario", "room", "--seed", "3"]),
        (["--seed", "3"], ["--seed", "3"]),
        (["--scenario", "room"], ["--scenario", "room"]),
    ],
)
def test_a_first_word_names_the_scenario(words: list[str], expected: list[str]) -> None:
    assert with_scenario(words) == expected


@pytest.mark.parametrize("command", ["run", "fly", "explore"])
def test_flights_take_the_scenario_as_a_word(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([command, "rom"]) == 2
    assert "'rom'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("path", "called", "typed"),
    [("bin", "bin/dronevio", "dronevio"), ("", ".venv/bin/dronevio", ".venv/bin/dronevio"), ("", "pytest", "dronevio")],
)
def test_program_of_a_printed_command_is_found(
    path: str, called: str, typed: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "bin" / "dronevio"
    program.parent.mkdir()
    program.touch(0o755)
    monkeypatch.setenv("PATH", str(tmp_path / path))
    monkeypatch.setattr(sys, "argv", [called])
    assert command_line("view", Path("a run")) == f"{typed} view 'a run'"
