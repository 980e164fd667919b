"""Ranges of settings: what is allowed, what is refused, and how it is said."""

import math
import re
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import pytest

from dronevio.models.errors import ConfigError
from dronevio.models.ranges import FINITE, Range, RangeError, Settings, number_fields


@dataclass(frozen=True)
class Example(Settings):
    """Settings with a field of each kind."""

    count: Annotated[int, Range(2, 40)] = 9
    side: Annotated[int, Range(5, 41, odd=True)] = 11
    share: Annotated[float, Range(0.0, below=1.0)] = 0.5
    limit: Annotated[float, Range(above=0.0, infinite=True)] = math.inf
    place: Annotated[tuple[float, float], Range(-1.0, 1.0)] = (0.0, 0.0)
    points: Annotated[tuple[tuple[float, float], ...], Range(-1.0, 1.0)] = ()
    maybe: Annotated[int | None, Range(low=1)] = None
    offset: float = 0.0
    use: bool = True
    name: str = ""


@pytest.mark.parametrize(
    ("field", "value", "problem"),
    [
        ("count", 1, "count = 1; expected a whole number, 2 to 40"),
        ("count", 41, "count = 41; expected a whole number, 2 to 40"),
        ("count", 9.0, "count = 9.0; expected a whole number, 2 to 40"),
        ("count", True, "count = True; expected a whole number, 2 to 40"),
        ("count", None, "count = None; expected a whole number, 2 to 40"),
        ("side", 8, "side = 8; expected an odd number, 5 to 41"),
        ("side", 3, "side = 3; expected an odd number, 5 to 41"),
        ("share", 1.0, "share = 1.0; expected a number, 0 or more, less than 1"),
        ("share", math.nan, "share = nan; expected a number, 0 or more, less than 1"),
        ("share", "half", "share = 'half'; expected a number, 0 or more, less than 1"),
        ("limit", 0.0, "limit = 0.0; expected a number, more than 0, or inf"),
        ("limit", -math.inf, "limit = -inf; expected a number, more than 0, or inf"),
        ("place", (0.0, 2.0), "place = (0.0, 2.0); expected 2 numbers, each -1 to 1"),
        ("place", (0.0,), "place = (0.0,); expected 2 numbers, each -1 to 1"),
        ("place", 0.0, "place = 0.0; expected 2 numbers, each -1 to 1"),
        ("points", ((0.0, math.nan),), "points = ((0.0, nan),); expected numbers, each -1 to 1"),
        ("maybe", 0, "maybe = 0; expected a whole number, 1 or more, or None"),
        ("offset", math.inf, "offset = inf; expected a finite number"),
        ("use", 1, "use = 1; expected True or False"),
    ],
)
def test_values_outside_a_range_are_refused(field: str, value: object, problem: str) -> None:
    with pytest.raises(RangeError, match=f"^Example.{re.escape(problem)}$") as caught:
        replace(Example(), **{field: value})  # type: ignore[arg-type]
    assert isinstance(caught.value, ConfigError)
    assert (caught.value.settings, caught.value.field) == (Example, field)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("count", 2),
        ("count", np.int64(40)),
        ("side", 41),
        ("share", 0),
        ("share", np.float32(0.25)),
        ("limit", math.inf),
        ("place", [1, -1.0]),
        ("points", ((0.0, 1.0), (-1.0, 0.5))),
        ("maybe", 1),
        ("use", np.bool_(False)),
        ("name", "anything"),
    ],
)
def test_values_in_a_range_are_kept(field: str, value: object) -> None:
    assert getattr(replace(Example(), **{field: value}), field) is value  # type: ignore[arg-type]


def test_fields_are_described() -> None:
    found = {field.name: field for field in number_fields(Example)}
    assert set(found) == {"count", "side", "share", "limit", "place", "points", "maybe", "offset", "use"}
    assert found["count"].range == Range(2, 40) and found["offset"].range == FINITE
    assert found["maybe"].optional and found["place"].count == 2 and found["points"].count is None
    assert number_fields(int) == ()
