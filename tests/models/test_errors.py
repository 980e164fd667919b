"""Errors that people can correct."""

import pytest

from dronevio.models.errors import unknown_name


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("romo", "; did you mean room?"),
        ("Forrest", "; did you mean forest?"),
        ("x", ""),
        ("ROOM", "did you mean room?"),
    ],
)
def test_a_wrong_name_is_answered_by_those_that_are_like_it(name: str, hint: str) -> None:
    message = str(unknown_name("world", name, ("room", "forest", "hall")))
    assert message.startswith(f"unknown world {name!r}; expected one of room, forest, hall")
    assert message.endswith(hint or "hall")
