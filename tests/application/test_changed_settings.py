"""Settings that are options, and the change of all others by ``--set`` and ``--settings``."""

import functools
import json
import re
import tomllib
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, get_args

import pytest

from dronevio.cli import main
from dronevio.cli.commands.dense import DenseCommand
from dronevio.cli.commands.estimate import EstimateCommand
from dronevio.cli.commands.explore import ExploreCommand
from dronevio.cli.commands.map import MapCommand
from dronevio.cli.commands.run import RunCommand
from dronevio.cli.commands.settings import Name, command_named
from dronevio.cli.commands.sfm import SfmCommand
from dronevio.cli.flight_options import parse_flight
from dronevio.cli.imported_settings import field_types
from dronevio.cli.settings.listing import listed_settings
from dronevio.cli.settings.named_fields import NamedField, changed, named_fields, settings_of
from dronevio.cli.settings.option_tables import DENSE, DENSE_MAP, ESTIMATOR, EXPLORE, MAP, SFM, OptionTable
from dronevio.cli.terminal import parse
from dronevio.estimator.config import VioConfig
from dronevio.estimator.slam.config import SlamConfig
from dronevio.models.ranges import NumberField, number_fields
from dronevio.models.serialization import to_jsonable

GUIDE = Path(__file__).resolve().parents[2] / "docs" / "how-to" / "tune.md"
GROUPS: tuple[tuple[type, str, OptionTable, int], ...] = (
    (EstimateCommand, "estimator", ESTIMATOR, 25),
    (EstimateCommand, "map", MAP, 10),
    (SfmCommand, "sfm", SFM, 10),
    (DenseCommand, "dense", DENSE, 10),
    (MapCommand, "dense", DENSE_MAP, 3),
    (ExploreCommand, "pilot", EXPLORE, 6),
)
"""Command and field of each group of settings with a table of options, and the largest number of options."""
NEEDED = {EstimateCommand: "recording", SfmCommand: "images", DenseCommand: "scene", MapCommand: "recording"}


def parsed(command: type, *words: str) -> Any:
    """Return a command with a positional argument where it needs one."""
    needed = (NEEDED[command],) if command in NEEDED else ()
    return parse(command, [*needed, *words], "x")


def estimator(*words: str) -> VioConfig:
    """Return the settings of the odometry by the arguments of ``dronevio estimate``."""
    config = parsed(EstimateCommand, *words).estimator
    assert isinstance(config, VioConfig)
    return config


def error_of(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """Return the line that a wrong command prints."""
    assert main(list(words)) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1 and captured.err.startswith("dronevio: ")
    return captured.err.removeprefix("dronevio: ").strip()


def numbers_of(setting: NamedField) -> NumberField | None:
    """Return the description of a setting that holds numbers."""
    return next((each for each in number_fields(setting.owner) if each.name == setting.path[-1]), None)


def other_value(setting: NamedField, value: Any) -> Any:
    """Return an allowed value that differs from the default."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, str):
        kind = field_types(setting.owner, with_settings=True)[setting.path[-1]]
        return next(each for each in get_args(kind) if each != value)
    numbers = numbers_of(setting)
    assert numbers is not None
    if isinstance(value, tuple):
        return tuple(other_value(setting, each) for each in value)
    candidates = (value + 1, value - 1, value + 2) if numbers.kind is int else (value * 1.25, value * 0.75, 0.5, 0.0)
    return next(each for each in candidates if each != value and each in numbers.range)


def option_word(setting: NamedField, value: Any) -> str:
    """Return the option that gives a setting a value."""
    if not isinstance(value, bool):
        return f"--{setting.name}={value}"
    above, _, last = setting.name.rpartition(".")
    return f"--{above}{'.' if above else ''}{'' if value else 'no-'}{last}"


@pytest.mark.parametrize(
    ("command", "group", "table", "most"),
    GROUPS,
    ids=[f"{command.__name__}-{group}" for command, group, _, _ in GROUPS],
)
def test_few_settings_are_options(command: type, group: str, table: OptionTable, most: int) -> None:
    of_group = [each for each in named_fields(command) if each.path[0] == group]
    options = {each.name.removeprefix(f"{group}.") for each in of_group if each.is_option}
    assert options == set(table) and len(table) <= most
    assert len(of_group) > (len(table) if table is DENSE_MAP else 2 * len(table))  # most settings are none


def test_run_has_at_most_120_options(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"COLUMNS": "99", "NO_COLOR": "1", "TERM": "dumb"}.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(SystemExit):
        main(["run", "--help-all"])
    shown = re.findall(r"^\W*(?:-\w, )?--[a-z][\w.-]+", capsys.readouterr().out, re.MULTILINE)
    assert 90 < len(shown) <= 120


@pytest.mark.skipif(not GUIDE.is_file(), reason="not a checkout")
def test_the_guide_has_the_tables_of_options() -> None:
    rows = re.findall(r"^\| `--([\w.-]+)` \| (.*) \| (.*) \|$", GUIDE.read_text(encoding="utf-8"), re.MULTILINE)
    defaults = {
        each.field.name: each.toml for command in (*NEEDED, ExploreCommand) for each in listed_settings(command)
    }
    expected = [
        (prefix + name, f"`{defaults[prefix + name]}`", when)
        for prefix, table in (
            ("estimator.", ESTIMATOR),
            ("map.", MAP),
            ("", SFM),
            ("", DENSE),
            ("", DENSE_MAP),
            ("pilot.", EXPLORE),
        )
        for name, when in table.items()
    ]
    same = "threads"  # of sfm and of dense
    assert [row for row in rows if row[0] != same] == [row for row in expected if row[0] != same]
    assert sum(row[0] == same for row in rows) == 2


@pytest.mark.parametrize(("command", "group"), [(command, group) for command, group, _, _ in GROUPS])
def test_every_option_and_every_setting_arrives(command: type, group: str) -> None:
    """All settings of a group have other values by --set, and all options by themselves."""
    of_group = [each for each in settings_of(command).values() if each.path[0] == group]
    default = getattr(parsed(command), group)
    new = {each: other_value(each, functools.reduce(getattr, each.path[1:], default)) for each in of_group}
    words = [f"{each.name}={value if isinstance(value, str) else json.dumps(value)}" for each, value in new.items()]
    found = getattr(parsed(command, *(f"--set={word}" for word in words)), group)
    assert found == changed(default, {each.path[1:]: value for each, value in new.items()})
    assert all(functools.reduce(getattr, each.path[1:], found) == value for each, value in new.items())

    options = {each: value for each, value in new.items() if each.is_option}
    found = getattr(parsed(command, *(option_word(each, value) for each, value in options.items())), group)
    assert found == changed(default, {each.path[1:]: value for each, value in options.items()}) != default


def test_listed_settings_are_a_file_of_settings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Without the number sign before each setting, the list is a file that changes nothing."""
    for name in get_args(Name):
        assert main(["settings", "--of", name]) == 0
        text = re.sub(r"^#(?=\S)", "", capsys.readouterr().out, flags=re.MULTILINE)
        file = tmp_path / f"{name}.toml"
        file.write_text(text, encoding="utf-8")
        command, defaults = command_named(name)
        is_flight = name in ("run", "fly")
        read = parse_flight(command, ["--settings", str(file)], name) if is_flight else None
        assert tomllib.loads(text)
        for group in {each.path[0] for each in settings_of(command).values()}:
            found = getattr(read or parsed(command, "--settings", str(file)), group)
            field = next(each for each in fields(command) if each.name == group)
            assert callable(field.default_factory)
            assert found == (defaults[group] if group in defaults else field.default_factory())


def test_settings_are_listed_by_parts_of_their_names(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["settings", "min_parallax_px", "max-keyframes"]) == 0
    shown = re.findall(r"^#(\S+) = (.*)$", capsys.readouterr().out, re.MULTILINE)
    assert ("estimator.smoother.min-parallax-px", "5.0") in shown
    assert all("max-keyframes" in name or "min-parallax-px" in name for name, _ in shown)
    assert error_of(capsys, "settings", "nonsense") == "no setting of run has nonsense in its name"


def test_options_precede_set_and_set_precedes_the_file(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text("[estimator.smoother]\nmax-keyframes = 5\niterations = 4\nmin_parallax_px = 7\n", encoding="utf-8")
    name = "estimator.smoother.max-keyframes"
    of_file = estimator("--settings", str(file)).smoother
    assert (of_file.max_keyframes, of_file.iterations, of_file.min_parallax_px) == (5, 4, 7.0)
    assert isinstance(of_file.min_parallax_px, float)
    of_set = estimator("--set", f"{name}=6", "--settings", str(file)).smoother
    assert (of_set.max_keyframes, of_set.iterations) == (6, 4)
    assert estimator("--set", f"{name}=6", f"--set={name}=7").smoother.max_keyframes == 7
    of_option = estimator(f"--{name}", "8", "--set", f"{name}=6", "--settings", str(file)).smoother
    assert of_option == replace(of_file, max_keyframes=8)


def test_settings_of_a_flight_keep_those_of_its_scenario() -> None:
    words = ["--scenario", "hall-medium", "--set", "plan.laps=2", "--set", "wind.mean_m_s=[1, 2, 0.5]"]
    flight = parse_flight(RunCommand, words, "run").flight
    default = parse_flight(RunCommand, words[:2], "run").flight
    assert flight.plan == replace(default.plan, laps=2) and flight.wind.mean_m_s == (1.0, 2.0, 0.5)
    assert replace(flight, plan=default.plan, wind=default.wind) == default


def test_settings_of_an_earlier_run_are_read(tmp_path: Path) -> None:
    config = changed(VioConfig(), {("smoother", "iterations"): 3, ("health", "max_speed_m_s"): float("inf")})
    map_config = changed(SlamConfig(), {("worker",): False})
    document = {
        "dronevio": "1.0",
        "scenario": {"name": "room"},
        "estimator": to_jsonable(config),
        "slam": to_jsonable(map_config),
    }
    file = tmp_path / "configuration.json"
    file.write_text(json.dumps(document), encoding="utf-8")
    command = parsed(EstimateCommand, "--settings", str(file))
    assert (command.estimator, command.map) == (config, map_config)
    sfm = replace(SfmCommand(Path("x")).sfm, threads=5)
    file.write_text(json.dumps({"configuration": {"dronevio": "1.0", "sfm": to_jsonable(sfm)}}), encoding="utf-8")
    assert parsed(SfmCommand, "--settings", str(file)).sfm == sfm
    file.write_text(json.dumps({**document, "slam": None}), encoding="utf-8")
    assert parsed(EstimateCommand, "--settings", str(file)).map == SlamConfig()


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("estimator.smoother.iterations=0", "--set estimator.smoother.iterations 0; expected a whole number, 1 to 20"),
        ("estimator.smoother.iterations=2.5", "estimator.smoother.iterations 2.5; expected a whole number, 1 to 20"),
        ("estimator.smoother.iterations=two", "estimator.smoother.iterations 'two'; expected a whole number, 1 to 20"),
        ("estimator.stamps.correct=1", "estimator.stamps.correct 1; expected True or False"),
        ("estimator.tracker.patches.scales=3", "estimator.tracker.patches.scales 3.0; expected numbers, each 1 to 10"),
        ("estimator.smoother.iterations", "--set estimator.smoother.iterations: no value; expected NAME=VALUE"),
        (
            "estimator.smoother.iteration=3",
            "--set estimator.smoother.iteration: no such setting; did you mean estimator.smoother.iterations",
        ),
        (
            "min-parallax-px=3",
            "min-parallax-px: no such setting; did you mean estimator.smoother.min-parallax-px?",
        ),
        (
            "estimator.smoother=3",
            "smoother: a group of settings; did you mean estimator.smoother.max-keyframes",
        ),
        ("out=3", "--set out: no such setting"),
    ],
)
def test_wrong_assignments_are_one_line(assignment: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert message in error_of(capsys, "estimate", "recording", "--set", assignment)


def test_words_of_a_setting_are_checked(capsys: pytest.CaptureFixture[str]) -> None:
    found = error_of(capsys, "sfm", "x", "--set", "pairs.method=some")
    assert found == "--set pairs.method 'some'; expected one of automatic, exhaustive, sequential, retrieval"


def test_settings_that_are_no_options_name_what_to_type(capsys: pytest.CaptureFixture[str]) -> None:
    found = error_of(capsys, "estimate", "x", "--estimator.smoother.min_parallax_px", "8")
    name = "estimator.smoother.min-parallax-px"
    assert found == f"--{name} is a setting, but no option; expected --set {name}=VALUE"
    found = error_of(capsys, "estimate", "x", "--estimator.stamps.no-correct")
    assert found.endswith("expected --set estimator.stamps.correct=false")
    assert "Unrecognized" in error_of(capsys, "evaluate", "x", "y", "--set", "a=1")


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        (
            "a.toml",
            "[estimator.smoother]\niterations = 0\n",
            "a.toml: estimator.smoother.iterations 0; expected a",
        ),
        (
            "a.toml",
            "[estimator.smoother]\niteration = 3\n",
            "a.toml: estimator.smoother.iteration: no such setting",
        ),
        ("a.toml", "[estimator\n", "a.toml: Expected ']'"),
        ("a.json", "{", "a.json: Expecting property name"),
        ("a.json", '{"estimator": {}}', "a.json: no settings of a run; expected its configuration.json"),
        ("b.toml", None, "b.toml: No such file or directory"),
    ],
)
def test_wrong_files_are_one_line(
    name: str, text: str | None, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if text is not None:
        (tmp_path / name).write_text(text, encoding="utf-8")
    assert message in error_of(capsys, "estimate", "recording", "--settings", str(tmp_path / name))
