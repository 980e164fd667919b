"""Groups of settings whose class is imported when it is needed, so that help texts do not wait for it."""

import dataclasses
import importlib
from typing import Any, get_type_hints


@dataclasses.dataclass(frozen=True)
class ImportedSettings:
    """Default factory of a field for a group of settings whose class is imported when it is needed.

    The annotation of the field is the name of the class as a string.
    """

    module: str
    """The module of the class."""
    name: str
    """Name of the class."""

    def __call__(self) -> Any:
        """Return the default settings."""
        return self.imported()()

    def imported(self) -> type:
        """Return the class."""
        kind = getattr(importlib.import_module(self.module), self.name)
        assert isinstance(kind, type)
        return kind


def field_types(kind: type, with_settings: bool) -> dict[str, Any]:
    """Return the types of the fields of a dataclass, with what `typing.Annotated` adds to them.

    Args:
        kind: The dataclass.
        with_settings: Whether the classes of `ImportedSettings` are imported; their types are `object` otherwise.
    """
    factories = [field.default_factory for field in dataclasses.fields(kind)]
    late = [factory for factory in factories if isinstance(factory, ImportedSettings)]
    classes = {factory.name: factory.imported() if with_settings else object for factory in late}
    return get_type_hints(kind, localns=classes, include_extras=True)
