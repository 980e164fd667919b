"""How tyro makes options of the fields of a dataclass.

Tyro's own rule has two disadvantages here. It keeps the line breaks of an indented field docstring, so that help texts
are broken in the middle of sentences. On Python 3.11 to 3.13, it checks the default of an optional field with
typeguard, whose import takes 0.08 s, a fifth of the processor time of ``dronevio evaluate``.
"""

import ast
import dataclasses
import inspect
import textwrap
import types
from functools import cache, partial
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import tyro
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructFieldSpec, StructTypeInfo

from dronevio.cli.usage import allowed

REGISTRY = ConstructorRegistry()
"""The registry for `tyro.cli` with the rule of this module."""


@REGISTRY.struct_rule
def dataclass_rule(info: StructTypeInfo) -> StructConstructorSpec | None:
    """Return the options of a dataclass: names, types, defaults and help texts of its fields."""
    if not dataclasses.is_dataclass(info.type):
        return None
    hints = get_type_hints(info.type, include_extras=True)
    fields = [
        StructFieldSpec(
            field.name,
            _with_none_first(hints[field.name]),
            _default(field, info.default),
            partial(_help_text, info.type, field.name),
        )
        for field in dataclasses.fields(info.type)
    ]
    return StructConstructorSpec(info.type, tuple(fields))


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


def _help_text(command: type, name: str) -> str | None:
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
