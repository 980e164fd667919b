"""Checked reading of the fields of a JSON object from an untrusted file."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from dronevio.models.errors import InputError

LARGEST_INTEGER = 2**63 - 1
"""Upper limit of the magnitude of an integer."""
LONGEST_TEXT = 1000
"""Upper limit of the number of characters of a text."""
LONGEST_LIST = 100
"""Upper limit of the number of entries of a list or an object."""


@dataclass(frozen=True)
class Fields:
    """Fields of a JSON object, which are read by name and type; all errors are `InputError`."""

    path: Path
    """File that contains the object."""
    values: Mapping[str, object]
    """Values of the fields by name."""
    where: str = ""
    """Name of the object in the file, with a full stop at its end."""

    @classmethod
    def parse(cls, path: Path, text: str) -> "Fields":
        """Return the fields of a JSON text.

        Raises:
            InputError: The text is no JSON object.
        """
        try:
            value = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise InputError(path, f"the description is no JSON ({shortened(error)})", "a JSON object") from None
        if not isinstance(value, dict):
            raise InputError(path, f"the description is {shortened(value)}", "a JSON object")
        return cls(path, value)

    def error(self, name: str, expected: str) -> InputError:
        """Return the error about a field that is missing or has an unexpected value."""
        if name not in self.values:
            return InputError(self.path, f"no field {self.where}{name}", f"{self.where}{name}: {expected}")
        return InputError(self.path, f"{self.where}{name}: {shortened(self.values[name])}", expected)

    def only(self, *names: str) -> None:
        """Check that the object has no other fields than the named ones.

        Raises:
            InputError: It has another field.
        """
        for name in self.values:
            if name not in names:
                raise InputError(self.path, f"unknown field {self.where}{name[:80]}", f"only {', '.join(names)}")

    def text(self, name: str) -> str:
        """Return a text of limited length, or raise InputError."""
        value = self.values.get(name)
        if not isinstance(value, str) or not len(value) <= LONGEST_TEXT or not value.isprintable():
            raise self.error(name, f"a text of up to {LONGEST_TEXT} printable characters")
        return value

    def number(self, name: str) -> float:
        """Return a finite number, or raise InputError."""
        value = self.values.get(name)
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= 1e100:
            raise self.error(name, "a finite number")
        return float(value)

    def integer(self, name: str) -> int:
        """Return an integer of 64 bits, or raise InputError."""
        value = self.values.get(name)
        if isinstance(value, bool) or not isinstance(value, int) or abs(value) > LARGEST_INTEGER:
            raise self.error(name, "an integer of 64 bits")
        return value

    def integers(self, name: str) -> tuple[int, ...]:
        """Return a list of integers of 64 bits, or raise InputError."""
        entries = dict(enumerate(self._list(name)))
        items = Fields(self.path, {str(index): value for index, value in entries.items()}, f"{self.where}{name}.")
        return tuple(items.integer(index) for index in items.values)

    def child(self, name: str) -> "Fields":
        """Return the fields of an object in this one, or raise InputError."""
        return self._object(self.values.get(name), name)

    def children(self, name: str) -> Iterator["Fields"]:
        """Yield the fields of all objects in a list, or raise InputError."""
        for index, value in enumerate(self._list(name)):
            yield self._object(value, f"{name}.{index}")

    def _list(self, name: str) -> list[object]:
        """Return a list of limited length, or raise InputError."""
        value = self.values.get(name)
        if not isinstance(value, list) or len(value) > LONGEST_LIST:
            raise self.error(name, f"a list of up to {LONGEST_LIST} entries")
        return value

    def _object(self, value: object, name: str) -> "Fields":
        """Return the fields of a value, or raise InputError if it is no object of limited size."""
        if not isinstance(value, dict) or len(value) > LONGEST_LIST:
            raise self.error(name, f"an object of up to {LONGEST_LIST} fields")
        return Fields(self.path, value, f"{self.where}{name}.")


def shortened(value: object) -> str:
    """Return a value as text of at most 80 characters."""
    text = str(value) if isinstance(value, Exception) else repr(value)
    return text if len(text) <= 80 else f"{text[:79]}…"
