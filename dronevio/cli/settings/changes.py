"""Changes of settings by ``--set NAME=VALUE`` and ``--settings FILE``."""

import argparse
import dataclasses
import json
import types
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import tyro

from dronevio.cli.imported_settings import field_types
from dronevio.cli.settings.named_fields import NamedField, changed, settings_of, similar_names
from dronevio.cli.settings.option_tables import OPTIONS
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.ranges import NumberField, RangeError, number_fields

STORED_NAMES = {"map": "slam"}
"""Names of groups in the ``configuration.json`` of a run, where they differ from those on the command line."""


@dataclasses.dataclass(frozen=True)
class SettingsOptions:
    """Options that change any setting. An option of a setting itself takes precedence, then --set, then the file."""

    assignments: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(name="set", metavar="NAME=VALUE")
    ] = ()
    """Change any setting, such as estimator.smoother.min-parallax-px=8; may be repeated. `dronevio settings` lists all
    settings with their ranges. The option of a setting takes precedence over --set, and --set over --settings."""
    settings: Path | None = None
    """File with settings: TOML as `dronevio settings` prints it, or the configuration.json or report.json of an earlier
    result, whose settings of these groups are taken."""


SettingsInput = Annotated[SettingsOptions, tyro.conf.arg(name="")]
"""Type of a command's field with these options, which carry no prefix on the command line."""


@dataclasses.dataclass(frozen=True)
class Change:
    """A value of a setting that was asked for."""

    setting: NamedField
    value: Any
    """The value, of the type of the setting."""
    source: str
    """How a message names the setting and where the value is from, such as ``--set wind.gusts``."""


def with_changes(command: type, arguments: Sequence[str], defaults: Mapping[str, object]) -> Mapping[str, object]:
    """Return the defaults of the fields of a command with the changes that its arguments ask for.

    Args:
        command: The dataclass of the command.
        arguments: The words after the command's name.
        defaults: Values of fields that replace the defaults of the dataclass.

    Raises:
        ConfigError: A setting does not exist, or a value is wrong.
        InputError: The file cannot be read.
    """
    if not any(field.default_factory is SettingsOptions for field in dataclasses.fields(command)):
        return defaults
    changes = {change.setting.path: change for change in _asked_for(command, arguments)}
    found = dict(defaults)
    for field in dataclasses.fields(command):
        within = {path[1:]: change for path, change in changes.items() if path[0] == field.name}
        if within:
            assert callable(field.default_factory)
            base = found[field.name] if field.name in found else field.default_factory()
            found[field.name] = _applied(base, within)
    return found


def _applied(settings: Any, changes: Mapping[tuple[str, ...], Change]) -> Any:
    """Return settings with changes.

    Raises:
        ConfigError: A value is out of its range, or values contradict each other.
    """
    try:
        return changed(settings, {path: change.value for path, change in changes.items()})
    except RangeError as error:
        own = [each for each in changes.values() if each.setting.owner is error.settings]
        named = [each.source for each in own if each.setting.path[-1] == error.field]
        raise ConfigError(f"{' or '.join(named)} {error.problem}" if named else str(error)) from None


def _asked_for(command: type, arguments: Sequence[str]) -> list[Change]:
    """Return the changes that arguments ask for, the last of one setting being the one that counts."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--settings", type=Path, default=None)
    try:
        asked = parser.parse_known_args(list(arguments))[0]
    except argparse.ArgumentError as error:
        raise ConfigError(f"{error.argument_name}: {error.message}") from None
    if asked.settings is None and not asked.set:
        return []
    settings = settings_of(command)
    of_file = [] if asked.settings is None else _of_file(command, asked.settings, settings)
    return [*of_file, *(_of_assignment(text, settings) for text in asked.set)]


def _of_assignment(text: str, settings: Mapping[str, NamedField]) -> Change:
    """Return the change of ``NAME=VALUE``."""
    name, equals, value = (part.strip() for part in text.partition("="))
    if not equals:
        raise ConfigError(f"--set {text}: no value; expected NAME=VALUE")
    setting = _named(name, settings, "--set ")
    source = f"--set {setting.name}"
    return Change(setting, _converted(setting, _parsed(setting, value), source), source)


def _of_file(command: type, path: Path, settings: Mapping[str, NamedField]) -> list[Change]:
    """Return the changes of a file."""
    import tomllib  # here, since help texts do not need it

    try:
        text = path.read_text(encoding="utf-8")
        document = _stored(command, path, json.loads(text)) if path.suffix == ".json" else tomllib.loads(text)
    except (tomllib.TOMLDecodeError, json.JSONDecodeError) as error:
        raise InputError(path, f"{error}", f"a {'JSON' if path.suffix == '.json' else 'TOML'} file") from None
    except UnicodeDecodeError:
        raise InputError(path, "bytes that are no UTF-8 text", "a TOML file") from None
    changes = []
    for name, value in _flat(document):
        setting = _named(name, settings, f"{path}: ")
        source = f"{path}: {setting.name}"
        changes.append(Change(setting, _converted(setting, value, source), source))
    return changes


def _stored(command: type, path: Path, document: Any) -> dict[str, Any]:
    """Return the settings of an earlier run that the command has, too, as in a TOML file."""
    configuration = document.get("configuration", document) if isinstance(document, dict) else None
    if not isinstance(configuration, dict) or "dronevio" not in configuration:
        raise InputError(path, "no settings of a run", "its configuration.json, or a TOML file with settings")
    found: dict[str, Any] = {}
    groups = {setting.path[0] for setting in settings_of(command).values()}
    for field in (each for each in dataclasses.fields(command) if each.name in groups):
        stored = configuration.get(STORED_NAMES.get(field.name, field.name))
        if isinstance(stored, dict):
            is_root = OPTIONS in field.metadata and any(
                getattr(each, "name", None) == "" for each in getattr(field.type, "__metadata__", ())
            )
            found |= stored if is_root else {field.name: stored}
    return found


def _flat(document: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """Return the values of nested tables with their dotted names."""
    found: list[tuple[str, Any]] = []
    for name, value in document.items():
        found += _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else [(f"{prefix}{name}", value)]
    return found


def _named(name: str, settings: Mapping[str, NamedField], source: str) -> NamedField:
    """Return the setting of a name, in which underscores may stand for dashes.

    Raises:
        ConfigError: There is none.
    """
    wanted = name.replace("_", "-")
    if wanted in settings:
        return settings[wanted]
    similar = similar_names(wanted, list(settings))
    what = "a group of settings" if any(each.startswith(f"{wanted}.") for each in settings) else "no such setting"
    meant = f"; did you mean {' or '.join(similar)}?" if similar else ""
    raise ConfigError(f"{source}{name}: {what}{meant} (`dronevio settings` lists them)")


def _parsed(setting: NamedField, text: str) -> Any:
    """Return the value that a text on the command line stands for, in the notation of TOML; other text is a string."""
    if _numbers(setting) is None:
        return text.strip("\"'")
    import tomllib

    lower = text.lower()
    if lower == "none":
        return None
    try:
        return tomllib.loads(f"value = {lower}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _converted(setting: NamedField, value: Any, source: str) -> Any:
    """Return a value with the type of a setting; numbers are checked later, when the settings are made.

    Raises:
        ConfigError: The setting has no such value.
    """
    numbers = _numbers(setting)
    if numbers is not None:
        return _as_numbers(numbers, value)
    hint = field_types(setting.owner, with_settings=True)[setting.path[-1]]
    return _as_text(hint, value, source)


def _as_numbers(field: NumberField, value: Any) -> Any:
    """Return whole numbers as floats where these are expected, lists as tuples, and texts such as inf as floats."""
    if isinstance(value, list):
        return tuple(_as_numbers(field, each) for each in value)
    if field.kind is not float or not (type(value) is int or isinstance(value, str)):
        return value
    try:
        return float(value)
    except ValueError:
        return value


def _as_text(hint: Any, value: Any, source: str) -> Any:
    """Return a text, one of several words, or a tuple of texts, as the type of a field demands."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _as_text(arguments[0], value, source)
    if origin is Literal:
        if value not in arguments:
            raise ConfigError(f"{source} {value!r}; expected one of {', '.join(map(str, arguments))}")
        return value
    if origin in (Union, types.UnionType):
        return None if value in (None, "none") else _as_text(arguments[0], value, source)
    if origin is tuple:
        return tuple(_as_text(arguments[0], each, source) for each in (value if isinstance(value, list) else [value]))
    if not isinstance(value, str):
        raise ConfigError(f"{source} {value!r}; expected a text")
    return value


def _numbers(setting: NamedField) -> NumberField | None:
    """Return the description of a setting that holds numbers or truth values; None for others."""
    return next((each for each in number_fields(setting.owner) if each.name == setting.path[-1]), None)
