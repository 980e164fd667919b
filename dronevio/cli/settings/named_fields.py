"""The fields of a command and of the settings in it, by their names on the command line."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Annotated, Any, get_args, get_origin

from dronevio.cli.imported_settings import field_types
from dronevio.cli.settings.option_tables import OPTIONS

MAX_SUGGESTIONS = 3
"""Number of similar names that a message proposes."""


@dataclasses.dataclass(frozen=True)
class NamedField:
    """A field of a command, or of the settings in it, that holds a value."""

    name: str
    """Name on the command line, without the dashes before it: ``estimator.smoother.max-keyframes``."""
    path: tuple[str, ...]
    """Names of the fields that lead to it from the command."""
    owner: type
    """The dataclass that it belongs to."""
    is_setting: bool
    """Whether it belongs to a group of settings, which ``--set`` and ``--settings`` change."""
    is_option: bool
    """Whether it is an option."""
    when: str
    """When to change it; empty if that is not told."""


@cache
def named_fields(command: type) -> tuple[NamedField, ...]:
    """Return all fields of a command, in the order of the help text."""
    return tuple(_fields(command, "", (), is_setting=False, table=None))


def settings_of(command: type) -> dict[str, NamedField]:
    """Return the settings of a command by their names."""
    return {field.name: field for field in named_fields(command) if field.is_setting}


def _fields(
    owner: type, prefix: str, path: tuple[str, ...], is_setting: bool, table: Mapping[str, str] | None
) -> Iterator[NamedField]:
    """Yield the fields in a dataclass.

    Args:
        owner: The dataclass.
        prefix: Name of the dataclass on the command line, with a point at the end, or nothing.
        path: Names of the fields that lead to it.
        is_setting: Whether it is a group of settings.
        table: The options in it by their names relative to it, and when to change them; None if all are options.
    """
    hints = field_types(owner, with_settings=True)
    for field in dataclasses.fields(owner):
        hint = hints[field.name]
        kind, *metadata = get_args(hint) if get_origin(hint) is Annotated else [hint]
        word = next((name for each in metadata if (name := getattr(each, "name", None)) is not None), field.name)
        word = word.replace("_", "-")
        inner = (*path, field.name)
        if dataclasses.is_dataclass(kind) and isinstance(kind, type):
            own = field.metadata.get(OPTIONS)
            within = own if own is not None else _within(table, word)
            is_group = is_setting or own is not None or bool(word)
            yield from _fields(kind, f"{prefix}{word}." if word else prefix, inner, is_group, within)
        else:
            when = "" if table is None else table.get(word, "")
            yield NamedField(f"{prefix}{word}", inner, owner, is_setting, table is None or bool(when), when)


def _within(table: Mapping[str, str] | None, word: str) -> Mapping[str, str] | None:
    """Return the part of a table of options that concerns a group in the group of the table."""
    if table is None:
        return None
    return {name.removeprefix(f"{word}."): when for name, when in table.items() if name.startswith(f"{word}.")}


def similar_names(name: str, names: Sequence[str]) -> list[str]:
    """Return the names that somebody who typed another one may have meant, the most probable first."""
    from difflib import get_close_matches

    last = name.rpartition(".")[2]
    within = [each for each in names if each.startswith(f"{name}.")]
    ends = [each for each in names if each.rpartition(".")[2] == last]
    return list(dict.fromkeys([*within, *ends, *get_close_matches(name, names, MAX_SUGGESTIONS)]))[:MAX_SUGGESTIONS]


def changed(settings: Any, values: Mapping[tuple[str, ...], Any]) -> Any:
    """Return a dataclass with other values, those of one dataclass at once.

    Args:
        settings: The dataclass.
        values: The values by the names of the fields that lead to them.

    Raises:
        RangeError: A value is outside its range.
        ConfigError: Values contradict each other.
    """
    own: dict[str, Any] = {path[0]: value for path, value in values.items() if len(path) == 1}
    for name in dict.fromkeys(path[0] for path in values if len(path) > 1):
        own[name] = changed(getattr(settings, name), {p[1:]: v for p, v in values.items() if p[0] == name})
    return dataclasses.replace(settings, **own)
