"""How tyro makes options of the fields of a dataclass.

A field of a command that is a dataclass itself is a group of settings, whose options have a prefix such as ``--plan.``.
The short help text names only the groups, so that settings need not be imported for it.

Tyro's own rule has two disadvantages here. It keeps the line breaks of an indented field docstring, so that help texts
are broken in the middle of sentences. On Python 3.11 to 3.13, it checks the default of an optional field with
typeguard, whose import takes 0.08 s, a fifth of the processor time of ``dronevio evaluate``.
"""

import ast
import dataclasses
import functools
import inspect
import textwrap
import types
from collections.abc import Mapping
from functools import cache, partial
from typing import Annotated, Any, Union, get_args, get_origin

import tyro
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructFieldSpec, StructTypeInfo

from dronevio.cli.imported_settings import ImportedSettings, field_types
from dronevio.cli.settings.named_fields import changed
from dronevio.cli.settings.option_tables import OPTIONS, OptionTable
from dronevio.cli.usage import allowed


def registry(command: type, defaults: Mapping[str, object], with_settings: bool) -> ConstructorRegistry:
    """Return the registry for `tyro.cli` with the rule of this module.

    Args:
        command: The dataclass of the command.
        defaults: Values of fields of the command that replace the defaults of the dataclass.
        with_settings: Whether groups of settings become options.
    """
    constructors = ConstructorRegistry()
    tables = _option_tables(command, with_settings)

    @constructors.struct_rule
    def dataclass_rule(info: StructTypeInfo) -> StructConstructorSpec | None:
        if not dataclasses.is_dataclass(info.type):
            return None
        if info.type in tables:
            return _table_spec(info.type, tables[info.type], info.default, with_settings)
        replaced = defaults if info.type is command else {}
        hints = field_types(info.type, with_settings)
        fields = [
            StructFieldSpec(
                field.name,
                _with_none_first(hints[field.name]),
                replaced[field.name] if field.name in replaced else _default(field, info.default),
                partial(help_text, info.type, field.name),
            )
            for field in dataclasses.fields(info.type)
            if with_settings or not _is_group(field, hints[field.name])
        ]
        return StructConstructorSpec(info.type, tuple(fields))

    return constructors


def _option_tables(command: type, with_settings: bool) -> dict[type, OptionTable]:
    """Return the options of the groups of settings of which only some settings are options, by their classes."""
    fields = [field for field in dataclasses.fields(command) if OPTIONS in field.metadata]
    hints = field_types(command, with_settings)
    return {_without_annotation(hints[field.name]): field.metadata[OPTIONS] for field in fields}


def _table_spec(group: type, table: OptionTable, of_command: Any, with_settings: bool) -> StructConstructorSpec:
    """Return how tyro makes a group of settings of those that are options; all others keep their values.

    Args:
        group: The class of the settings.
        table: The options, by names relative to the group.
        of_command: The settings to which the options are applied; missing for those of the class.
        with_settings: Whether options in groups of these settings are made, too.
    """
    settings = group() if of_command in (tyro.MISSING, tyro.MISSING_NONPROP) else of_command
    fields = {}
    for name in (each for each in table if with_settings or "." not in each):
        *above, last = path = tuple(name.replace("-", "_").split("."))
        owner = functools.reduce(getattr, above, settings)
        hint = field_types(type(owner), with_settings=True)[last]
        helptext = partial(_option_text, type(owner), last, table[name])
        fields[path] = StructFieldSpec(name, _with_none_first(hint), getattr(owner, last), helptext)

    def made(**values: Any) -> Any:
        return changed(settings, {path: values[field.name] for path, field in fields.items()})

    return StructConstructorSpec(made, tuple(fields.values()))


def _option_text(owner: type, name: str, when: str) -> str:
    """Return the help text of a setting that is an option, and when to change it."""
    return f"{help_text(owner, name)} When to change it: {when[0].lower()}{when[1:]}"


def settings_groups(command: type) -> dict[str, str]:
    """Return the groups of settings of a command: the prefix of their options, and what they are."""
    groups: dict[str, str] = {}
    hints = field_types(command, with_settings=False)
    for field in dataclasses.fields(command):
        kind = _without_annotation(hints[field.name])
        if _is_group(field, hints[field.name]):
            groups[field.name.replace("_", "-")] = help_text(command, field.name) or ""
        elif dataclasses.is_dataclass(kind):
            assert isinstance(kind, type)
            table = field.metadata.get(OPTIONS)
            groups |= {
                name: text
                for name, text in settings_groups(kind).items()
                if table is None or any(option.startswith(f"{name}.") for option in table)
            }
    return groups


def _is_group(field: dataclasses.Field[Any], hint: Any) -> bool:
    """Return whether a field is a group of settings: of a dataclass, whose options have a prefix."""
    if isinstance(field.default_factory, ImportedSettings):
        return True
    if not dataclasses.is_dataclass(_without_annotation(hint)):
        return False
    return all(getattr(annotation, "name", None) != "" for annotation in getattr(hint, "__metadata__", ()))


def _without_annotation(hint: Any) -> Any:
    """Return a type without what `typing.Annotated` adds to it."""
    return get_args(hint)[0] if get_origin(hint) is Annotated else hint


def _with_none_first(hint: Any) -> Any:
    """Return an optional type as a `typing.Union` with None first, which tyro checks without typeguard."""
    if get_origin(hint) is Annotated:
        inner, *metadata = get_args(hint)
        return Annotated[(_with_none_first(inner), *metadata)]
    if get_origin(hint) in (Union, types.UnionType) and type(None) in get_args(hint):
        return Union[(None, *(kind for kind in get_args(hint) if kind is not type(None)))]
    return hint


def _default(field: dataclasses.Field[Any], of_command: Any) -> Any:
    """Return the default of a field: the value in the default of the whole dataclass, or else that of the field."""
    if of_command not in (tyro.MISSING, tyro.MISSING_NONPROP):
        return getattr(of_command, field.name)
    if field.default is not dataclasses.MISSING:
        return field.default
    return tyro.MISSING_NONPROP if field.default_factory is dataclasses.MISSING else field.default_factory()


def help_text(command: type, name: str) -> str | None:
    """Return the docstring under a field of a dataclass or of its bases, on one line, and its allowed values."""
    text = next((texts[name] for base in command.__mro__ if name in (texts := _help_texts(base))), None)
    return " ".join(filter(None, (text, allowed(command, name)))) or None


@cache
def _help_texts(command: type) -> dict[str, str]:
    """Return the docstrings under the fields of a class by the names of the fields."""
    if not dataclasses.is_dataclass(command):
        return {}
    definition = ast.parse(textwrap.dedent(inspect.getsource(command))).body[0]
    assert isinstance(definition, ast.ClassDef)
    texts = {}
    for field, docstring in zip(definition.body, definition.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(docstring, ast.Expr):
            texts[field.target.id] = " ".join(str(ast.literal_eval(docstring.value)).split())
    return texts
