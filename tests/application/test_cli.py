"""The command ``dronevio`` as a whole: help texts, exit codes, imports and error messages."""

import re
import resource
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import tyro

from dronevio import __version__, book
from dronevio.cli import COMMANDS, DEFECT_EXIT_CODE, main
from dronevio.cli.commands import policy, speed
from dronevio.cli.dispatch import CommandGroup

HEAVY = {"cv2", "gtsam", "gymnasium", "matplotlib", "mujoco", "numpy", "rerun", "rich", "scipy", "tyro"}
GROUPS = {"": COMMANDS, "book": book.COMMANDS, "policy": policy.COMMANDS, "speed": speed.COMMANDS}
PROGRAMS = [
    f"{group} {name}".strip()
    for group, commands in GROUPS.items()
    for name in commands.subcommands
    if name not in GROUPS
]
"""The words after ``dronevio`` of every command that is not a group."""


HELP_TEXTS = """
import sys
from dronevio.cli import main
for words in sys.argv[1:]:
    before = set(sys.modules)
    try:
        main([*words.split(), '--help'])
    except SystemExit:
        pass
    print(f'loaded by {words}:', *{name.partition('.')[0] for name in set(sys.modules) - before})
"""
"""Prints the help texts of commands, and after each the packages of which modules have been loaded for it."""
LIGHT = [words for words in PROGRAMS if not words.startswith("book")]


def modules_after(code: str) -> set[str]:
    """Return the names of the packages that are loaded after some code has run in a new interpreter."""
    command = [sys.executable, "-c", f"{code}\nimport sys\nprint('loaded:', *sys.modules)"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    return {name.partition(".")[0] for name in ended.stdout.partition("loaded:")[2].split()}


def help_text(words: str, capsys: pytest.CaptureFixture[str], option: str = "--help") -> str:
    """Return what a command prints with ``--help``, or with another option."""
    with pytest.raises(SystemExit) as ended:
        main([*words.split(), option])
    assert ended.value.code == 0
    return capsys.readouterr().out


def child_cpu_s(*arguments: str) -> float:
    """Return the processor time of a new interpreter [s]."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, *arguments], capture_output=True, text=True, timeout=60, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def test_help_takes_less_than_an_import_of_numpy() -> None:
    """The import takes .1 to .3 s of processor time; half a second is the limit for the help text."""
    help_s = [child_cpu_s("-m", "dronevio.cli", "--help") for _ in range(3)]
    import_s = [child_cpu_s("-c", "import numpy") for _ in range(3)]
    assert min(help_s) < min(import_s)  # measured: a half


@pytest.mark.parametrize("code", ["import dronevio", "from dronevio.cli import main; main(['--help'])"])
def test_package_and_help_load_no_heavy_package(code: str) -> None:
    modules = modules_after(code)
    assert "dronevio" in modules
    assert not modules & HEAVY


@pytest.mark.parametrize("group", GROUPS)
@pytest.mark.parametrize("arguments", [[], ["--help"], ["--help-all"], ["help"]])
def test_groups_list_their_commands(group: str, arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*group.split(), *arguments]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith(f"usage: {' '.join(['dronevio', *group.split()])} COMMAND [OPTIONS]\n")
    for name, command in GROUPS[group].subcommands.items():
        assert re.search(rf"^  {name} +{re.escape(command.summary)}$", printed, re.MULTILINE)


@pytest.mark.parametrize("arguments", [["sing"], ["--sing"], ["Run"], ["speed", "sing"], ["book", "cooking", "--help"]])
def test_unknown_command_is_bad_input(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    group: CommandGroup = GROUPS.get(arguments[0], COMMANDS)
    words = " ".join(arguments[: 2 if arguments[0] in GROUPS else 1])
    expected = f"dronevio: unknown command {words!r}; expected one of {', '.join(group.subcommands)}"
    hint = "; did you mean run?" if arguments == ["Run"] else ""
    assert captured.err.startswith(expected + hint) and captured.err.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("sfm a.mp4 --every ten", "--every 'ten'; expected a whole number"),
        ("explore --task covr", "--task: invalid choice 'covr'; expected one of cover, reach; did you mean cover?"),
        ("convert a b --to openvin", "kimera, mcap, openvins, orbslam3, tum, vins; did you mean openvins?"),
        ("dense house --keep-depth", "--keep-depth; did you mean --keep-depths? "),
        ("sfm a --pose-sigma-m 0.1", "--pose-sigma-m without --poses; expected --poses, too"),
        ("sfm a --poses-of imu --pose-sigma-deg 1", "--poses-of and --pose-sigma-deg without --poses"),
    ],
)
def test_wrong_arguments_are_explained_on_one_line(
    words: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words.split()) == 2
    captured = capsys.readouterr()
    assert message in captured.err and captured.err.count("\n") == 1 and "None" not in captured.err


@pytest.mark.parametrize(("interrupts", "status"), [(True, 130), (False, DEFECT_EXIT_CODE)])
def test_an_error_after_ctrl_c_is_no_defect(
    interrupts: bool, status: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A viewer receives Ctrl-C, too, and what is sent to it then fails."""

    def run(arguments: list[str]) -> int:
        try:
            raise KeyboardInterrupt if interrupts else ValueError
        finally:
            raise RuntimeError("connection severed")

    monkeypatch.setattr("dronevio.cli.COMMANDS", SimpleNamespace(run=run))
    assert main(["scenarios"]) == status
    assert (capsys.readouterr().err == "dronevio: interrupted\n") is interrupts


def test_version_is_that_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"{__version__}\n"


@pytest.mark.parametrize("words", PROGRAMS)
def test_every_command_has_help_with_examples(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    shown = help_text(words, capsys)
    assert shown.startswith(f"usage: dronevio {words} ")
    assert re.search(rf"^Examples:\n  dronevio {words}", shown, re.MULTILINE)


def options_in(shown: str) -> set[str]:
    """Return the options that a help text explains, without ``--``; the boxes have no borders outside of a terminal."""
    return set(re.findall(r"^(?:│ |  )--(\w[\w.-]*)", shown, re.MULTILINE))


class ParsedError(BaseException):
    """Raised in place of the work of a command whose options are valid."""


@pytest.fixture
def parse_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """End every command as soon as its options are parsed."""
    parse: Callable[..., object] = tyro.cli

    def parse_and_stop(*args: Any, **options: Any) -> None:
        parse(*args, **options)
        raise ParsedError

    monkeypatch.setattr(tyro, "cli", parse_and_stop)


@pytest.mark.parametrize("words", PROGRAMS)
def test_examples_in_help_texts_are_valid(words: str, capsys: pytest.CaptureFixture[str], parse_only: None) -> None:
    lines = re.findall(r"^  dronevio (.+)$", help_text(words, capsys), re.MULTILINE)
    assert lines
    for line in lines:
        arguments = shlex.split(re.split(r" > | && ", line)[0])
        with pytest.raises(ParsedError):
            main(arguments)


@pytest.fixture(scope="module")
def loaded() -> dict[str, set[str]]:
    """Packages that the help text of each command loads; later ones find what earlier ones loaded."""
    command = [sys.executable, "-c", HELP_TEXTS, *LIGHT]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    lines = re.findall(r"^loaded by (.+):(.*)$", ended.stdout, re.MULTILINE)
    return {words: set(names.split()) for words, names in lines}


@pytest.mark.parametrize("words", LIGHT)
def test_help_loads_no_heavy_package_but_numpy(words: str, loaded: dict[str, set[str]]) -> None:
    assert set(loaded) == set(LIGHT) and "tyro" in set.union(*loaded.values())
    assert not loaded[words] & {"gymnasium", "matplotlib", "mujoco", "rerun", "rich", "cv2", "gtsam", "scipy"}


@pytest.mark.parametrize("words", ["fly", "run", "estimate", "sfm"])
def test_short_help_names_settings_and_long_help_explains_them(
    words: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "99")
    everything = help_text(words, capsys, "--help-all")
    short, _, groups = help_text(words, capsys).partition("More options, which --help-all explains:\n")
    named = set(re.findall(r"^  --([\w-]+)\.\* +\S", groups, re.MULTILINE))
    explained = options_in(everything)
    assert named == {option.partition(".")[0] for option in explained if "." in option} != set()
    assert options_in(short) == {option for option in explained if "." not in option}
    assert "More options" not in everything


def test_long_help_of_commands_without_settings_is_the_short_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert help_text("benchmark", capsys, "--help-all") == help_text("benchmark", capsys)


@pytest.mark.parametrize("option", ["--help", "--help-all"])
def test_help_shows_the_values_of_the_scenario(
    option: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    shown = help_text("fly --scenario hall-medium --seed 7", capsys, option)
    assert "(default: hall-medium-v0)" in shown
    assert ("(default: 40.0)" in shown) == (option == "--help-all")  # --plan.tour-s


@pytest.mark.parametrize("words", [*PROGRAMS, "book", "policy", "speed"])
def test_unknown_option_is_bad_input(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    try:
        status: object = main([*words.split(), "--no-such-option"])
    except SystemExit as ended:
        status = ended.code
    assert status == 2
    captured = capsys.readouterr()
    assert captured.err and not captured.out


def test_closed_standard_output_ends_the_command_quietly() -> None:
    command = [sys.executable, "-m", "dronevio.cli", "scenarios", "--help"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        process.stdout.close()
        _, errors = process.communicate(timeout=60)
    assert errors == ""
    assert process.returncode == 141  # 128 + SIGPIPE, as shells report it


def test_errors_of_the_system_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("not a folder")
    assert main(["book", "imu", "--out", str(tmp_path / "file")]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err == f"dronevio: {tmp_path / 'file'}: File exists\n"
