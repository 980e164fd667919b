"""The plain command line takes what tyro takes, and takes it the same way."""

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.cli.evaluate import EvaluateCommand
from dronevio.cli.plain import _NotPlainError, _values, parse_plain, print_plain_table
from dronevio.cli.terminal import print_table


@dataclass(frozen=True)
class Sample:
    """A command of every type of option.

    Examples:
      dronevio sample a
    """

    place: Path
    """A place."""
    name: str
    """A name."""
    choice: Literal["one", "two"] = "one"
    """A choice."""
    count: int | None = None
    """A count."""
    size: float = 1.5
    """A size."""
    many: tuple[float, ...] = ()
    """Many."""
    out: Path | None = None
    """A file."""
    json: bool = False
    """A flag."""


words = st.text("abc123./_", min_size=1, max_size=6)
options = st.one_of(
    st.sampled_from(["--json", "--choice one", "--choice=two", "--many", "--count 7", "--count=-3", "--count None"]),
    st.floats(allow_nan=False).map(lambda x: f"--size {x!r}"),
    st.lists(st.floats(allow_nan=False, allow_infinity=False), max_size=3).map(
        lambda xs: "--many " + " ".join(map(repr, xs))
    ),
    st.one_of(words, st.just("None")).map(lambda word: f"--out {word}"),
    st.sampled_from(["--no-json", "--choice three", "--size x", "--sise 1", "--count 1.5", "-j", "--size", "extra"]),
)


@settings(max_examples=150, deadline=None)
@given(st.tuples(words, words), st.lists(options, max_size=3))
def test_what_it_takes_is_what_tyro_takes(places: tuple[str, str], given_options: list[str]) -> None:
    from dronevio.cli.plain import _name_positionals
    from dronevio.cli.terminal import parse

    arguments = [*places, *(word for option in given_options for word in option.split())]
    try:
        ours = Sample(**_values(Sample, arguments))
    except _NotPlainError:
        return  # tyro will see it
    _name_positionals(Sample)
    assert ours == parse(Sample, arguments, "sample")


def test_options_may_stand_anywhere() -> None:
    expected = Sample(Path("a"), "b", "two", 3, -2.5, (1.0, -2.0), Path("c"), True)
    for line in (
        "a b --choice two --count 3 --size -2.5 --many 1 -2 --out c --json",
        "--choice=two --count=3 --json a b --size=-2.5 --out=c --many 1 -2",
        "a --json b --many 1 -2 --out c --size -2.5 --count 3 --choice two",
    ):
        assert _values(Sample, line.split()) == vars(expected)
        assert parse_plain(Sample, line.split(), "sample") == expected


@pytest.mark.parametrize(
    "line", ["", "a", "a b c", "a b --sise 3", "a b --choice three", "a b --size", "a b --count 1.5", "a b --size x"]
)
def test_mistakes_are_explained_as_ever(line: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        parse_plain(Sample, line.split(), "sample")
    assert caught.value.code == 2
    assert "dronevio sample" in capsys.readouterr().err


def test_help_is_as_ever_and_names_what_is_positional(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        parse_plain(EvaluateCommand, ["--help"], "evaluate")
    assert caught.value.code == 0
    shown = capsys.readouterr().out
    assert "usage: dronevio evaluate [-h] [OPTIONS] TRUTH ESTIMATE" in shown
    assert "--rpe-unit {s,m,deg,frames}" in shown and "dronevio evaluate 00_gt.txt 00_mine.txt --kitti" in shown


def test_tables_look_alike(capsys: pytest.CaptureFixture[str]) -> None:
    table = ("", ("error", "rmse", "unit"), [("ATE, position", "0.1234", "m"), ("orientation", "–", "°")])
    print_plain_table(*table)
    plain = capsys.readouterr().out
    print_table(*table)
    rich = capsys.readouterr().out
    assert [line.strip() for line in plain.splitlines()] == [line.strip() for line in rich.splitlines() if line.strip()]


def test_neither_tyro_nor_rich_is_loaded() -> None:
    code = (
        "import sys; from dronevio.cli.plain import parse_plain; from dronevio.cli.evaluate import EvaluateCommand;"
        "print(parse_plain(EvaluateCommand, ['a', 'b', '--json'], 'evaluate').json, *sys.modules)"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert said[0] == "True" and not {"tyro", "rich", "numpy"} & set(said)
