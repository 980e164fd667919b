"""Ranges of settings: declared with the type of a field, checked on construction, and shown in help texts.

A settings class inherits from `Settings` and declares the range of a number in the annotation of its field, as in
``max_keyframes: Annotated[int, Range(2, 40)] = 9``. For a tuple of numbers, the range is that of each element.
"""

import math
import types
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from numbers import Integral, Real
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

from dronevio.models.errors import ConfigError


@dataclass(frozen=True)
class Range:
    """Allowed values of a number. NaN is in no range."""

    low: float | None = None
    """Inclusive lower bound."""
    high: float | None = None
    """Inclusive upper bound."""
    above: float | None = None
    """Exclusive lower bound, instead of `low`."""
    below: float | None = None
    """Exclusive upper bound, instead of `high`."""
    odd: bool = False
    """Whether only odd numbers are allowed."""
    infinite: bool = False
    """Whether positive infinity is allowed, too."""

    def __contains__(self, value: float) -> bool:
        """Return whether a number is allowed."""
        if math.isinf(value) and value > 0.0:
            return self.infinite
        return (
            math.isfinite(value)
            and (self.low is None or value >= self.low)
            and (self.high is None or value <= self.high)
            and (self.above is None or value > self.above)
            and (self.below is None or value < self.below)
            and not (self.odd and value % 2 != 1)
        )

    def __str__(self) -> str:
        """Return the range in words, such as ``more than 0, at most 10``."""
        if self.low is not None and self.high is not None:
            text = f"{self.low:.12g} to {self.high:.12g}"
        else:
            lower = f"{self.low:.12g} or more" if self.low is not None else None
            upper = f"at most {self.high:.12g}" if self.high is not None else None
            if self.above is not None:
                lower = f"more than {self.above:.12g}"
            if self.below is not None:
                upper = f"less than {self.below:.12g}"
            text = ", ".join(filter(None, (lower, upper))) or "any finite number"
        return f"{'an odd number, ' if self.odd else ''}{text}{', or inf' if self.infinite else ''}"


FINITE = Range()
"""The range of a number for which none is declared."""


class RangeError(ConfigError):
    """A setting has a value outside its range, or of another type."""

    def __init__(self, settings: type, field: str, found: object, expected: str) -> None:
        """Compose the message ``CLASS.FIELD = FOUND; expected EXPECTED``.

        Args:
            settings: The class of the settings.
            field: Name of the field.
            found: Value of the field.
            expected: Description of what was expected.
        """
        self.settings = settings
        self.field = field
        self.problem = f"{_shown(found)}; expected {expected}"
        """The message without the name of the field."""
        super().__init__(f"{settings.__name__}.{field} = {self.problem}")


class Settings:
    """Base of the settings classes, which are frozen dataclasses: their numbers are checked on construction."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            RangeError: A number is outside its range, or a value of another type stands in its place.
        """
        check_ranges(self)


@dataclass(frozen=True)
class NumberField:
    """A field of a settings class that holds a number, numbers or a truth value."""

    name: str
    """Name of the field."""
    kind: type
    """``int``, ``float`` or ``bool``."""
    range: Range
    """The allowed values; not used for ``bool``."""
    declared: bool
    """Whether the class declares the range."""
    optional: bool
    """Whether None is allowed."""
    many: bool
    """Whether the field holds a tuple of numbers, which may be nested."""
    count: int | None
    """Number of elements of the tuple; None for any number."""

    def expected(self) -> str:
        """Return a description of the allowed values."""
        if self.kind is bool:
            return "True or False"
        number = "whole number" if self.kind is int else "number"
        if self.many:
            text = (
                f"{number}s, each {self.range}" if self.count is None else f"{self.count} {number}s, each {self.range}"
            )
        elif self.range.odd:
            text = str(self.range)
        else:
            text = f"a finite {number}" if self.range == FINITE else f"a {number}, {self.range}"
        return f"{text}, or None" if self.optional else text


def check_ranges(settings: Any) -> None:
    """Check the numbers among the fields of a dataclass.

    Raises:
        RangeError: A number is outside its range, or a value of another type stands in its place.
    """
    for field in number_fields(type(settings)):
        value = getattr(settings, field.name)
        if not _allowed(field, value):
            raise RangeError(type(settings), field.name, value, field.expected())


def require(settings: object, holds: bool, field: str, expected: str) -> None:
    """Check a condition between several fields of a settings class.

    Args:
        settings: The settings.
        holds: Whether the condition holds.
        field: Name of the field that the error names.
        expected: Description of what was expected.

    Raises:
        RangeError: The condition does not hold.
    """
    if not holds:
        raise RangeError(type(settings), field, getattr(settings, field), expected)


def number_fields(settings: type) -> tuple[NumberField, ...]:
    """Return the fields of a dataclass that hold numbers or truth values, with their ranges."""
    return _number_fields(settings)


@cache
def _number_fields(settings: Any) -> tuple[NumberField, ...]:
    """Return the same, computed once for each class."""
    if not is_dataclass(settings):
        return ()
    # An annotation that is the name of a class as a string is a group of settings, possibly not imported yet.
    groups = {f.type: object for f in fields(settings) if isinstance(f.type, str) and f.type[:1].isupper()}
    hints = get_type_hints(settings, localns=groups, include_extras=True)
    numbers = (_number_field(field.name, hints[field.name]) for field in fields(settings))
    return tuple(number for number in numbers if number is not None)


def _number_field(name: str, hint: Any) -> NumberField | None:
    """Return the description of a field by its annotation; None if it holds something else than numbers."""
    declared: Range | None = None
    optional, many, count = False, False, None
    while not isinstance(hint, type) or get_origin(hint) is tuple:
        origin, arguments = get_origin(hint), get_args(hint)
        if origin is Annotated:
            declared = next((each for each in arguments[1:] if isinstance(each, Range)), declared)
            hint = arguments[0]
        elif origin in (Union, types.UnionType) and type(None) in arguments and len(arguments) == 2:
            optional = True
            hint = next(each for each in arguments if each is not type(None))
        elif origin is tuple and arguments and len({each for each in arguments if each is not Ellipsis}) == 1:
            if not many and Ellipsis not in arguments:
                count = len(arguments)
            many, hint = True, arguments[0]
        else:
            return None
    if hint not in (int, float, bool):
        return None
    return NumberField(name, hint, declared or FINITE, declared is not None, optional, many, count)


def _allowed(field: NumberField, value: object) -> bool:
    """Return whether a field may have a value."""
    if value is None:
        return field.optional
    if not field.many:
        return _is_number(field, value)
    if not isinstance(value, (tuple, list)) or (field.count is not None and len(value) != field.count):
        return False
    return all(_element_allowed(field, each) for each in value)


def _element_allowed(field: NumberField, value: object) -> bool:
    """Return whether an element of a tuple is a number in the range, or a tuple of such numbers."""
    if isinstance(value, (tuple, list)):
        return all(_element_allowed(field, each) for each in value)
    return _is_number(field, value)


def _is_number(field: NumberField, value: object) -> bool:
    """Return whether a value is a number of the right kind within the range."""
    if field.kind is bool:
        return isinstance(value, bool) or type(value).__name__ in ("bool_", "bool")
    if isinstance(value, bool) or not isinstance(value, Integral if field.kind is int else Real):
        return False
    return value in field.range  # type: ignore[operator]


def _shown(value: object) -> str:
    """Return a value as text on one line."""
    text = f"{value}" if isinstance(value, Real) else " ".join(repr(value).split())
    return text if len(text) <= 80 else f"{text[:77]}…"
