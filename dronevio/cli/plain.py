"""Command lines and tables without tyro and rich, for a command that is done before the two were imported.

`parse_plain` reads what is in order and leaves the rest, ``--help`` and mistakes included, to tyro, which explains it;
so a command looks the same either way.
"""

import sys
import types
from collections.abc import Sequence
from dataclasses import MISSING, Field, fields
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

Command = TypeVar("Command")

_READ = {Path: Path, float: float, int: int, str: str}


class _NotPlainError(Exception):
    """A command line that tyro should see."""


def parse_plain(command: type[Command], arguments: Sequence[str], name: str) -> Command:
    """Return the dataclass ``command`` filled from the command line, as `terminal.parse` does.

    Fields without a default are positional. Types are paths, numbers, strings, literals of strings, flags, tuples of
    one of these, and any of them or None.
    """
    try:
        values = _values(command, arguments)
    except _NotPlainError:
        from dronevio.cli.terminal import parse

        _name_positionals(command)
        return parse(command, arguments, name)
    return command(**values)


def print_plain_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table on standard output; the first column is left-aligned, the others right."""
    widths = [max(map(len, cells)) for cells in zip(columns, *rows, strict=True)]

    def line(left: str, fill: str, between: str, right: str) -> str:
        return left + between.join(fill * (width + 2) for width in widths) + right

    def row(cells: Sequence[str], edge: str) -> str:
        padded = [f"{c:<{w}}" if i == 0 else f"{c:>{w}}" for i, (c, w) in enumerate(zip(cells, widths, strict=True))]
        return f"{edge} " + f" {edge} ".join(padded) + f" {edge}"

    top = [line("┏", "━", "┳", "┓"), row(columns, "┃"), line("┡", "━", "╇", "┩")]
    lines = [*([title] if title else []), *top, *(row(cells, "│") for cells in rows), line("└", "─", "┴", "┘")]
    sys.stdout.write("\n".join(lines) + "\n")


def _values(command: type[Any], arguments: Sequence[str]) -> dict[str, Any]:
    """Return the values of a dataclass's fields that a command line gives."""
    hints = get_type_hints(command)
    positionals = [field.name for field in _positionals(command)]
    values: dict[str, Any] = {}
    places: list[str] = []
    words = list(arguments)
    while words:
        word = words.pop(0)
        if not word.startswith("-"):
            places.append(word)
            continue
        option, equals, text = word.removeprefix("--").partition("=")
        name = option.replace("-", "_")
        if not word.startswith("--") or "_" in option or name not in hints or name in positionals:
            raise _NotPlainError
        hint = hints[name]
        if hint is bool:
            if equals:
                raise _NotPlainError
            values[name] = True
        elif get_origin(hint) is tuple:
            many = [text] if equals else _taken(words)
            values[name] = tuple(_read(get_args(hint)[0], each) for each in many)
        else:
            if not equals and (not words or words[0].startswith("--")):
                raise _NotPlainError
            values[name] = _read(hint, text if equals else words.pop(0))
    if len(places) != len(positionals):
        raise _NotPlainError
    return values | {name: _read(hints[name], place) for name, place in zip(positionals, places, strict=True)}


def _taken(words: list[str]) -> list[str]:
    """Take the words up to the next option off the front of a list."""
    many = []
    while words and not words[0].startswith("--"):
        many.append(words.pop(0))
    return many


def _read(hint: Any, text: str) -> Any:
    """Return a text as a value of a type."""
    if get_origin(hint) in (Union, types.UnionType):
        wanted = [kind for kind in get_args(hint) if kind is not type(None)]
        if len(wanted) != 1 or text == "None":
            raise _NotPlainError
        return _read(wanted[0], text)
    if get_origin(hint) is Literal:
        if text not in get_args(hint):
            raise _NotPlainError
        return text
    try:
        return _READ[hint](text)
    except (KeyError, ValueError):
        raise _NotPlainError from None


def _positionals(command: type[Any]) -> list[Field[Any]]:
    """Return the fields without a default."""
    return [field for field in fields(command) if field.default is MISSING and field.default_factory is MISSING]


def _name_positionals(command: type[Any]) -> None:
    """Tell tyro which fields are positional, and to call them by their names in capitals."""
    import tyro

    for field in _positionals(command):
        marks = tyro.conf.Positional, tyro.conf.arg(metavar=field.name.upper())
        command.__annotations__[field.name] = Annotated[get_type_hints(command)[field.name], *marks]
