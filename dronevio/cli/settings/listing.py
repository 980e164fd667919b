"""All settings of a command, with their values and explanations."""

import dataclasses
import functools
import json
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from dronevio.cli.fields import help_text
from dronevio.cli.settings.named_fields import NamedField, settings_of


@dataclasses.dataclass(frozen=True)
class ListedSetting:
    """A setting of a command."""

    field: NamedField
    """Its name, and whether it is an option."""
    value: Any
    """Its default value."""

    @property
    def text(self) -> str:
        """What it is, its range, and when to change it."""
        when = self.field.when and f"When to change it: {self.field.when[0].lower()}{self.field.when[1:]}"
        return " ".join(filter(None, (help_text(self.field.owner, self.field.path[-1]), when)))

    @property
    def toml(self) -> str:
        """Its default value as in a TOML file."""
        return _toml(self.value)


def listed_settings(command: type, defaults: Mapping[str, object] = MappingProxyType({})) -> tuple[ListedSetting, ...]:
    """Return all settings of a command, in the order of the help text.

    Args:
        command: The dataclass of the command.
        defaults: Values of fields that replace the defaults of the dataclass.
    """
    bases = dict(defaults)
    for field in dataclasses.fields(command):
        if callable(field.default_factory) and field.name not in bases:
            bases[field.name] = field.default_factory()
    return tuple(
        ListedSetting(field, functools.reduce(getattr, field.path[1:], bases[field.path[0]]))
        for field in settings_of(command).values()
    )


def _toml(value: Any) -> str:
    """Return a value in the notation of TOML, which has none for None."""
    if value is None:
        return '"none"'
    if isinstance(value, tuple):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return json.dumps(value, ensure_ascii=False)
