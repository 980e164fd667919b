"""Things: what surfaces belong to, so that an image can say which thing each pixel shows."""

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import wraps
from typing import ParamSpec, Protocol, Self, TypeVar


@dataclass(frozen=True, eq=False)
class Instance:
    """One sofa, one tree, one wall: two of a kind are two things."""

    kind: str
    """What it is, such as ``sofa``."""


UNNAMED = Instance("something")
"""What surfaces belong to that nobody has named."""


class _Made(Protocol):
    """What is made of surfaces."""

    def as_instance(self, kind: str) -> Self:
        """Return it as one thing of a kind, whatever its parts belonged to."""


_Arguments = ParamSpec("_Arguments")
_Piece = TypeVar("_Piece", bound=_Made)


def single_instance(make: Callable[_Arguments, _Piece]) -> Callable[_Arguments, _Piece]:
    """Let each piece that a function makes be one thing, whose kind is the function's name."""

    @wraps(make)
    def named(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Piece:
        return make(*args, **kwargs).as_instance(make.__name__.strip("_"))

    return named


def unique_names(things: Iterable[Instance]) -> list[str]:
    """Return names in the same order, no two alike: the kind if there is one of it, else ``tree_1``, ``tree_2``."""
    listed = list(things)
    total, seen = Counter(thing.kind for thing in listed), Counter[str]()
    names = []
    for thing in listed:
        seen[thing.kind] += 1
        names.append(thing.kind if total[thing.kind] == 1 else f"{thing.kind}_{seen[thing.kind]}")
    return names
