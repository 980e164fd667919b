"""Every number of every settings class has a range, and wrong numbers are refused by the name of their field."""

import importlib
import math
import re
from dataclasses import MISSING, fields, replace
from inspect import isabstract
from pathlib import Path
from typing import Any

import pytest

import dronevio
from dronevio.cli import main
from dronevio.cli.flight_options import FlightOptions
from dronevio.estimator.calibration.config import CalibratedPart
from dronevio.estimator.config import VioConfig
from dronevio.models.battery import Battery
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError
from dronevio.models.quadrotor import RESEARCH
from dronevio.models.ranges import FINITE, NumberField, RangeError, Settings, number_fields
from dronevio.models.rig import EUROC_CAM0, Rig, RigCamera, euroc_rig
from dronevio.models.rotors import Rotor
from dronevio.sim.envs.settings import EnvironmentSettings, settings_of
from dronevio.sim.paths.plan import FlightPlan
from dronevio.sim.physics.rotors import MotorFailure
from dronevio.sim.scenarios import scenario_named

PACKAGE = Path(dronevio.__file__).parent
WRONG = (-1, 0, math.nan, math.inf, 1_000_000_000)
EXAMPLES: dict[type, Any] = {
    CalibratedPart: VioConfig().calibration.gravity,
    Battery: RESEARCH.battery,
    CameraModel: EUROC_CAM0,
    RigCamera: euroc_rig().cameras[0],
    Rig: euroc_rig(),
    EnvironmentSettings: settings_of(),
    MotorFailure: MotorFailure(0, 1.0),
    Rotor: Rotor((0.1, 0.1, 0.0), "cw"),
    FlightPlan: FlightPlan(shape="hover"),
    FlightOptions: FlightOptions.of(scenario_named("hover")),
}
"""Settings of classes whose default values are not settings on their own."""


def settings_classes() -> list[type]:
    """Return all settings classes that can be instantiated, sorted by name."""
    for folder in ("models", "estimator", "sim", "eval", "autonomy", "cli", "book"):
        for file in sorted((PACKAGE / folder).rglob("*.py")):
            if re.search(r"\(Settings\)|\(Navigate\)", file.read_text(encoding="utf-8")):
                importlib.import_module(".".join(("dronevio", *file.relative_to(PACKAGE).with_suffix("").parts)))
    found, queue = set(), [Settings]
    while queue:
        for kind in queue.pop().__subclasses__():
            if kind.__module__.startswith("dronevio.") and kind not in found:
                found.add(kind)
                queue.append(kind)
    concrete = [kind for kind in found if not isabstract(kind)]
    return sorted(concrete, key=lambda kind: (kind.__module__, kind.__name__))


CLASSES = settings_classes()


def example(kind: type) -> Any:
    """Return valid settings of a class: its defaults, with a path for each field without one."""
    if kind in EXAMPLES:
        return EXAMPLES[kind]
    needed = [field.name for field in fields(kind) if field.default is MISSING and field.default_factory is MISSING]
    return kind(**dict.fromkeys(needed, Path("x")))


def filled(field: NumberField, value: object, settings: Any) -> object:
    """Return a value of a field in which all numbers are the given one."""
    if not field.many:
        return value
    return (value,) * (field.count or len(getattr(settings, field.name) or (0,)))


def test_there_are_settings_in_all_packages() -> None:
    packages = {kind.__module__.split(".")[1] for kind in CLASSES}
    assert packages == {"models", "estimator", "sim", "eval", "autonomy", "cli", "book"} and len(CLASSES) > 70


@pytest.mark.parametrize("kind", CLASSES, ids=lambda kind: kind.__name__)
def test_every_number_has_a_range(kind: type) -> None:
    missing = [field.name for field in number_fields(kind) if field.kind is not bool and not field.declared]
    assert not missing


@pytest.mark.parametrize("kind", CLASSES, ids=lambda kind: kind.__name__)
def test_wrong_numbers_are_refused_by_name(kind: type) -> None:
    """Each of the five values is within the declared range of the field, or refused; NaN always is."""
    settings = example(kind)
    for field in number_fields(kind):
        if field.kind is bool:
            continue
        for value in WRONG:
            number = value if field.kind is int or isinstance(value, float) else float(value)
            wrong_type = field.kind is int and isinstance(number, float)
            try:
                changed = replace(settings, **{field.name: filled(field, number, settings)})
            except RangeError as error:
                assert error.settings is kind or number in field.range
                assert f".{error.field} = " in str(error) and "; expected " in str(error)
                assert error.field == field.name or number in field.range
            except ConfigError:
                assert number in field.range and not wrong_type  # a condition between several settings
            else:
                assert number in field.range and not wrong_type and not math.isnan(number)
                assert getattr(changed, field.name) is not None


@pytest.mark.parametrize("kind", CLASSES, ids=lambda kind: kind.__name__)
def test_defaults_are_not_at_the_ends_of_nothing(kind: type) -> None:
    """A range allows more than one value, and an integer range has whole ends."""
    for field in number_fields(kind):
        allowed = field.range
        if field.kind is bool or allowed == FINITE:
            continue
        low = allowed.low if allowed.low is not None else allowed.above
        high = allowed.high if allowed.high is not None else allowed.below
        assert low is None or high is None or low < high
        if field.kind is int:
            assert all(end is None or end == int(end) for end in (low, high))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("estimate x --estimator.smoother.max-keyframes 0", "--estimator.smoother.max-keyframes 0; expected a whole"),
        ("estimate x --estimator.smoother.max-keyframes 1", "--estimator.smoother.max-keyframes 1; expected a whole"),
        ("estimate x --estimator.tracker.corners.cell-px 0", "--estimator.tracker.corners.cell-px 0; expected a whole"),
        ("estimate x --estimator.tracker.window-px 0", "--estimator.tracker.window-px 0; expected an odd number"),
        ("estimate x --estimator.tracker.window-px 4", "--estimator.tracker.window-px 4; expected an odd number"),
        ("estimate x --estimator.tracker.window-px 100000", "window-px 100000; expected an odd number, 5 to 41"),
        ("estimate x --estimator.tracker.pyramid-levels -1", "--estimator.tracker.pyramid-levels -1; expected"),
        ("estimate x --estimator.health.max-inertial-sigma-m -1", "max-inertial-sigma-m -1.0; expected a number, more"),
        ("estimate x --estimator.preintegration.accel-noise-inflation -1", "accel-noise-inflation -1.0; expected"),
        (
            "estimate x --set estimator.tracker.min-tracked-ratio=nan",
            "--set estimator.tracker.min-tracked-ratio nan; exp",
        ),
        (
            "estimate x --set estimator.initialization.dynamic-sigmas.tilt-rad=0",
            "dronevio: --set estimator.initialization.dynamic-sigmas.tilt-rad 0.0; expected",
        ),
        ("fly --wind.mean-m-s 1 2 nan", "--wind.mean-m-s (1.0, 2.0, nan); expected 3 numbers, each -50 to 50"),
        ("fly --scenario", "dronevio: --scenario: expected one argument"),
    ],
)
def test_options_outside_their_range_are_one_line(words: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words.split()) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1
    assert message in captured.err


def test_help_shows_the_range(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "99")
    with pytest.raises(SystemExit):
        main(["estimate", "--help-all"])
    shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "Number of keyframes in the window. Allowed: 3 to 40. When to change it: accuracy counts" in shown
    assert "(decrease). (default: 9)" in shown
