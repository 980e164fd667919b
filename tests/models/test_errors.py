"""Errors that people can correct."""

import pickle

import pytest

from dronevio.eval.benchmark.isolation import CrashError
from dronevio.models.errors import ConfigError, DronevioError, InputError, unknown_name
from dronevio.models.policies.arrays32 import PolicyError
from dronevio.models.ranges import RangeError
from dronevio.models.recordings.images import DamagedImageError


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


@pytest.mark.parametrize(
    "error",
    [
        ConfigError("no such rig"),
        InputError("a.csv", "2 columns", "3", line=7),
        DamagedImageError("a.png", "a text file", "an image"),
        RangeError(dict, "rate_hz", -1.0, "more than 0"),
        PolicyError("layers: 0", "at least 1"),
        CrashError("killed"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_errors_of_worker_processes_reach_their_parent(error: DronevioError) -> None:
    restored = pickle.loads(pickle.dumps(error))
    assert type(restored) is type(error)
    assert str(restored) == str(error)
    assert vars(restored) == vars(error)
